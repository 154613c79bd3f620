"""Progress bars of jobs."""

from types import TracebackType
from typing import Any

from sightfix._errors import Job
from sightfix.models import Evaluation


class ProgressBar:
    """A bar of tqdm on a terminal or in a notebook; nothing if it is not shown."""

    def __init__(self, *, is_shown: bool) -> None:
        self._bar: Any = None
        if is_shown:
            try:
                from tqdm.auto import tqdm  # noqa: PLC0415, an optional dependency
            except ImportError as error:
                raise ImportError("a progress bar needs `pip install sightfix[progress]`") from error
            self._bar = tqdm(total=1, bar_format="{desc} {percentage:3.0f} % |{bar:30}| {elapsed}")

    def __enter__(self) -> "ProgressBar":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.close()

    def update(self, job: Job) -> None:
        """Shows the state of a job."""
        if self._bar is None:
            return
        self._bar.n, self._bar.total = steps(job)
        self._bar.set_description_str(" ".join([job.state, job.progress.phase]).rstrip(), refresh=False)
        self._bar.refresh()


def steps(job: Job) -> tuple[int, int]:
    """How many steps are done, and how many there are."""
    if isinstance(job, Evaluation):
        done, total = job.progress.steps_done, job.progress.steps
    else:
        done, total = job.progress.epoch, job.progress.epochs
    # How many there are is unknown before the first one.
    total = max(total, 1)
    return (total, total) if job.state == "succeeded" else (min(done, total), total)
