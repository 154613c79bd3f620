"""The servers of a run, each with own links to the database, from clients and from other nodes, and a balancer."""

import functools
import http.client
import json
import os
import threading
import time
from pathlib import Path
from signal import SIGCONT, SIGSTOP

from .api import exchange
from .backends import DataFolder, PostgreSQL
from .links import Network, free_port
from .processes import Process, checked, until

#: Of the registration of a node, and of a training run, s.
NODE_LEASE_S = 2
RUN_LEASE_S = 5
#: Longest orderly end of a node, s.
DRAIN_S = 4
#: What nodes do with requests for cameras of other nodes, by turns.
ON_OTHER_NODE = ("proxy", "redirect")
#: The database does not answer, or its disk is full: the server asks for a start later.
EXITS_TO_TRY_AGAIN = (3, 4)
FAKETIME = Path("/usr/lib/x86_64-linux-gnu/faketime/libfaketimeMT.so.1")
PANIC = "panicked at"


class Node:
    """A server process, started again after each end."""

    def __init__(
        self, number: int, role: str, folder: Path, network: Network, backend: DataFolder | PostgreSQL
    ) -> None:
        self.number = number
        self.role = role
        self.name = f"node-{number}"
        self.listens_at = free_port()
        self.from_clients = network.link(lambda: self.listens_at)
        #: Its advertised address: for other nodes, and for clients that they redirect.
        self.from_nodes = network.link(lambda: self.listens_at)
        self.to_database = network.link(backend.port) if isinstance(backend, PostgreSQL) else None
        self.log = folder / f"{self.name}.log"
        self.starts = 0
        #: Exit codes of ends that nobody asked for, or that were not orderly.
        self.unexpected_exits: list[int] = []
        self._folder = folder
        self._backend = backend
        self._clock = folder / f"{self.name}.clock"
        self._process: Process | None = None
        self._lock = threading.Lock()

    @property
    def url(self) -> str:
        """Where clients reach it, by its link."""
        return f"http://127.0.0.1:{self.from_clients.port}"

    @property
    def process_id(self) -> int | None:
        """The id of its process while it runs."""
        process = self._process
        return process.id if process is not None and process.exit_code() is None else None

    def start(self, environment: dict[str, str]) -> None:
        """Starts it and waits until it answers, as often as its exit code asks for it."""
        self.starts += 1
        self._process = self._spawn(environment)
        until(lambda: self._is_up(environment), f"{self.name} answers")

    def _spawn(self, environment: dict[str, str]) -> Process:
        self._clock.touch()
        clock = {
            "LD_PRELOAD": str(FAKETIME), "FAKETIME_TIMESTAMP_FILE": str(self._clock), "FAKETIME_CACHE_DURATION": "1",
            "FAKETIME_DONT_FAKE_MONOTONIC": "1", "NO_FAKE_STAT": "1",
        }  # fmt: skip
        database = self._backend.arguments(self.to_database.port if self.to_database else 0)
        command = [environment["SIGHTFIX"], "serve", "--listen", f"127.0.0.1:{self.listens_at}",
                   "--advertise", f"http://127.0.0.1:{self.from_nodes.port}", *database]  # fmt: skip
        own = {"SIGHTFIX_ROLE": self.role, "SIGHTFIX_CAMERA_ON_OTHER_NODE": ON_OTHER_NODE[self.number % 2]}
        own |= clock if FAKETIME.exists() else {}
        return Process(command, self.log, environment | own, self._folder)

    def _is_up(self, environment: dict[str, str]) -> bool:
        if self._process is not None and (code := self._process.exit_code()) is not None:
            if code not in EXITS_TO_TRY_AGAIN:
                self.unexpected_exits.append(code)
            self._process = self._spawn(environment)
        try:
            return exchange("GET", f"http://127.0.0.1:{self.listens_at}/livez", None, {}, 1.0)[0] == 200
        except (OSError, http.client.HTTPException):
            return False

    def kill(self) -> None:
        """Kills it."""
        if self._process is not None:
            self._note_end()
            self._process.kill()

    def terminate(self) -> None:
        """Ends it in order, and notes an exit code that is not 0."""
        if self._process is not None:
            self._note_end()
            code = self._process.terminate(DRAIN_S + 6)
            if code != 0:
                self.unexpected_exits.append(code)

    def _note_end(self) -> None:
        """Notes that it had ended by itself before."""
        code = self._process.exit_code() if self._process is not None else None
        if code is not None:
            self.unexpected_exits.append(code)

    def pause(self) -> None:
        """Stops it without ending it."""
        if self._process is not None:
            self._process.signal(SIGSTOP)

    def resume(self) -> None:
        """Lets it go on."""
        if self._process is not None:
            self._process.signal(SIGCONT)

    def slow_flushes(self, delay_s: float, duration_s: float) -> None:
        """Makes its disk slow for a while."""
        if self._process is not None:
            self._process.slow_flushes(delay_s, duration_s)

    def set_clock(self, offset_s: float) -> None:
        """Sets its wall clock ahead of or behind the machine's; seen within a second."""
        new = self._clock.with_suffix(".new")
        new.write_text(f"{offset_s:+.3f}\n", encoding="ascii")
        new.replace(self._clock)

    def panics(self) -> list[str]:
        """Lines of its log that tell of a panic."""
        return [line for line in self.log.read_text("utf-8", errors="replace").splitlines() if PANIC in line]


class Cluster:
    """All servers of a run."""

    def __init__(
        self, binary: Path, folder: Path, backend: DataFolder | PostgreSQL, roles: list[str], settings: dict[str, str],
        next_binary: str | None = None,
    ) -> None:  # fmt: skip
        self.backend = backend
        self.next_binary = next_binary
        self.network = Network()
        self.admin_key = checked(binary, "keys", "generate")
        self.environment = {
            "PATH": os.environ["PATH"], "SIGHTFIX": str(binary), "SIGHTFIX_ADMIN_KEY": self.admin_key,
            "SIGHTFIX_NODE_LEASE_S": str(NODE_LEASE_S), "SIGHTFIX_TRAINING__LEASE_S": str(RUN_LEASE_S),
            "SIGHTFIX_LIMITS__DRAIN_S": str(DRAIN_S), "SIGHTFIX_LOG_FORMAT": "json", "RUST_BACKTRACE": "1",
        } | settings  # fmt: skip
        self.nodes = [Node(number, role, folder, self.network, backend) for number, role in enumerate(roles, 1)]
        for node in self.nodes:
            node.start(self.environment)
        self.balancer = self.network.link(*[node.from_clients.own_port for node in self.serving])

    @property
    def serving(self) -> list[Node]:
        """The nodes that answer clients."""
        return [node for node in self.nodes if node.role != "train"]

    @property
    def url(self) -> str:
        """Where clients reach any node."""
        return f"http://127.0.0.1:{self.balancer.port}"

    def restart_all(self) -> None:
        """Ends and starts one node after the other, with the next program if there is one."""
        if self.next_binary is not None:
            self.environment["SIGHTFIX"] = self.next_binary
        for node in self.nodes:
            node.terminate()
            node.start(self.environment)

    def until_ready(self) -> None:
        """Waits until every serving node says that it is ready."""
        for node in self.serving:
            until(functools.partial(is_ready, node.url), f"{node.name} is ready")

    def stop(self) -> None:
        """Ends all servers in order."""
        for node in self.nodes:
            node.terminate()
        self.network.stop()

    def faults(self) -> list[str]:
        """What was wrong with the ends of processes."""
        faults = [f"{node.name} ended with exit code {code}" for node in self.nodes for code in node.unexpected_exits]
        return faults + [f"{node.name}: {line}" for node in self.nodes for line in node.panics()]


def is_ready(url: str) -> bool:
    """Whether a server answers that it can take work."""
    try:
        return exchange("GET", f"{url}/readyz", None, {}, 2.0)[0] == 200
    except (OSError, http.client.HTTPException):
        return False


def random_roles(nodes: int) -> list[str]:
    """Roles of the processes: with three or more, one only trains and one only serves."""
    return ["both"] * nodes if nodes < 3 else ["both"] * (nodes - 2) + ["serve", "train"]


def log_line(file: Path, **fields: object) -> None:
    """Appends a line of JSON with the time."""
    with file.open("a", encoding="utf-8") as output:
        output.write(json.dumps({"time_ns": time.monotonic_ns()} | fields) + "\n")
