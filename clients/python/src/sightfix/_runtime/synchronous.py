"""The synchronous client's side: threads."""

import threading
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from threading import Condition
from typing import TypeVar

__all__ = ["Condition", "Reader", "Task", "file_parts", "iterate", "sleep", "wait_at_most"]

T = TypeVar("T")

Reader = Callable[[], T]
"""Reads something again."""

PART_BYTES = 1 << 16


class Task:
    """A function that runs concurrently."""

    def __init__(self, function: Callable[[], None]) -> None:
        # A thread that waits in an iterable of the caller cannot be interrupted, and must not keep the process alive.
        self._thread = threading.Thread(target=function, name="sightfix-stream", daemon=True)
        self._thread.start()

    def join(self) -> None:
        """Waits for its end."""
        self._thread.join()

    def cancel(self) -> None:
        """Does nothing: threads end by themselves once the stream is closed."""


def sleep(seconds: float) -> None:
    """Waits."""
    time.sleep(seconds)


def wait_at_most(condition: Condition, predicate: Callable[[], bool], seconds: float) -> None:
    """Waits with a held condition until the predicate holds, but no longer than that."""
    condition.wait_for(predicate, seconds)


def iterate(items: Iterable[T]) -> Iterator[T]:
    """The items."""
    return iter(items)


def file_parts(path: Path) -> Iterator[bytes]:
    """The content of a file."""
    with path.open("rb") as file:
        while part := file.read(PART_BYTES):
            yield part
