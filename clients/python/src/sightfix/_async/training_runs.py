"""Training runs, whose subject is a camera or a site."""

from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from typing import ClassVar, Generic, TypeVar, Unpack

from sightfix._async.jobs import wait_for_job
from sightfix._async.transport import Transport
from sightfix._json import request_json
from sightfix._request import Request, delete, get, idempotency, path, with_json
from sightfix.models import (
    EpochReport,
    LogLine,
    RunDraft,
    SiteRunDraft,
    SiteTrainingRun,
    TrainingCurve,
    TrainingLog,
    TrainingRun,
)

R = TypeVar("R", TrainingRun, SiteTrainingRun)


class SubjectRuns(Generic[R]):
    """Jobs that fit models to samples of their subject, which is one of a collection."""

    _collection: ClassVar[str]
    _kind: type[R]

    def __init__(self, transport: Transport) -> None:
        self._transport = transport

    async def _start(self, subject_id: str, draft: Mapping[str, object], idempotency_key: str | None) -> R:
        request = with_json(
            "POST",
            path(self._collection, subject_id, "training-runs"),
            request_json(draft),
            headers=idempotency(idempotency_key),
            is_idempotent=idempotency_key is not None,
        )
        return await self._transport.json(request, self._kind)

    async def wait(
        self,
        run: R,
        *,
        progress: bool = False,
        on_progress: Callable[[R], object] | None = None,
        poll_s: float = 0.5,
        timeout_s: float | None = None,
    ) -> R:
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
        subject_id = run.camera_id if isinstance(run, TrainingRun) else run.site_id
        return await wait_for_job(
            lambda: self.get(subject_id, run.id),
            on_progress=on_progress,
            show_progress=progress,
            poll_s=poll_s,
            timeout_s=timeout_s,
        )

    async def get(self, subject_id: str, run_id: str) -> R:
        """One run."""
        return await self._transport.json(get(path(self._collection, subject_id, "training-runs", run_id)), self._kind)

    def list(self, subject_id: str, *, page_size: int | None = None) -> AsyncIterator[R]:
        """The runs of a subject, newest first."""
        return self._transport.items(path(self._collection, subject_id, "training-runs"), self._kind, limit=page_size)

    async def cancel(self, subject_id: str, run_id: str) -> R:
        """Cancels a run that has not ended. It gives no version then."""
        request = Request(method="POST", path=path(self._collection, subject_id, "training-runs", run_id, "cancel"))
        return await self._transport.json(request, self._kind)


class TrainingRuns(SubjectRuns[TrainingRun]):
    """Jobs that fit the model of a camera."""

    _collection = "cameras"
    _kind = TrainingRun

    async def start(
        self, camera_id: str, *, idempotency_key: str | None = None, **draft: Unpack[RunDraft]
    ) -> TrainingRun:
        """Starts a run; it is queued when this returns.

        With an `idempotency_key` the same request again returns the run of the first, for a day; it is then also
        sent again by itself after a broken connection.

        Raises:
            ConflictError: The camera has a run that has not ended.
        """
        return await self._start(camera_id, draft, idempotency_key)

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


class SiteTrainingRuns(SubjectRuns[SiteTrainingRun]):
    """Jobs that fit the models of all cameras of a site together.

    A run that succeeds may leave the cameras on their earlier versions: see `report.is_activated` and `outcome`.
    """

    _collection = "sites"
    _kind = SiteTrainingRun

    async def start(
        self, site_id: str, *, idempotency_key: str | None = None, **draft: Unpack[SiteRunDraft]
    ) -> SiteTrainingRun:
        """Starts a run, as `TrainingRuns.start` does."""
        return await self._start(site_id, draft, idempotency_key)
