"""Linearizability of a register: the search of Wing and Gong, just in time as Lowe has it.

The history is read in the order of calls and returns. A configuration is a state that the register may have and the
operations under way that have taken effect in it. At each return the operation must have taken effect, alone or after
others that are under way. An operation of unknown outcome stays under way for ever and need not take effect.

G. Lowe, Testing for linearizability, Concurrency and Computation: Practice and Experience 29(4), 2017.
"""

import dataclasses
from collections import defaultdict
from collections.abc import Hashable, Iterable
from typing import Any

from .record import FOREVER_NS

#: Configurations at one return beyond which the search is given up.
MOST_CONFIGURATIONS = 200_000

State = Hashable


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
    return isinstance(state, tuple) and state[0] is None


def _agrees(read: Any, state: State) -> bool:
    return bool(read == state or (_is_open(state) and isinstance(state, tuple) and read[1] == state[1]))


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
    under_way: set[int] = set()
    configurations = {_Configuration(initial)}
    for _, is_return, index in events:
        if not is_return:
            under_way.add(index)
            continue
        configurations = _returned(configurations, operations, under_way, index)
        under_way.remove(index)
        if not configurations:
            return operations[index]
    return None


def _returned(
    configurations: set[_Configuration], operations: list[RegisterOperation], under_way: set[int], index: int
) -> set[_Configuration]:
    """The configurations in which an operation that returns now has taken effect."""
    done: set[_Configuration] = set()
    seen = set(configurations)
    waiting = list(configurations)
    while waiting:
        configuration = waiting.pop()
        if index in configuration.known:
            done.add(dataclasses.replace(configuration, known=configuration.known - {index}))
            continue
        for following in _following(configuration, operations, under_way):
            if following not in seen:
                seen.add(following)
                waiting.append(following)
        if len(seen) > MOST_CONFIGURATIONS:
            raise SearchTooLargeError(f"more than {MOST_CONFIGURATIONS} orders at {operations[index]}")
    return _without_dominated(done)


def _following(
    configuration: _Configuration, operations: list[RegisterOperation], under_way: set[int]
) -> Iterable[_Configuration]:
    """The configurations in which one more operation has taken effect."""
    tried: set[tuple[Any, ...]] = set()
    for index in sorted(under_way - configuration.known - configuration.unknown):
        operation = operations[index]
        if configuration.is_unseen and (operation.is_unknown or operation.kind == "write"):
            continue
        if operation.is_unknown:
            # Of equal operations without an outcome one is as good as another.
            alike = (operation.kind, operation.expected, operation.value)
            if alike in tried:
                continue
            tried.add(alike)
        for state in operation.apply(configuration.state):
            if operation.is_unknown:
                if state != configuration.state:
                    yield _Configuration(state, configuration.known, configuration.unknown | {index}, is_unseen=True)
            else:
                yield _Configuration(state, configuration.known | {index}, configuration.unknown)


def _without_dominated(configurations: set[_Configuration]) -> set[_Configuration]:
    """Drops those that have used more operations of unknown outcome than another of the same state."""
    alike: dict[tuple[State, frozenset[int]], list[frozenset[int]]] = defaultdict(list)
    for configuration in sorted(configurations, key=lambda configuration: len(configuration.unknown)):
        kept = alike[configuration.state, configuration.known]
        if not any(smaller <= configuration.unknown for smaller in kept):
            kept.append(configuration.unknown)
    return {_Configuration(state, known, unknown) for (state, known), sets in alike.items() for unknown in sets}
