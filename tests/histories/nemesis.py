"""Faults, drawn from a seed before the run, so that the same seed gives the same faults again."""

import contextlib
import dataclasses
import json
import multiprocessing
import random
import shutil
import threading
import time
from collections.abc import Callable
from pathlib import Path

from .backends import PostgreSQL
from .burst import burst
from .cluster import Cluster, Node
from .links import Link
from .processes import PAUSE_S

#: Faults under way at the same time.
MOST_AT_ONCE = 2
#: Between the beginnings of two faults, and how long one lasts, s.
GAPS_S = (0.3, 2.5)
DURATIONS_S = (0.2, 4.0)
#: Ahead of or behind the machine's clock, s.
CLOCK_OFFSETS_S = (-86_400.0, -3_600.0, -30.0, -2.0, 2.0, 30.0, 3_600.0, 86_400.0, 400 * 86_400.0)
DELAYS_S = (0.01, 0.05, 0.2)
#: How much longer a flush takes on a slow disk, s.
SLOW_FLUSHES_S = (0.02, 0.1, 0.5)
#: For how long before a fail-over an asynchronous standby has received nothing, s.
LAGS_S = (0.0, 0.5, 1.5)

ON_NODES = ("node-kill", "node-stop", "node-restart", "clients-cut", "clients-reset", "clients-delay", "clock-jump",
            "burst")  # fmt: skip
ON_LINKS_BETWEEN_NODES = ("nodes-cut", "nodes-reset", "nodes-delay")
ON_LINKS_TO_DATABASE = ("database-cut", "database-reset", "database-delay")
ON_DATABASE = ("database-kill", "database-stop", "database-terminate")
#: Faults that may end a lease.
ENDS_LEASES = ("node-kill", "node-stop", "node-restart", "rolling-restart", "database-cut", "database-delay",
               "database-kill", "database-stop", "database-terminate", "database-reset", "full-disk",
               "fail-over", "slow-disk")  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Fault:
    """What happens, to which node, how long after the one before, and for how long; `amount` is its own parameter."""

    number: int
    kind: str
    node: int
    gap_s: float
    duration_s: float
    amount: float


@dataclasses.dataclass(frozen=True)
class Interval:
    """A fault as it took place, in nanoseconds of the monotonic clock: until the system was whole again."""

    kind: str
    node: int
    begin_ns: int
    end_ns: int
    amount: float


def draw(seed: int, count: int, kinds: list[str], nodes: int) -> list[Fault]:
    """The faults of a seed: every kind as often as any other, in a random order."""
    chance = random.Random(seed)  # noqa: S311
    drawn = [kinds[number % len(kinds)] for number in range(count)]
    chance.shuffle(drawn)
    return [
        Fault(
            number, kind, chance.randrange(nodes), chance.uniform(*GAPS_S), chance.uniform(*DURATIONS_S),
            amount_of(kind, chance),
        )
        for number, kind in enumerate(drawn)
    ]  # fmt: skip


def amount_of(kind: str, chance: random.Random) -> float:
    """The parameter of a fault: an offset, a delay, or a lag, s."""
    amounts = {
        "clock-jump": CLOCK_OFFSETS_S,
        "clients-delay": DELAYS_S,
        "nodes-delay": DELAYS_S,
        "database-delay": DELAYS_S,
        "fail-over": LAGS_S,
        "slow-disk": SLOW_FLUSHES_S,
    }
    return chance.choice(amounts.get(kind, (0.0,)))


def kinds_for(cluster: Cluster, has_clock: bool) -> list[str]:
    """The kinds of faults that can be injected here."""
    backend = cluster.backend
    kinds = [kind for kind in ON_NODES if kind != "clock-jump" or has_clock]
    if len(cluster.nodes) > 1 or cluster.next_binary is not None:
        kinds.append("rolling-restart")
    if len(cluster.serving) > 1:
        kinds += ON_LINKS_BETWEEN_NODES
    if backend.disk.is_own:
        kinds.append("full-disk")
        if shutil.which("strace"):
            kinds.append("slow-disk")
    if isinstance(backend, PostgreSQL):
        kinds += [*ON_LINKS_TO_DATABASE, *ON_DATABASE]
        if backend.standby is not None:
            kinds.append("fail-over")
    return kinds


class Nemesis:
    """Injects faults into a cluster, a few at a time, and notes when each began and ended."""

    def __init__(self, cluster: Cluster, log: Path) -> None:
        self._cluster = cluster
        self._log = log
        self._locks: dict[str, threading.Lock] = {}
        self._slots = threading.Semaphore(MOST_AT_ONCE)
        self._writing = threading.Lock()
        self._failures: list[BaseException] = []
        self._ways: dict[str, Callable[[Fault], None]] = {
            "node-kill": self._node_kill, "node-stop": self._node_stop, "node-restart": self._node_restart,
            "rolling-restart": self._rolling_restart, "clock-jump": self._clock_jump, "full-disk": self._full_disk,
            "clients-cut": self._cut, "clients-reset": self._reset, "clients-delay": self._delay,
            "database-cut": self._cut, "database-reset": self._reset, "database-delay": self._delay,
            "database-kill": self._database_kill, "database-stop": self._database_stop,
            "database-terminate": self._database_terminate, "fail-over": self._fail_over,
            "slow-disk": self._slow_disk, "nodes-cut": self._cut, "nodes-reset": self._reset,
            "nodes-delay": self._delay, "burst": self._burst,
        }  # fmt: skip

    def run(self, faults: list[Fault]) -> None:
        """Injects them all, and waits until the last one is over.

        Raises:
            HarnessError: The system did not become whole after a fault.
        """
        threads = []
        for fault in faults:
            time.sleep(fault.gap_s)
            self._slots.acquire()
            if self._failures:
                break
            threads.append(threading.Thread(target=self._inject, args=(fault,), name=fault.kind, daemon=True))
            threads[-1].start()
        for thread in threads:
            thread.join()
        if self._failures:
            raise self._failures[0]

    def _inject(self, fault: Fault) -> None:
        try:
            with contextlib.ExitStack() as held:
                # In one order everywhere, so that two faults never wait for each other.
                for name in sorted(self._touched(fault)):
                    held.enter_context(self._locks.setdefault(name, threading.Lock()))
                begin_ns = time.monotonic_ns()
                self._ways[fault.kind](fault)
                self._note(fault, begin_ns)
        except BaseException as failure:
            self._failures.append(failure)
        finally:
            self._slots.release()

    def _note(self, fault: Fault, begin_ns: int) -> None:
        happened = Interval(fault.kind, self._node(fault).number, begin_ns, time.monotonic_ns(), fault.amount)
        with self._writing, self._log.open("a", encoding="utf-8") as log:
            log.write(json.dumps(dataclasses.asdict(happened)) + "\n")

    def _touched(self, fault: Fault) -> set[str]:
        """Names of what a fault has for itself."""
        node = self._node(fault).name
        if fault.kind in ON_DATABASE or fault.kind in ("full-disk", "fail-over"):
            return {"database"}
        if fault.kind == "slow-disk":
            return {"database"} if isinstance(self._cluster.backend, PostgreSQL) else {"database", node}
        if fault.kind == "rolling-restart":
            return {one.name for one in self._cluster.nodes}
        if fault.kind == "burst":
            return {"burst"}
        way = fault.kind.partition("-")[0]
        return {f"{way} of {node}"} if way in ("clients", "nodes", "database") else {node}

    def _node(self, fault: Fault) -> Node:
        return self._cluster.nodes[fault.node % len(self._cluster.nodes)]

    def _link(self, fault: Fault) -> Link:
        node = self._node(fault)
        links = {"clients": node.from_clients, "nodes": node.from_nodes, "database": node.to_database}
        link = links[fault.kind.partition("-")[0]]
        if link is None:
            raise ValueError(f"{fault.kind} needs a database with a way to it")
        return link

    @property
    def _postgres(self) -> PostgreSQL:
        if not isinstance(self._cluster.backend, PostgreSQL):
            raise TypeError("this fault needs PostgreSQL")
        return self._cluster.backend

    def _node_kill(self, fault: Fault) -> None:
        self._node(fault).kill()
        time.sleep(fault.duration_s)
        self._node(fault).start(self._cluster.environment)

    def _node_stop(self, fault: Fault) -> None:
        self._node(fault).pause()
        time.sleep(fault.duration_s)
        self._node(fault).resume()

    def _node_restart(self, fault: Fault) -> None:
        self._node(fault).terminate()
        self._node(fault).start(self._cluster.environment)

    def _rolling_restart(self, _fault: Fault) -> None:
        self._cluster.restart_all()

    def _clock_jump(self, fault: Fault) -> None:
        self._node(fault).set_clock(fault.amount)
        time.sleep(fault.duration_s)
        self._node(fault).set_clock(0.0)

    def _full_disk(self, fault: Fault) -> None:
        disk = self._cluster.backend.disk
        disk.fill()
        time.sleep(fault.duration_s)
        disk.free()
        if isinstance(self._cluster.backend, PostgreSQL):
            self._postgres.keep_running()

    def _slow_disk(self, fault: Fault) -> None:
        postgres = isinstance(self._cluster.backend, PostgreSQL)
        writer = self._postgres.primary.process if postgres else self._node(fault)
        writer.slow_flushes(fault.amount, fault.duration_s)

    def _cut(self, fault: Fault) -> None:
        self._cluster.network.set(self._link(fault), is_cut=True)
        time.sleep(fault.duration_s)
        self._cluster.network.set(self._link(fault))

    def _delay(self, fault: Fault) -> None:
        self._cluster.network.set(self._link(fault), delay_s=fault.amount)
        time.sleep(fault.duration_s)
        self._cluster.network.set(self._link(fault))

    def _reset(self, fault: Fault) -> None:
        end = time.monotonic() + fault.duration_s
        while time.monotonic() < end:
            self._cluster.network.reset(self._link(fault))
            time.sleep(4 * PAUSE_S)

    def _database_kill(self, fault: Fault) -> None:
        self._postgres.kill()
        time.sleep(fault.duration_s)
        self._postgres.keep_running()

    def _database_stop(self, fault: Fault) -> None:
        self._postgres.pause()
        time.sleep(fault.duration_s)
        self._postgres.resume()

    def _database_terminate(self, fault: Fault) -> None:
        end = time.monotonic() + fault.duration_s
        while time.monotonic() < end:
            self._postgres.end_connections()
            time.sleep(4 * PAUSE_S)

    def _burst(self, fault: Fault) -> None:
        # Straight to the node: the links carry the nodes' own connections, too.
        port = self._cluster.serving[fault.node % len(self._cluster.serving)].listens_at
        wanted = (port, self._cluster.admin_key, min(max(fault.duration_s, 1.0), 3.0))
        client = multiprocessing.get_context("spawn").Process(target=burst, args=wanted)
        client.start()
        client.join()

    def _fail_over(self, fault: Fault) -> None:
        if fault.amount > 0 and self._postgres.replication == "asynchronous":
            self._postgres.stop_replication()
            time.sleep(fault.amount)
        self._postgres.fail_over()
        self._postgres.replace_standby()


def read_intervals(log: Path) -> list[Interval]:
    """The faults of a run as they took place."""
    if not log.exists():
        return []
    return [Interval(**json.loads(line)) for line in log.read_text("utf-8").splitlines()]
