"""One run: servers, clients and faults, and what is stored after them."""

import contextlib
import dataclasses
import multiprocessing
import multiprocessing.process
import os
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from .api import Api
from .backends import DataFolder, PostgreSQL
from .checks import STALE_S
from .client import Setting, Ways
from .cluster import FAKETIME, Cluster, random_roles
from .links import free_port
from .nemesis import Nemesis, draw, kinds_for
from .planted import Plant, Proxy, StreamProxy
from .processes import HarnessError, until
from .record import Recorder
from .workloads import STORING, names, prepare, run, runs_of

ROOT = Path(__file__).resolve().parents[2]
MODEL = ROOT / "models" / "demo-square.safetensors"
#: Settings of the servers: nothing that is checked at the end is deleted for want of space.
SETTINGS = {
    "SIGHTFIX_LIMITS__ENDED_RUNS_PER_CAMERA": "100000", "SIGHTFIX_LIMITS__MODELS_PER_CAMERA": "100000",
    "SIGHTFIX_LIMITS__KEYS": "100000", "SIGHTFIX_LIMITS__AUDIT_ENTRIES": "10000000",
    "SIGHTFIX_LIMITS__RESERVE_BYTES": "4194304",
}  # fmt: skip
#: Rows of the camera that is trained, and passes over them: a run takes seconds.
TRAINING_ROWS = 600
EPOCHS = 400
#: Time for runs and deliveries that are under way at the end, s.
END_S = 600.0


@dataclasses.dataclass(frozen=True)
class Options:
    """What kind of run it is."""

    seed: int
    faults: int
    backend: str
    nodes: int
    replication: str
    kinds: list[str]
    #: Without faults before the clients end: whatever was under way comes to its end, s.
    settle_s: float
    #: The program from the first rolling restart on, where it is another one.
    next: str | None = None
    #: Pauses of the clients are so many times as long.
    pause_factor: float = 1.0


def binary() -> Path:
    """The program under test.

    Raises:
        HarnessError: It was not built.
    """
    found = Path(os.environ.get("SIGHTFIX", ROOT / "target" / "debug" / "sightfix")).resolve()
    if not found.exists():
        raise HarnessError(f"{found} is not there: cargo build, or set SIGHTFIX")
    return found


def training_rows(program: Path, folder: Path) -> bytes:
    """Simulated samples to train on."""
    csv = folder / "train.csv"
    subprocess.run([program, "simulate", "square", "--out", csv, "--samples", str(TRAINING_ROWS), "--test-out",
                    folder / "test.csv", "--test-samples", "10"], check=True, capture_output=True)  # fmt: skip
    return csv.read_bytes()


def pages(api: Api, path: str) -> list[dict[str, Any]]:
    """All items of a list."""
    items: list[dict[str, Any]] = []
    cursor = ""
    while True:
        separator = "&" if "?" in path else "?"
        answer = page_of(api, f"{path}{separator}limit=1000{cursor}")
        items += answer["items"]
        if not answer.get("next_cursor"):
            return items
        cursor = f"&cursor={answer['next_cursor']}"


def page_of(api: Api, path: str) -> Any:
    """An answer, asked for again as long as a node cannot give it: on a busy machine one may lose its lease.

    Raises:
        HarnessError: It does not come.
    """
    end = time.monotonic() + END_S
    while not (page := api.send("page", path, "GET", path, keep=lambda answer, _: answer)).is_done:
        if time.monotonic() > end:
            raise HarnessError(f"{path}: {page.status} {page.answer}")
        time.sleep(1.0)
    return page.answer


def read_final_state(cluster: Cluster, ways: Ways, folder: Path) -> None:
    """Records what is stored at the end, and what every node answers."""
    recorder = Recorder(folder / "final.ndjson", "final")
    unrecorded = Api(ways.url, cluster.admin_key, Recorder(Path(os.devnull), "final"), timeout_s=60)
    runs = "/v1/cameras/runs/training-runs"
    until(lambda: not any(run[1] in ("queued", "running", "cancelling") for run in final_runs(unrecorded, runs)),
          "every run ends", END_S)  # fmt: skip
    until(lambda: is_delivered(cluster, unrecorded), "the outbox is empty", END_S)
    for camera in (name for name in names() if name.startswith(STORING)):
        rows = pages(unrecorded, f"/v1/cameras/{camera}/samples")
        found = [[row["time"], row["bounding_box"]["left_px"]] for row in rows]
        recorder.note("list-samples" if camera.startswith(STORING[0]) else "list-streamed", camera, {}, found)
    recorder.note("final-runs", "runs", {}, final_runs(unrecorded, runs))
    outcomes = [[run["id"], run["outcome"]] for run in pages(unrecorded, runs) if run["state"] == "failed"]
    recorder.note("final-failures", "runs", {}, outcomes)
    models = pages(unrecorded, "/v1/cameras/runs/models")
    recorder.note("final-models", "runs", {}, [[model["number"], model.get("run_id")] for model in models])
    entries = pages(unrecorded, "/v1/audit")
    log = [[entry.get("request_id"), entry["action"], entry["number"]] for entry in entries]
    recorder.note("final-audit", "", {}, log)
    # Until now a node may answer by what it read before the last change.
    time.sleep(STALE_S)
    read_nodes(ways, Api(ways.url, cluster.admin_key, recorder, timeout_s=30))


def final_runs(api: Api, path: str) -> list[list[Any]]:
    """All training runs."""
    return list(runs_of({"items": pages(api, path)}, {}))


def is_delivered(cluster: Cluster, api: Api) -> bool:
    """Whether nothing waits for the receiver of webhooks, whichever node is asked."""
    for node in cluster.serving:
        status = api.send("page", "hook", "GET", "/v1/connections/hook", base=node.url, keep=lambda answer, _: answer)
        if not status.is_done or status.answer["status"]["queued"] > 0:
            return False
    return True


def read_nodes(ways: Ways, api: Api) -> None:
    """Asks every node for the registers."""
    box = {"left_px": 475, "top_px": 11, "width_px": 28, "height_px": 77}
    body = {"observations": [{"time": "2020-01-01T00:00:00Z", "bounding_box": box}]}
    for node in ways.node_urls:
        of = {"node": node}
        api.send("final-profile", "profile", "GET", "/v1/cameras/profile", arguments=of, base=node,
                 keep=lambda answer, headers: [headers.get("etag"), answer["display_name"]])  # fmt: skip
        api.send("final-active", "active", "GET", "/v1/cameras/active/active-model", arguments=of, base=node,
                 keep=lambda answer, _: answer["number"])  # fmt: skip
        api.send("final-fusion", "active", "POST", "/v1/cameras/active/fusions", body, arguments=of, base=node,
                 keep=lambda answer, _: answer["items"][0]["model_version"])  # fmt: skip


@contextlib.contextmanager
def servers(options: Options, folder: Path, settings: dict[str, str]) -> Iterator[Cluster]:
    """Servers and their database for as long as it is entered; both are removed at the end.

    Raises:
        HarnessError: They do not start.
    """
    program = binary()
    (folder / "history").mkdir(parents=True)
    backend = DataFolder(folder) if options.backend == "folder" else PostgreSQL(folder, options.replication)
    try:
        cluster = Cluster(program, folder, backend, random_roles(options.nodes), settings, options.next)
        try:
            yield cluster
        finally:
            cluster.stop()
    finally:
        backend.stop()


def make_history(options: Options, folder: Path, planted: list[Plant]) -> list[str]:
    """Runs servers, clients and faults; gives what was wrong with the processes themselves.

    Raises:
        HarnessError: The run could not be made, or the system did not become whole after the faults.
    """
    with servers(options, folder, SETTINGS) as cluster:
        hook_port = free_port()
        ways = through(planted, cluster, hook_port)
        with clients_at_work(options, cluster, ways, folder, hook_port) as clients:
            kinds = options.kinds or kinds_for(cluster, FAKETIME.exists())
            faults = draw(options.seed, options.faults, kinds, len(cluster.nodes))
            Nemesis(cluster, folder / "faults.ndjson").run(faults)
            cluster.until_ready()
            time.sleep(options.settle_s)
            clients.end()
            read_final_state(cluster, ways, folder / "history")
        if any(plant.place == "process" for plant in planted):
            os.kill(cluster.nodes[0].process_id or 0, signal.SIGKILL)
            time.sleep(1.0)
    return cluster.faults()


def through(planted: list[Plant], cluster: Cluster, hook_port: int) -> Ways:
    """The ways of clients and webhooks, through the plants on them."""
    nodes = [node.url for node in cluster.serving]
    at = {
        place: [plant for plant in planted if plant.place == place] for place in ("clients", "streams", "hook", "node")
    }
    return Ways(
        Proxy(cluster.url, at["clients"]).url if at["clients"] else cluster.url,
        StreamProxy(cluster.url).url if at["streams"] else cluster.url,
        [*nodes, *([Proxy(nodes[0], at["node"]).url] if at["node"] else [])],
        Proxy(f"http://127.0.0.1:{hook_port}", at["hook"]).port if at["hook"] else hook_port,
    )


class Clients:
    """The processes of the clients."""

    def __init__(self, settings: list[Setting]) -> None:
        context = multiprocessing.get_context("spawn")
        self._ending, self._all_over = context.Event(), context.Event()
        self._processes = [
            # The receiver of webhooks stays until all is delivered.
            context.Process(target=run, args=(one, self._all_over if is_receiver(one) else self._ending))
            for one in settings
        ]
        for process in self._processes:
            process.start()
        until(lambda: all((one.history / f"{one.client}.ndjson").exists() for one in settings), "every client works")

    def end(self) -> None:
        """Ends all but the receiver of webhooks.

        Raises:
            HarnessError: One does not end, or has failed.
        """
        self._ending.set()
        for process in self._processes[:-1]:
            join(process)

    def end_receiver(self) -> None:
        """Ends the receiver of webhooks, and all others where they have not ended."""
        self._all_over.set()
        self._ending.set()
        for process in self._processes:
            process.join(END_S)
            process.terminate()


def is_receiver(setting: Setting) -> bool:
    """Whether a client receives webhooks."""
    return setting.client.startswith("hooks")


@contextlib.contextmanager
def clients_at_work(options: Options, cluster: Cluster, ways: Ways, folder: Path, hook_port: int) -> Iterator[Clients]:
    """Clients at work for as long as it is entered, on what they need."""
    history = folder / "history"
    api = Api(cluster.url, cluster.admin_key, Recorder(history / "setup.ndjson", "setup"), timeout_s=30)
    prepare(api, MODEL.read_bytes(), training_rows(binary(), folder), ways.hook_port)
    clients = Clients(
        [
            Setting(name, ways, cluster.admin_key, options.seed, history, EPOCHS, hook_port, options.pause_factor)
            for name in names()
        ]
    )
    try:
        yield clients
    finally:
        clients.end_receiver()


def join(client: multiprocessing.process.BaseProcess) -> None:
    """Waits for a client.

    Raises:
        HarnessError: It does not end, or has failed.
    """
    client.join(60)
    if client.exitcode != 0:
        raise HarnessError(f"client {client.name} ended with {client.exitcode}")
