"""Waits for jobs of the server."""

import time
from collections.abc import Callable
from typing import TypeVar

from sightfix._errors import JobFailedError, WaitTimeoutError
from sightfix._progress import ProgressBar
from sightfix._runtime.asynchronous import Reader, sleep
from sightfix.models import Evaluation, SiteTrainingRun, TrainingRun

J = TypeVar("J", TrainingRun, SiteTrainingRun, Evaluation)


async def wait_for_job(
    read: Reader[J],
    *,
    on_progress: Callable[[J], object] | None,
    show_progress: bool,
    poll_s: float,
    timeout_s: float | None,
) -> J:
    """Reads a job until it has succeeded.

    Raises:
        JobFailedError: It failed or was cancelled.
        WaitTimeoutError: It has not ended in time.
    """
    started_s = time.monotonic()
    with ProgressBar(is_shown=show_progress) as bar:
        while True:
            job = await read()
            bar.update(job)
            if on_progress is not None:
                on_progress(job)
            if job.state == "succeeded":
                return job
            if job.state in ("failed", "cancelled"):
                raise JobFailedError(job)
            if timeout_s is not None and time.monotonic() - started_s >= timeout_s:
                raise WaitTimeoutError(f"{job.id} is {job.state} after {timeout_s} s")
            await sleep(poll_s)
