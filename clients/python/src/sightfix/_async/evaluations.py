"""Evaluations."""

from collections.abc import AsyncIterator, Callable
from typing import Unpack

from sightfix._async.jobs import wait_for_job
from sightfix._async.transport import Transport
from sightfix._json import request_json
from sightfix._request import Request, delete, get, path, with_json
from sightfix.models import Evaluation, EvaluationDraft


class Evaluations:
    """Jobs that compare all methods on samples with known positions."""

    def __init__(self, transport: Transport) -> None:
        self._transport = transport

    async def start(self, **draft: Unpack[EvaluationDraft]) -> Evaluation:
        """Starts an evaluation; it is queued when this returns."""
        return await self._transport.json(with_json("POST", path("evaluations"), request_json(draft)), Evaluation)

    async def wait(
        self,
        evaluation: Evaluation,
        *,
        progress: bool = False,
        on_progress: Callable[[Evaluation], object] | None = None,
        poll_s: float = 0.5,
        timeout_s: float | None = None,
    ) -> Evaluation:
        """Waits until an evaluation has succeeded; the arguments are those of `TrainingRuns.wait`.

        Raises:
            JobFailedError: The evaluation failed or was cancelled.
            WaitTimeoutError: It has not ended in time.
        """
        return await wait_for_job(
            lambda: self.get(evaluation.id),
            on_progress=on_progress,
            show_progress=progress,
            poll_s=poll_s,
            timeout_s=timeout_s,
        )

    async def get(self, evaluation_id: str) -> Evaluation:
        """One evaluation, with its report once it has succeeded."""
        return await self._transport.json(get(path("evaluations", evaluation_id)), Evaluation)

    def list(self, *, camera_id: str | None = None, page_size: int | None = None) -> AsyncIterator[Evaluation]:
        """Evaluations, newest first."""
        return self._transport.items(path("evaluations"), Evaluation, camera=camera_id, limit=page_size)

    async def cancel(self, evaluation_id: str) -> Evaluation:
        """Cancels an evaluation that has not ended."""
        request = Request(method="POST", path=path("evaluations", evaluation_id, "cancel"))
        return await self._transport.json(request, Evaluation)

    async def delete(self, evaluation_id: str) -> None:
        """Deletes an evaluation."""
        await self._transport.send(delete(path("evaluations", evaluation_id)))
