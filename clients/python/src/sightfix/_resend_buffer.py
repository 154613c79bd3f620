"""Buffers items of a stream until they need not be sent again; independent of how they are sent."""

from collections import deque
from dataclasses import dataclass
from typing import Generic, TypeVar

T = TypeVar("T")


@dataclass(slots=True)
class BufferedItem(Generic[T]):
    """An item that is not done."""

    item: T
    is_awaited: bool = False
    """True if it was sent on the current stream and its answer is still to come."""
    is_answered: bool = False
    """True if its answer arrived or was dropped, on this or an earlier stream."""


class ResendBuffer(Generic[T]):
    """The items that are not done, and the position of the current stream among them.

    Assigns the sequence numbers (seq), from 1 without gaps. An item is done when it is answered; on a stream that
    stores samples, when it is acknowledged and its answer on this stream has arrived.
    """

    def __init__(self, *, must_acknowledge: bool) -> None:
        self._items: deque[BufferedItem[T]] = deque()
        self._must_acknowledge = must_acknowledge
        self._first_seq = 1
        self._sent = 0
        self.awaited = 0
        """Items sent on this stream that await their answer."""
        self.acknowledged_seq = 0
        """Every item up to this seq is acknowledged."""
        self.lost_answers = 0
        """Items whose answers the server dropped."""

    def __len__(self) -> int:
        return len(self._items)

    @property
    def resume_after_seq(self) -> int:
        """The seq up to which no item needs to be sent again."""
        return self.acknowledged_seq if self._must_acknowledge else self._first_seq - 1

    @property
    def last_seq(self) -> int:
        """The highest assigned seq."""
        return self._first_seq - 1 + len(self._items)

    def push(self, item: T) -> int:
        """Appends an item; returns its seq."""
        self._items.append(BufferedItem(item))
        return self.last_seq

    def has_next(self) -> bool:
        """True if an item is to be sent on this stream."""
        # Without acknowledgements an answered item need not be sent again.
        while not self._must_acknowledge and self._sent < len(self._items) and self._items[self._sent].is_answered:
            self._sent += 1
        return self._sent < len(self._items)

    def take_next(self) -> tuple[int, T]:
        """The next item to be sent and its seq; from now on its answer is awaited. Requires `has_next`."""
        buffered = self._items[self._sent]
        buffered.is_awaited = True
        self._sent += 1
        self.awaited += 1
        return self._first_seq + self._sent - 1, buffered.item

    def answer(self, seq: int) -> bool:
        """Processes an answer; returns whether it is the first one of an item that is not done."""
        index = seq - self._first_seq
        if not 0 <= index < len(self._items) or not self._items[index].is_awaited:
            return False
        buffered = self._items[index]
        is_first = not buffered.is_answered
        buffered.is_awaited, buffered.is_answered = False, True
        self.awaited -= 1
        self._evict()
        return is_first

    def drop_answers(self, count: int, before_seq: int) -> None:
        """Processes a notice that answers of items before a seq were dropped: the oldest awaited ones."""
        for _, buffered in zip(range(before_seq - self._first_seq), self._items, strict=False):
            if count == 0:
                break
            if buffered.is_awaited:
                count -= 1
                self.lost_answers += not buffered.is_answered
                buffered.is_awaited, buffered.is_answered = False, True
                self.awaited -= 1
        self._evict()

    def acknowledge(self, seq: int) -> bool:
        """Processes an acknowledgement up to a seq; returns whether it is an advance."""
        seq = min(seq, self.last_seq)
        is_advance = seq > self.acknowledged_seq
        self.acknowledged_seq = max(self.acknowledged_seq, seq)
        self._evict()
        return is_advance

    def rewind(self) -> None:
        """Prepares for the next stream, on which the items that are not done are sent again."""
        for buffered in self._items:
            buffered.is_awaited = False
        self._sent = 0
        self.awaited = 0
        self._evict()

    def _evict(self) -> None:
        while self._items:
            front = self._items[0]
            if self._must_acknowledge:
                # An acknowledged item is not sent again, but its answer may still arrive.
                is_done = self._first_seq <= self.acknowledged_seq and not front.is_awaited
            else:
                is_done = front.is_answered
            if not is_done:
                return
            self._items.popleft()
            self._first_seq += 1
            self._sent = max(self._sent - 1, 0)
