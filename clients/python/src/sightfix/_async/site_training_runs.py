"""Training runs of sites."""

from collections.abc import AsyncIterator, Callable
from typing import Unpack

from sightfix._async.jobs import wait_for_job
from sightfix._async.transport import Transport
from sightfix._json import request_json
from sightfix._request import Request, get, idempotency, path, with_json
from sightfix.models import SiteRunDraft, SiteTrainingRun


class SiteTrainingRuns:
    """Jobs that fit the models of all cameras of a site together."""

    def __init__(self, transport: Transport) -> None:
        self._transport = transport

    async def start(
        self, site_id: str, *, idempotency_key: str | None = None, **draft: Unpack[SiteRunDraft]
    ) -> SiteTrainingRun:
        """Starts a run; it is queued when this returns. The `idempotency_key` is as in `TrainingRuns.start`.

        Raises:
            ConflictError: The site has a run that has not ended.
        """
        request = with_json(
            "POST",
            path("sites", site_id, "training-runs"),
            request_json(draft),
            headers=idempotency(idempotency_key),
            is_idempotent=idempotency_key is not None,
        )
        return await self._transport.json(request, SiteTrainingRun)

    async def wait(
        self,
        run: SiteTrainingRun,
        *,
        progress: bool = False,
        on_progress: Callable[[SiteTrainingRun], object] | None = None,
        poll_s: float = 0.5,
        timeout_s: float | None = None,
    ) -> SiteTrainingRun:
        """Waits until a run has succeeded; the arguments are those of `TrainingRuns.wait`.

        A run that succeeds may leave the cameras on their earlier versions: see `report.is_activated` and `outcome`.

        Raises:
            JobFailedError: The run failed or was cancelled.
            WaitTimeoutError: It has not ended in time.
        """
        return await wait_for_job(
            lambda: self.get(run.site_id, run.id),
            on_progress=on_progress,
            show_progress=progress,
            poll_s=poll_s,
            timeout_s=timeout_s,
        )

    async def get(self, site_id: str, run_id: str) -> SiteTrainingRun:
        """One run, with its report once it has succeeded."""
        return await self._transport.json(get(path("sites", site_id, "training-runs", run_id)), SiteTrainingRun)

    def list(self, site_id: str, *, page_size: int | None = None) -> AsyncIterator[SiteTrainingRun]:
        """The runs of a site, newest first."""
        return self._transport.items(path("sites", site_id, "training-runs"), SiteTrainingRun, limit=page_size)

    async def cancel(self, site_id: str, run_id: str) -> SiteTrainingRun:
        """Cancels a run that has not ended. No version is stored then."""
        request = Request(method="POST", path=path("sites", site_id, "training-runs", run_id, "cancel"))
        return await self._transport.json(request, SiteTrainingRun)
