"""The search for an order of effects, on histories of which the answer is known."""

import itertools
import random
from collections.abc import Iterator

from histories.record import FOREVER_NS
from histories.registers import ANYTHING, RegisterOperation, first_contradiction


def write(call: int, end: int, value: object) -> RegisterOperation:
    return RegisterOperation("write", call, end, value=value)


def read(call: int, end: int, value: object) -> RegisterOperation:
    return RegisterOperation("read", call, end, value=value)


def conditional(call: int, end: int, expected: object, value: object, *, succeeded: bool = True) -> RegisterOperation:
    return RegisterOperation("conditional", call, end, expected=expected, value=value, succeeded=succeeded)


def test_a_read_beside_a_write_sees_either_value() -> None:
    for value in (1, 2):
        assert first_contradiction(1, [write(0, 10, 2), read(2, 4, value)]) is None


def test_a_value_of_before_an_acknowledged_write_is_found() -> None:
    stale = read(11, 12, 1)
    assert first_contradiction(1, [write(0, 10, 2), stale]) is stale


def test_reads_that_go_back_in_time_are_found() -> None:
    back = read(5, 6, 1)
    assert first_contradiction(1, [write(0, 10, 2), read(2, 4, 2), back]) is back


def test_a_write_of_unknown_outcome_takes_effect_late_or_never() -> None:
    lost = write(0, FOREVER_NS, 2)
    assert first_contradiction(1, [lost, read(1, 2, 1), read(3, 4, 1)]) is None
    assert first_contradiction(1, [lost, read(1, 2, 1), read(3, 4, 2), read(5, 6, 2)]) is None


def test_a_write_of_unknown_outcome_takes_effect_once() -> None:
    again = read(7, 8, 2)
    history = [write(0, FOREVER_NS, 2), read(1, 2, 2), write(3, 4, 3), read(5, 6, 3), again]
    assert first_contradiction(1, history) is again


def test_of_two_conditional_writes_on_one_version_one_succeeds() -> None:
    one, other = conditional(0, 10, "a", ("b", 1)), conditional(0, 11, "a", ("c", 2))
    assert first_contradiction(("a", 0), [one, other]) is other
    refused = conditional(0, 11, "a", ("c", 2), succeeded=False)
    assert first_contradiction(("a", 0), [one, refused]) is None


def test_a_conditional_write_that_is_refused_for_nothing_is_found() -> None:
    refused = conditional(0, 1, "a", ("b", 1), succeeded=False)
    assert first_contradiction(("a", 0), [refused]) is refused


def test_a_conditional_write_of_unknown_outcome_gives_a_version_that_a_read_tells() -> None:
    lost = conditional(0, FOREVER_NS, "a", (None, 1))
    assert first_contradiction(("a", 0), [lost, read(1, 2, ("a", 0)), read(3, 4, ("b", 1))]) is None
    wrong = read(5, 6, ("a", 0))
    assert first_contradiction(("a", 0), [lost, read(3, 4, ("b", 1)), wrong]) is wrong


def test_a_register_of_which_nothing_is_known_is_what_is_seen_first() -> None:
    assert first_contradiction(ANYTHING, [read(0, 1, ("b", 1)), read(2, 3, ("b", 1))]) is None
    other = read(2, 3, ("c", 2))
    assert first_contradiction(ANYTHING, [read(0, 1, ("b", 1)), other]) is other
    assert first_contradiction(ANYTHING, [conditional(0, 1, "a", ("b", 1)), read(2, 3, ("b", 1))]) is None


def orders(history: list[RegisterOperation]) -> Iterator[tuple[RegisterOperation, ...]]:
    """All orders that agree with real time, of all choices of operations without outcome."""
    known = [operation for operation in history if not operation.is_unknown]
    unknown = [operation for operation in history if operation.is_unknown]
    for count in range(len(unknown) + 1):
        for chosen in itertools.combinations(unknown, count):
            for order in itertools.permutations([*known, *chosen]):
                if all(
                    not later.return_ns < earlier.call_ns
                    for place, earlier in enumerate(order)
                    for later in order[place + 1 :]
                ):
                    yield order


def is_linearizable(initial: object, history: list[RegisterOperation]) -> bool:
    for order in orders(history):
        state = initial
        for operation in order:
            following = operation.apply(state)
            if not following:
                break
            state = following[0]
        else:
            return True
    return False


def test_random_histories_are_judged_as_by_trying_all_orders() -> None:
    chance = random.Random(1)  # noqa: S311
    judged = {True: 0, False: 0}
    for _ in range(1_500):
        history = []
        for _ in range(chance.randint(2, 5)):
            call = chance.randrange(20)
            end = call + chance.randint(1, 10)
            kind = chance.choice(["read", "write", "lost"])
            value = chance.randrange(3)
            make = read if kind == "read" else write
            history.append(make(call, FOREVER_NS if kind == "lost" else end, value))
        expected = is_linearizable(0, history)
        judged[expected] += 1
        assert (first_contradiction(0, history) is None) == expected, history
    assert min(judged.values()) > 200, judged
