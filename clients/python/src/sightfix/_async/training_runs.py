"""Training runs."""

from collections.abc import AsyncIterator, Callable, Sequence
from typing import Unpack

from sightfix._async.jobs import wait_for_job
from sightfix._async.transport import Transport
from sightfix._json import request_json
from sightfix._request import Request, delete, get, idempotency, path, with_json
from sightfix.models import EpochReport, LogLine, RunDraft, TrainingCurve, TrainingLog, TrainingRun


class TrainingRuns:
    """Jobs that fit models to samples."""

    def __init__(self, transport: Transport) -> None:
        self._transport = transport

    async def start(
        self, camera_id: str, *, idempotency_key: str | None = None, **draft: Unpack[RunDraft]
    ) -> TrainingRun:
        """Starts a run; it is queued when this returns.

        With an `idempotency_key` the same request again returns the run of the first, for a day; it is then also
        sent again by itself after a broken connection.
        """
        request = with_json(
            "POST",
            path("cameras", camera_id, "training-runs"),
            request_json(draft),
            headers=idempotency(idempotency_key),
            is_idempotent=idempotency_key is not None,
        )
        return await self._transport.json(request, TrainingRun)

    async def wait(
        self,
        run: TrainingRun,
        *,
        progress: bool = False,
        on_progress: Callable[[TrainingRun], object] | None = None,
        poll_s: float = 0.5,
        timeout_s: float | None = None,
    ) -> TrainingRun:
        """Waits until a run has succeeded.

        Args:
            run: The run.
            progress: Whether to show a progress bar; needs the extra `progress`.
            on_progress: Is called with every state that was read.
            poll_s: Seconds between requests.
            timeout_s: How long to wait at most; for ever by default.

        Raises:
            JobFailedError: The run failed or was cancelled.
            WaitTimeoutError: It has not ended in time.
        """
        return await wait_for_job(
            lambda: self.get(run.camera_id, run.id),
            on_progress=on_progress,
            show_progress=progress,
            poll_s=poll_s,
            timeout_s=timeout_s,
        )

    async def get(self, camera_id: str, run_id: str) -> TrainingRun:
        """One run."""
        return await self._transport.json(get(path("cameras", camera_id, "training-runs", run_id)), TrainingRun)

    def list(self, camera_id: str, *, page_size: int | None = None) -> AsyncIterator[TrainingRun]:
        """The runs of a camera, newest first."""
        return self._transport.items(path("cameras", camera_id, "training-runs"), TrainingRun, limit=page_size)

    async def cancel(self, camera_id: str, run_id: str) -> TrainingRun:
        """Cancels a run that has not ended."""
        request = Request(method="POST", path=path("cameras", camera_id, "training-runs", run_id, "cancel"))
        return await self._transport.json(request, TrainingRun)

    async def delete(self, camera_id: str, run_id: str) -> None:
        """Deletes a run that has ended; its model stays."""
        await self._transport.send(delete(path("cameras", camera_id, "training-runs", run_id)))

    async def log(self, camera_id: str, run_id: str) -> Sequence[LogLine]:
        """Lines of a run's log, oldest first."""
        request = get(path("cameras", camera_id, "training-runs", run_id, "log"))
        return (await self._transport.json(request, TrainingLog)).items

    async def curve(self, camera_id: str, run_id: str) -> Sequence[EpochReport]:
        """Losses of the final fit by epoch."""
        request = get(path("cameras", camera_id, "training-runs", run_id, "curve"))
        return (await self._transport.json(request, TrainingCurve)).items
