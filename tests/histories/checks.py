"""What must be true of a history, whatever the faults were."""

import bisect
import dataclasses
import itertools
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable
from typing import Any

from .backends import PostgreSQL
from .client import at
from .cluster import RUN_LEASE_S
from .nemesis import ENDS_LEASES, ON_DATABASE, ON_LINKS_TO_DATABASE, Interval
from .record import FOREVER_NS, Operation, by_subject, of_action
from .registers import ANYTHING, RegisterOperation, SearchTooLargeError, first_contradiction
from .workloads import ROWS_PER_BATCH

SECOND_NS = 1_000_000_000
#: For how long a node may go on with what it last read of the database, s: the lease of a node (keys), or its poll
#: of changed cameras every two seconds, each with a second for a machine that does other work.
STALE_S = 3.0
#: Positions of a killed server that had not reached the outbox: 100 ms are promised, the rest is for the machine, s.
QUEUED_LATE_S = 0.6
#: Time before an asynchronous fail-over whose changes the standby may not have, beside the lag that was arranged, s.
REPLICATED_LATE_S = 0.5
#: After a fail-over two nodes may own a camera until the next renewal, s.
RENEWED_S = 2.0
LIVE = ("queued", "running", "cancelling")
#: Faults that fail a run for good: no space for its version, or five attempts that ended with their workers.
FAILURES = ("is full", "no space", "given up")
#: Why an acknowledged item of a sample in two items need not be stored.
UNPAIRED = ("REASON_UNPAIRED", "REASON_TOO_LATE")
ENDED = ("succeeded", "failed", "cancelled")
#: Changes that have an entry in the audit log, and its action.
AUDITED = {
    "create-camera": "camera-created", "change-profile": "camera-changed", "import-model": "model-imported",
    "activate": "model-activated", "create-key": "key-created", "revoke-key": "key-revoked", "start-run": "run-started",
    "create-connection": "connection-created",
}  # fmt: skip
#: Of these, those that change nothing when they are sent again.
REPEATED = ("start-run", "revoke-key")
#: Operations that change nothing.
MESSAGES = ("event", "watch")
READS = ("read-profile", "read-active", "fuse", "use-key", "list-runs", "probe-read", *MESSAGES)


@dataclasses.dataclass(frozen=True)
class History:
    """What clients saw, what they found at the end, and which faults there were."""

    operations: list[Operation]
    intervals: list[Interval]
    replication: str = "none"
    is_folder: bool = False

    def of(self, *actions: str) -> list[Operation]:
        """Operations by action."""
        return of_action(self.operations, *actions)


def without_lost_changes(history: History) -> History:
    """The history without what an asynchronous fail-over may undo: such changes have an unknown outcome."""
    windows = [
        (fault.begin_ns - seconds(REPLICATED_LATE_S), fault.end_ns + seconds(RENEWED_S))
        for fault in history.intervals
        if _undoes(history, fault)
    ]

    def is_inside(operation: Operation) -> bool:
        return any(operation.call_ns < end and operation.return_ns > begin for begin, end in windows)

    kept = []
    for operation in history.operations:
        # A message that came stays so: the next one follows it.
        if operation.action in MESSAGES or not is_inside(operation):
            kept.append(operation)
        elif operation.action not in READS and operation.client != "final":
            kept.append(dataclasses.replace(operation, status=None))
    return dataclasses.replace(history, operations=kept)


def seconds(number: float) -> int:
    """Seconds in nanoseconds."""
    return int(number * SECOND_NS)


def samples_are_stored_exactly_once(history: History) -> Iterable[str]:
    """Every acknowledged batch is stored once, as it was sent, and nothing that was never sent."""
    imports = by_subject(history.of("import"))
    for listing in history.of("list-samples"):
        camera, found = listing.subject, Counter((row[0], row[1]) for row in listing.answer)
        sent: dict[tuple[str, int], int] = {}
        for operation in imports.get(camera, []):
            batch = operation.arguments["batch"]
            for row in range(ROWS_PER_BATCH):
                key = (at(10 * batch + row), batch)
                sent[key] = max(sent.get(key, 0), operation.is_done)
            if operation.is_done and operation.answer["accepted"] + operation.answer["duplicate"] != ROWS_PER_BATCH:
                yield f"{camera}: batch {batch} was answered with {operation.answer}"
        for key, is_acknowledged in sent.items():
            if is_acknowledged and found[key] != 1:
                yield f"{camera}: sample {key} was acknowledged and is stored {found[key]} times"
        for key, count in found.items():
            if key not in sent or count > 1:
                yield f"{camera}: sample {key} is stored {count} times, and was{'' if key in sent else ' never'} sent"


def streamed_samples_are_stored_exactly_once(history: History) -> Iterable[str]:
    """Every sample whose items are acknowledged is stored once, but for items that are counted as not stored."""
    items, acknowledgements = by_subject(history.of("stream-item")), by_subject(history.of("acknowledgement"))
    for listing in history.of("list-streamed"):
        camera, found = listing.subject, Counter((row[0], row[1]) for row in listing.answer)
        sent: dict[tuple[str, int], list[Operation]] = defaultdict(list)
        for item in items.get(camera, []):
            sent[at(item.arguments["sample"]), item.arguments["sample"]].append(item)
        for key, count in found.items():
            if key not in sent or count > 1:
                yield f"{camera}: sample {key} is stored {count} times, and was{'' if key in sent else ' never'} sent"
        left = _counted_as_unpaired(acknowledgements.get(camera, []))
        for key, parts in sent.items():
            if found[key] == 0 and all(part.is_done for part in parts):
                stream = parts[-1].arguments["stream"]
                left[stream] -= 1
                if left[stream] < 0:
                    yield f"{camera}: sample {key} was acknowledged on stream {stream} and is not stored"
        yield from _unaccounted(camera, acknowledgements.get(camera, []))


def _unaccounted(camera: str, acknowledgements: list[Operation]) -> Iterable[str]:
    """Acknowledgements that say of fewer items what became of them than they acknowledge."""
    for one in acknowledgements:
        settled = one.arguments["stored"] + sum(one.arguments["not_stored"].values())
        if settled < one.arguments["seq"] - one.arguments["after"]:
            yield f"{camera}: {one.arguments} tells of {settled} items"
        if unknown := set(one.arguments["not_stored"]) - {*UNPAIRED, "REASON_DUPLICATE"}:
            yield f"{camera}: items were not stored: {unknown}"


def _counted_as_unpaired(acknowledgements: list[Operation]) -> Counter[int]:
    """Items by stream of which the server says that they found no partner."""
    counts: Counter[int] = Counter()
    for one in acknowledgements:
        counts[one.arguments["stream"]] = sum(one.arguments["not_stored"].get(reason, 0) for reason in UNPAIRED)
    return counts


def judged(name: str, initial: Any, operations: list[RegisterOperation]) -> Iterable[str]:
    """The first contradiction in a register, as a finding."""
    try:
        found = first_contradiction(initial, operations)
    except SearchTooLargeError as error:
        yield f"{name}: not decided: {error}"
        return
    if found is not None:
        yield f"{name} is not linearizable: no order of effects explains {found}"


def by_era(history: History, *actions: str) -> Iterable[tuple[str, list[Operation]]]:
    """Operations by subject, and by the times between fail-overs that may have undone changes.

    Those of unknown outcome may take effect in later times, too.
    """
    ends = [fault.end_ns + seconds(RENEWED_S) for fault in history.intervals if _undoes(history, fault)]
    for subject, operations in by_subject(history.of(*actions)).items():
        for begin_ns, end_ns in itertools.pairwise([0, *sorted(ends), FOREVER_NS]):
            era = [one for one in operations if begin_ns <= one.call_ns < end_ns]
            if era:
                yield subject, [one for one in operations if one.call_ns < begin_ns and one.is_unknown] + era


def _undoes(history: History, fault: Interval) -> bool:
    return history.replication == "asynchronous" and fault.kind == "fail-over"


def returned(operation: Operation) -> int:
    """When the effect of a change had taken place at the latest."""
    return FOREVER_NS if operation.is_unknown else operation.return_ns


def profiles_are_linearizable(history: History) -> Iterable[str]:
    """A profile is a register: reads see the latest change, and of two changes of one revision one is made."""
    for camera, operations in by_era(history, "read-profile", "change-profile"):
        register: list[RegisterOperation] = []
        initial: Any = None if operations[0].client == "setup" else ANYTHING
        for operation in operations:
            if operation.action == "read-profile":
                if operation.is_done:
                    value = (operation.answer["etag"], operation.answer["name"])
                    # The first read was over before there were clients.
                    initial = initial or value
                    register.append(RegisterOperation("read", operation.call_ns, operation.return_ns, value=value,
                                                      label=operation.request_id))  # fmt: skip
            elif not operation.is_refused or operation.status == 412:
                etag = operation.answer["etag"] if operation.is_done else None
                register.append(
                    RegisterOperation(
                        "conditional", operation.call_ns, returned(operation),
                        expected=operation.arguments["expected"], value=(etag, operation.arguments["name"]),
                        succeeded=operation.status != 412, label=operation.request_id,
                    )
                )  # fmt: skip
        yield from judged(f"profile of {camera}", initial, register)


def active_models_are_linearizable(history: History) -> Iterable[str]:
    """The active version is a register."""
    for camera, operations in by_era(history, "activate", "read-active"):
        register = [
            RegisterOperation("write", one.call_ns, returned(one), value=one.arguments["number"], label=one.request_id)
            for one in operations
            if one.action == "activate" and not one.is_refused
        ]
        register += [
            RegisterOperation("read", one.call_ns, one.return_ns, value=one.answer, label=one.request_id)
            for one in operations
            if one.action == "read-active" and one.is_done
        ]
        yield from judged(f"active model of {camera}", ANYTHING, register)


def fusions_use_a_recent_model(history: History) -> Iterable[str]:
    """A fusion is answered by a version that was active at most `STALE_S` before it was asked for."""
    changes = [one for one in history.of("activate") if not one.is_refused]
    by_version: dict[int, list[Operation]] = defaultdict(list)
    for change in changes:
        by_version[change.arguments["number"]].append(change)
    superseding = sorted((one for one in changes if one.is_done), key=lambda one: one.return_ns)
    # The latest call of the changes that were over by then: what had ended before it was no longer active.
    ends, latest = (
        [one.return_ns for one in superseding],
        list(itertools.accumulate((one.call_ns for one in superseding), max)),
    )
    for fusion in history.of("fuse"):
        if not fusion.is_done:
            continue
        over = bisect.bisect_left(ends, fusion.call_ns - seconds(STALE_S))
        since_ns = latest[over - 1] if over else 0
        if not any(
            one.call_ns < fusion.return_ns and returned(one) >= since_ns for one in reversed(by_version[fusion.answer])
        ):
            yield f"{fusion.request_id}: version {fusion.answer} answered, which was not active within {STALE_S} s"


def keys_work_from_creation_to_revocation(history: History) -> Iterable[str]:
    """A key is taken `STALE_S` after it was created, and refused `STALE_S` after it was revoked."""
    created = {one.answer["id"]: one for one in history.of("create-key") if one.is_done}
    revocations = by_subject(history.of("revoke-key"))
    for use in history.of("use-key"):
        creation, tried = created.get(use.subject), revocations.get(use.subject, [])
        if creation is None:
            continue
        since_creation_s = (use.call_ns - creation.return_ns) / SECOND_NS
        is_before_revocation = all(use.return_ns < one.call_ns for one in tried)
        if use.status == 401 and is_before_revocation and since_creation_s > STALE_S:
            yield f"{use.request_id}: key {use.subject} was refused {since_creation_s:.1f} s after it was created"
        for revocation in tried:
            since_s = (use.call_ns - revocation.return_ns) / SECOND_NS
            if use.is_done and revocation.is_done and since_s > STALE_S:
                yield f"{use.request_id}: key {use.subject} was taken {since_s:.1f} s after it was revoked"
                break


def runs_end_once(history: History) -> Iterable[str]:
    """Each acknowledged run ends once, at most one is live, and a version belongs to one run that succeeded."""
    listings = [one for one in history.of("list-runs", "final-runs") if one.is_done]
    ended: dict[str, tuple[str, int]] = {}
    for listing in listings:
        live = [run[0] for run in listing.answer if run[1] in LIVE]
        if len(live) > 1:
            yield f"{listing.request_id}: {live} are live at once"
    for listing in sorted(listings, key=lambda one: one.return_ns):
        for run, state, _, _, _ in listing.answer:
            before = ended.get(run)
            # What was called before the end was seen may tell of a time before the end.
            if before is not None and before[0] != state and listing.call_ns > before[1]:
                yield f"{listing.request_id}: run {run} had {before[0]} and is {state}"
            if state in ENDED:
                ended.setdefault(run, (state, listing.return_ns))
    for final in history.of("final-runs"):
        yield from _final_runs(history, final)


def _final_runs(history: History, final: Operation) -> Iterable[str]:
    found = {run[0]: run for run in final.answer}
    for start in history.of("start-run"):
        if start.is_done and start.answer["id"] not in found:
            yield f"run {start.answer['id']} was acknowledged and is not there"
    seeds: dict[int, set[str]] = defaultdict(set)
    for start in history.of("start-run"):
        if start.is_done:
            seeds[start.arguments["seed"]].add(start.answer["id"])
    yield from (f"one idempotency key gave the runs {ids}" for ids in seeds.values() if len(ids) > 1)
    yield from (f"run {run[0]} is {run[1]} at the end" for run in found.values() if run[1] not in ENDED)
    made = Counter(run for models in history.of("final-models") for _, run in models.answer if run is not None)
    for failures in history.of("final-failures"):
        for run_id, outcome in failures.answer:
            if not any(reason in outcome for reason in FAILURES):
                yield f"run {run_id} has failed: {outcome}"
    for run in found.values():
        if made[run[0]] != (run[1] == "succeeded"):
            yield f"run {run[0]} has {run[1]} and made {made[run[0]]} versions"


def live_runs_are_not_taken_over(history: History) -> Iterable[str]:
    """A run is claimed again only after a fault that may have ended the lease of its worker."""
    kinds = (*ENDS_LEASES, "clock-jump") if history.is_folder else ENDS_LEASES
    faults = [fault for fault in history.intervals if fault.kind in kinds]
    seen: dict[str, list[tuple[int, int]]] = defaultdict(list)
    for listing in history.of("list-runs", "final-runs"):
        if listing.is_done:
            for run, _, attempt, _, _ in listing.answer:
                seen[run].append((listing.call_ns, attempt))
    for run, attempts in seen.items():
        first_ns = attempts[0][0] - seconds(STALE_S)
        for (_, before), (seen_ns, attempt) in itertools.pairwise(attempts):
            if attempt > before:
                possible = sum(_leases_ended(fault) for fault in faults if _may_end_a_lease(fault, first_ns, seen_ns))
                if attempt > 1 + possible:
                    yield f"run {run} is in attempt {attempt} after {possible} faults that may end a lease"


def _leases_ended(fault: Interval) -> int:
    """How many leases a fault may end one after the other."""
    if fault.kind == "rolling-restart":
        return PostgreSQL.most_nodes
    return 1 + (fault.end_ns - fault.begin_ns) // seconds(RUN_LEASE_S)


def _may_end_a_lease(fault: Interval, begin_ns: int, end_ns: int) -> bool:
    return begin_ns < fault.end_ns + seconds(2 * STALE_S) and fault.begin_ns < end_ns


def the_audit_log_has_exactly_the_changes(history: History) -> Iterable[str]:
    """Each acknowledged change has one entry, a refused one none, and no entry is without a change."""
    changes = {one.request_id: one for one in history.of(*AUDITED)}
    for log in history.of("final-audit"):
        entries = Counter((entry[0], entry[1]) for entry in log.answer)
        repeated: dict[str, list[Operation]] = defaultdict(list)
        for change in changes.values():
            count = entries[change.request_id, AUDITED[change.action]]
            if change.action in REPEATED and not change.is_refused:
                repeated[f"{change.action} {change.subject} {change.arguments}"].append(change)
                continue
            if count > 1 or (change.is_done and count != 1) or (change.is_refused and count != 0):
                yield f"{change.request_id}: {change.action} was answered {change.status} and has {count} entries"
        for name, requests in repeated.items():
            count = sum(entries[one.request_id, AUDITED[one.action]] for one in requests)
            if count > 1 or (count == 0 and any(one.is_done for one in requests)):
                yield f"{name} was asked for {len(requests)} times and has {count} entries"
        for request, action in entries:
            if request is not None and action in AUDITED.values() and request not in changes:
                yield f"the log has {action} of {request}, which nobody asked for"
        numbers = [entry[2] for entry in log.answer]
        if len(set(numbers)) != len(numbers):
            yield "two entries of the log have one number"


def events_are_complete_or_marked_lost(history: History) -> Iterable[str]:
    """Between two events no acknowledged observation is missing, unless events are said to be lost there."""
    follows = [one for one in history.of("follow") if one.is_done]
    numbers = {one.arguments["time"]: one.arguments["number"] for one in history.of("follow")}
    acknowledged = {one.arguments["number"] for one in follows}
    seen: set[str] = set()
    last: int | None = None
    for event in history.of("event", "watch"):
        if event.action == "watch":
            # Without an id the stream begins now, whatever was before.
            last = last if event.arguments["after"] is not None else None
            continue
        if event.arguments["name"] == "lost":
            last = None
            continue
        if event.arguments["id"] in seen:
            yield f"event {event.arguments['id']} came twice"
        seen.add(event.arguments["id"])
        number = numbers.get(event.arguments["time"])
        if number is None:
            yield f"event {event.arguments['id']} is of an observation that nobody sent"
            continue
        missing = [] if last is None else [one for one in range(last + 1, number) if one in acknowledged]
        if missing:
            yield f"event {event.arguments['id']} comes after number {last}, without {missing} and without a loss"
        # One of unknown outcome may come late.
        last = number if last is None else max(last, number)


def positions_are_delivered_under_stable_ids(history: History) -> Iterable[str]:
    """Every acknowledged position is delivered, under one id of its own, but for those that a killed server held."""
    ids: dict[str, set[str]] = defaultdict(set)
    times: dict[str, set[str]] = defaultdict(set)
    for delivery in history.of("delivery"):
        ids[delivery.arguments["time"]].add(delivery.arguments["id"])
        times[delivery.arguments["id"]].add(delivery.arguments["time"])
    yield from (f"position of {time} came under the ids {sorted(of)}" for time, of in ids.items() if len(of) > 1)
    yield from (f"id {one} was given to the positions of {sorted(of)}" for one, of in times.items() if len(of) > 1)
    sent = {one.arguments["time"] for one in history.of("publish")}
    yield from (f"position of {time} was delivered, and never sent" for time in ids if time not in sent)
    excused = list(lost_queues(history))
    for publication in history.of("publish"):
        is_excused = any(begin < publication.return_ns and publication.call_ns < end for begin, end in excused)
        if publication.is_done and publication.arguments["time"] not in ids and not is_excused:
            yield f"position of {publication.arguments['time']} was acknowledged and never delivered"


def lost_queues(history: History) -> Iterable[tuple[int, int]]:
    """Times whose positions a killed server may not have queued: its last, and those in which it could not queue."""
    for end in history.intervals:
        if end.kind not in ("node-kill", "node-restart", "rolling-restart"):
            continue
        begin_ns, is_kept = end.begin_ns, end.kind == "node-kill"
        for outage in sorted(history.intervals, key=lambda one: one.begin_ns, reverse=True):
            is_near = outage.begin_ns < end.end_ns and outage.end_ns + seconds(STALE_S) > begin_ns
            if is_near and _keeps_from_queueing(outage, end):
                begin_ns, is_kept = min(begin_ns, outage.begin_ns), True
        if is_kept:
            yield begin_ns - seconds(QUEUED_LATE_S), end.end_ns
    for fault in history.intervals:
        if _undoes(history, fault):
            yield fault.begin_ns - seconds(QUEUED_LATE_S), fault.end_ns


def _keeps_from_queueing(outage: Interval, end: Interval) -> bool:
    """Whether a fault kept the node that ends from bringing positions into the outbox."""
    if outage.kind in (*ON_LINKS_TO_DATABASE, "node-stop"):
        return outage.node == end.node or end.kind == "rolling-restart"
    # An orderly end waits for a slow disk, and for its turn after a burst.
    is_slow = outage.kind in ("slow-disk", "burst") and end.kind == "node-kill"
    return is_slow or outage.kind in (*ON_DATABASE, "full-disk", "fail-over")


def a_camera_has_one_owner(history: History) -> Iterable[str]:
    """What a node follows is of one time of ownership, in which no other node has answered.

    Node A has taken x, then B takes y, then A still follows x: A has answered as the owner before and after B.
    """
    taken = {one.arguments["target"]: one for one in history.of("probe") if one.is_done}
    by_node: dict[str, list[Operation]] = defaultdict(list)
    for one in sorted(taken.values(), key=lambda one: one.call_ns):
        by_node[one.arguments["node"]].append(one)
    for read in history.of("probe-read"):
        if read.is_done:
            known = [taken[target] for target in read.answer if target in taken]
            yield from _owners_beside(read, known, by_node)


def _owners_beside(read: Operation, known: list[Operation], by_node: dict[str, list[Operation]]) -> Iterable[str]:
    """Others that have answered as the owner while the node that was read was it."""
    node = read.arguments["node"]
    own = [one for one in known if one.arguments["node"] == node]
    if strangers := [one for one in known if one.arguments["node"] != node]:
        yield f"{read.request_id}: {node} follows {strangers[0].arguments['target']}, which another node has taken"
    if not own:
        return
    since, latest = min(own, key=lambda one: one.return_ns), max(own, key=lambda one: one.call_ns)
    for other, answers in by_node.items():
        begin = bisect.bisect_right(answers, since.return_ns, key=lambda one: one.call_ns)
        # A node without an owner beside it shows what it followed last: only what it takes afterwards is of an owner.
        between = next((one for one in answers[begin:] if one.return_ns < latest.call_ns), None)
        if other != node and between is not None:
            followed, stranger = since.arguments["target"], between.arguments["target"]
            yield f"{read.request_id}: {node} follows {followed} although {other} has taken {stranger} since"


def all_nodes_agree_at_the_end(history: History) -> Iterable[str]:
    """After the last fault every node gives the same answers."""
    for action in ("final-profile", "final-active", "final-fusion"):
        answers = {json_key(one.answer) for one in history.of(action) if one.is_done}
        if len(answers) > 1:
            yield f"{action}: nodes answer {sorted(answers)}"
        yield from (f"{action}: {one.arguments} answered {one.status}" for one in history.of(action) if not one.is_done)


def every_kind_of_request_was_answered(history: History) -> Iterable[str]:
    """Each kind of request was done at least once: a promise that nobody asked for was not tried."""
    done = Counter(one.action for one in history.operations if one.is_done)
    messages = ("publish", "delivery", "stream-item", "list-samples", "list-streamed")
    wanted = {one.action for one in history.operations} | {*AUDITED, *READS, *messages}
    yield from (f"no {action} was done" for action in sorted(wanted) if not done[action])


def json_key(answer: Any) -> str:
    """An answer as a text to compare."""
    return repr(answer)


CHECKS: tuple[Callable[[History], Iterable[str]], ...] = (
    samples_are_stored_exactly_once, streamed_samples_are_stored_exactly_once, profiles_are_linearizable,
    active_models_are_linearizable, fusions_use_a_recent_model, keys_work_from_creation_to_revocation, runs_end_once,
    live_runs_are_not_taken_over, the_audit_log_has_exactly_the_changes, events_are_complete_or_marked_lost,
    positions_are_delivered_under_stable_ids, a_camera_has_one_owner, all_nodes_agree_at_the_end,
    every_kind_of_request_was_answered,
)  # fmt: skip
#: Findings of one check that are listed.
MOST_FINDINGS = 20


def check(history: History) -> dict[str, list[str]]:
    """What is wrong with a history, by check; nothing for those that hold."""
    history = without_lost_changes(history)
    return {one.__name__: list(itertools.islice(one(history), MOST_FINDINGS)) for one in CHECKS}
