"""The asynchronous client's side: tasks and conditions of asyncio."""

import asyncio
from asyncio import Condition
from collections.abc import AsyncIterable, AsyncIterator, Awaitable, Callable, Coroutine, Iterable
from pathlib import Path
from typing import Any, TypeVar

__all__ = ["Condition", "Reader", "Task", "file_parts", "iterate", "sleep", "wait_at_most"]

T = TypeVar("T")

Reader = Callable[[], Awaitable[T]]
"""Reads something again."""

PART_BYTES = 1 << 16


class Task:
    """A function that runs concurrently."""

    def __init__(self, function: Callable[[], Coroutine[Any, Any, None]]) -> None:
        self._task = asyncio.create_task(function())

    async def join(self) -> None:
        """Waits for its end, however it ends."""
        await asyncio.wait([self._task])
        if not self._task.cancelled():
            self._task.exception()

    def cancel(self) -> None:
        """Interrupts it."""
        self._task.cancel()


async def sleep(seconds: float) -> None:
    """Waits."""
    await asyncio.sleep(seconds)


async def wait_at_most(condition: Condition, predicate: Callable[[], bool], seconds: float) -> None:
    """Waits with a held condition until the predicate holds, but no longer than that."""
    try:
        async with asyncio.timeout(seconds):
            await condition.wait_for(predicate)
    except TimeoutError:
        return


async def iterate(items: Iterable[T] | AsyncIterable[T]) -> AsyncIterator[T]:
    """The items of either kind of iterable."""
    if isinstance(items, AsyncIterable):
        async for item in items:
            yield item
    else:
        for item in items:
            yield item


async def file_parts(path: Path) -> AsyncIterator[bytes]:
    """The content of a file."""
    with await asyncio.to_thread(path.open, "rb") as file:
        while part := await asyncio.to_thread(file.read, PART_BYTES):
            yield part
