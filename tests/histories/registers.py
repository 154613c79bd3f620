"""Linearizability of a register: the search of Wing and Gong, just in time as Lowe has it.

The history is read in the order of calls and returns. A configuration is a state that the register may have and the
operations under way that have taken effect in it. At each return the operation must have taken effect, alone or after
others that are under way. An operation of unknown outcome stays under way for ever and need not take effect.

G. Lowe, Testing for linearizability, Concurrency and Computation: Practice and Experience 29(4), 2017.
"""

import dataclasses
import itertools
from collections import defaultdict
from collections.abc import Hashable, Iterable
from typing import Any

from .record import FOREVER_NS

#: Configurations at one return beyond which the search is given up.
MOST_CONFIGURATIONS = 200_000

State = Hashable
#: The state of a register of which nothing is known: the first effect that is seen tells it.
ANYTHING = "anything"


@dataclasses.dataclass(frozen=True)
class RegisterOperation:
    """A read, a write, or a write on the condition that a version is the present one.

    `write` and `conditional` operations of unknown outcome have `returns_ns` after all others. `succeeded` is false for
    a conditional write that was refused since the version was another one.
    """

    kind: str
    call_ns: int
    return_ns: int
    expected: Any = None
    value: Any = None
    succeeded: bool = True
    label: str = ""

    @property
    def is_unknown(self) -> bool:
        """Its outcome is unknown."""
        return self.return_ns >= FOREVER_NS

    def apply(self, state: State) -> tuple[State, ...]:
        """The state after it, none if it cannot have taken effect in this state.

        A versioned register's state is `(version, value)`. The version that a write of unknown outcome gave is not
        known: it is `(None, value)` until a read tells it.
        """
        return tuple(_apply(self, state))


def _apply(operation: RegisterOperation, state: State) -> Iterable[State]:
    if operation.kind == "write":
        yield operation.value
    elif operation.kind == "read":
        if _agrees(operation.value, state):
            yield operation.value
    elif not operation.succeeded:
        if not _has_version(state, operation.expected):
            yield state
    elif _has_version(state, operation.expected) or (_is_open(state) and not operation.is_unknown):
        yield operation.value


def _is_open(state: State) -> bool:
    return state == ANYTHING or (isinstance(state, tuple) and state[0] is None)


def _agrees(read: Any, state: State) -> bool:
    return bool(state in (read, ANYTHING) or (_is_open(state) and isinstance(state, tuple) and read[1] == state[1]))


def _has_version(state: State, version: Any) -> bool:
    return isinstance(state, tuple) and state[0] is not None and state[0] == version


@dataclasses.dataclass(frozen=True)
class _Configuration:
    """A possible state, and which operations under way have taken effect.

    An effect of unknown outcome is assumed only where the next operation sees it: what nobody sees explains nothing.
    """

    state: State
    known: frozenset[int] = frozenset()
    unknown: frozenset[int] = frozenset()
    is_unseen: bool = False


class SearchTooLargeError(Exception):
    """A history has too many possible orders."""


def first_contradiction(initial: State, operations: list[RegisterOperation]) -> RegisterOperation | None:
    """The first operation by whose return no order of effects explains the history; none if it is linearizable.

    Raises:
        SearchTooLargeError: More than `MOST_CONFIGURATIONS` configurations are possible at a return.
    """
    events = sorted(
        [(operation.call_ns, 0, index) for index, operation in enumerate(operations)]
        + [(op.return_ns, 1, index) for index, op in enumerate(operations) if not op.is_unknown]
    )
    under_way = _UnderWay(operations)
    configurations = {_Configuration(initial)}
    for _, is_return, index in events:
        if not is_return:
            under_way.add(index)
            continue
        configurations = _returned(configurations, under_way, index)
        under_way.known.remove(index)
        if not configurations:
            return operations[index]
    return None


class _UnderWay:
    """The operations that were called and have not returned.

    Those of unknown outcome are many and stay: they are found by what they would do. Of equal ones one is as good as
    another.
    """

    def __init__(self, operations: list[RegisterOperation]) -> None:
        self.operations = operations
        self.known: set[int] = set()
        self._writes: dict[Any, list[int]] = defaultdict(list)
        self._conditional: dict[Any, list[int]] = defaultdict(list)

    def add(self, index: int) -> None:
        """Notes a call."""
        operation = self.operations[index]
        if not operation.is_unknown:
            self.known.add(index)
        elif operation.kind == "write":
            self._writes[operation.value].append(index)
        else:
            self._conditional[operation.expected].append(index)

    def unknown(self, configuration: "_Configuration") -> Iterable[int]:
        """Those of unknown outcome that may change the state, one of each kind."""
        for value, indices in self._writes.items():
            if value != configuration.state:
                yield from itertools.islice((one for one in indices if one not in configuration.unknown), 1)
        if isinstance(configuration.state, tuple):
            yield from set(self._conditional.get(configuration.state[0], ())) - configuration.unknown


def _returned(configurations: set[_Configuration], under_way: _UnderWay, index: int) -> set[_Configuration]:
    """The configurations in which an operation that returns now has taken effect."""
    done: set[_Configuration] = set()
    seen = set(configurations)
    waiting = list(configurations)
    while waiting:
        configuration = waiting.pop()
        if index in configuration.known:
            done.add(dataclasses.replace(configuration, known=configuration.known - {index}))
            continue
        for following in _following(configuration, under_way):
            if following not in seen:
                seen.add(following)
                waiting.append(following)
        if len(seen) > MOST_CONFIGURATIONS:
            raise SearchTooLargeError(f"more than {MOST_CONFIGURATIONS} orders at {under_way.operations[index]}")
    return _without_dominated(done)


def _following(configuration: _Configuration, under_way: _UnderWay) -> Iterable[_Configuration]:
    """The configurations in which one more operation has taken effect."""
    for index in under_way.known - configuration.known:
        operation = under_way.operations[index]
        if configuration.is_unseen and operation.kind == "write":
            continue
        for state in operation.apply(configuration.state):
            yield _Configuration(state, configuration.known | {index}, configuration.unknown)
    if not configuration.is_unseen:
        for index in under_way.unknown(configuration):
            for state in under_way.operations[index].apply(configuration.state):
                yield _Configuration(state, configuration.known, configuration.unknown | {index}, is_unseen=True)


def _without_dominated(configurations: set[_Configuration]) -> set[_Configuration]:
    """Drops those that have used more operations of unknown outcome than another of the same state."""
    alike: dict[tuple[State, frozenset[int]], list[frozenset[int]]] = defaultdict(list)
    for configuration in sorted(configurations, key=lambda configuration: len(configuration.unknown)):
        kept = alike[configuration.state, configuration.known]
        if not any(smaller <= configuration.unknown for smaller in kept):
            kept.append(configuration.unknown)
    return {_Configuration(state, known, unknown) for (state, known), sets in alike.items() for unknown in sets}
