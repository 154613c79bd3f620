"""What the checks take into account beside the operations themselves."""

from typing import Any

from histories.checks import (
    History,
    lost_queues,
    streamed_samples_are_stored_exactly_once,
    without_lost_changes,
)
from histories.client import at
from histories.nemesis import Interval, draw
from histories.record import Operation
from histories.soak import has_grown

S = 1_000_000_000


def operation(action: str, call_s: float, end_s: float, status: int | None = 200) -> Operation:
    return Operation("client", action, "camera", {}, int(call_s * S), int(end_s * S), status, None)


def fault(kind: str, begin_s: float, end_s: float, node: int = 1) -> Interval:
    return Interval(kind, node, int(begin_s * S), int(end_s * S), 0.0)


def test_a_seed_gives_the_same_faults_again_and_another_one_others() -> None:
    kinds = ["node-kill", "clients-cut", "clock-jump"]
    assert draw(1, 30, kinds, 3) == draw(1, 30, kinds, 3) != draw(2, 30, kinds, 3)
    assert {one.kind for one in draw(1, 30, kinds, 3)} == set(kinds)


def test_an_asynchronous_fail_over_may_undo_changes_of_its_time_only() -> None:
    before, during = operation("import", 1, 2), operation("import", 10, 11)
    seen, came = operation("read-profile", 10, 11), operation("event", 10, 11)
    history = History([before, during, seen, came], [fault("fail-over", 10.5, 12)], "asynchronous")
    kept = without_lost_changes(history).operations
    assert [(one.action, one.is_done) for one in kept] == [("import", True), ("import", False), ("event", True)]
    synchronous = History(history.operations, history.intervals, "synchronous")
    assert without_lost_changes(synchronous) == synchronous


def windows_s(*faults: Interval) -> list[tuple[float, float]]:
    return [(begin / S, end / S) for begin, end in lost_queues(History([], list(faults)))]


def test_a_kill_excuses_its_last_moment_and_the_outage_before_it() -> None:
    assert windows_s(fault("node-kill", 10, 12)) == [(9.4, 12)]
    assert windows_s(fault("full-disk", 8, 9), fault("node-kill", 10, 12)) == [(7.4, 12)]
    assert windows_s(fault("slow-disk", 8, 9), fault("node-kill", 10, 12)) == [(7.4, 12)]
    assert windows_s(fault("node-stop", 8, 9), fault("node-kill", 10, 12)) == [(7.4, 12)]
    assert windows_s(fault("node-stop", 8, 9, node=2), fault("node-kill", 10, 12)) == [(9.4, 12)]


def test_an_orderly_end_excuses_nothing_but_outages() -> None:
    assert windows_s(fault("node-restart", 10, 12)) == []
    assert windows_s(fault("slow-disk", 9, 11), fault("node-restart", 10, 12)) == []
    assert windows_s(fault("database-kill", 9, 11), fault("node-restart", 10, 12)) == [(8.4, 12)]
    assert windows_s(fault("database-kill", 10.5, 11), fault("rolling-restart", 10, 12)) == [(9.4, 12)]


def streamed(stored: list[int], acknowledged: dict[str, Any]) -> list[str]:
    """Findings in a history whose three samples came in two items each, of which the last was not acknowledged."""
    acknowledged = {"stream": 1, "after": 0, "seq": 5, "stored": 5, "not_stored": {}} | acknowledged
    operations = [
        Operation("", "stream-item", "streams-2", {"sample": (seq + 1) // 2, "stream": 1}, 0, S, status, None)
        for seq, status in zip(range(1, 7), [200] * 5 + [None], strict=True)
    ]
    operations += [
        Operation("", "acknowledgement", "streams-2", acknowledged, S, S, 200, None),
        Operation("", "list-streamed", "streams-2", {}, S, S, 200, [[at(one), one] for one in stored]),
    ]
    return list(streamed_samples_are_stored_exactly_once(History(operations, [])))


def test_acknowledged_items_are_stored_once_or_counted_as_unpaired() -> None:
    assert streamed([1, 2], {}) == streamed([1, 2, 3], {}) == []
    assert streamed([1], {"stored": 3, "not_stored": {"REASON_UNPAIRED": 2}}) == []
    assert "is not stored" in streamed([1], {})[0]
    assert "stored 2 times" in streamed([1, 1, 2], {})[0]
    assert "never sent" in streamed([1, 2, 4], {})[0]
    assert "tells of 4 items" in streamed([1, 2], {"stored": 4})[0]
    assert "REASON_REFUSED" in streamed([1, 2], {"not_stored": {"REASON_REFUSED": 1}})[0]


def test_a_figure_that_grows_is_told_from_one_that_varies() -> None:
    assert has_grown("rows", [0, 500, 1000, 1500, 2000, 2500])
    assert not has_grown("rows", [0, 500, 1000, 1010, 1000, 1005])
