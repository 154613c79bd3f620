"""The command: a run with faults, or the check of a history that is there."""

import argparse
import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from .api import Api
from .backends import REPLICATIONS, DataFolder, PostgreSQL
from .checks import History, check
from .cluster import FAKETIME, Cluster, random_roles
from .links import free_port
from .nemesis import Nemesis, draw, kinds_for, read_intervals
from .processes import HarnessError, until
from .record import Recorder, read_operations
from .workloads import Setting, names, prepare, run, runs_of

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
EPOCHS = 800
#: Without faults before the clients end: whatever was under way comes to its end, s.
SETTLE_S = 6.0
#: Time for runs and deliveries that are under way at the end, s.
END_S = 180.0


def arguments() -> argparse.Namespace:
    """What the command line says."""
    parser = argparse.ArgumentParser(
        prog="tests/histories/run", description="Checks histories of sightfix under faults."
    )
    parser.add_argument("--seed", type=int, default=1, help="everything random of clients and faults comes from it")
    parser.add_argument("--faults", type=int, default=20, help="number of faults")
    parser.add_argument("--backend", choices=("folder", "postgres"), default="folder")
    parser.add_argument("--nodes", type=int, help="server processes, 1 to 5; 3 on postgres, 1 on a folder")
    parser.add_argument("--replication", choices=REPLICATIONS, default="none", help="of postgres, with fail-overs")
    parser.add_argument("--kinds", nargs="*", help="only these kinds of faults")
    parser.add_argument("--out", type=Path, help="folder of the history; must not exist")
    parser.add_argument("--check", type=Path, metavar="FOLDER", help="only check the history of a folder again")
    return parser.parse_args()


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
        page = api.send("page", path, "GET", f"{path}{separator}limit=1000{cursor}", keep=lambda answer, _: answer)
        if not page.is_done:
            raise HarnessError(f"{path}: {page.status} {page.answer}")
        items += page.answer["items"]
        if not page.answer.get("next_cursor"):
            return items
        cursor = f"&cursor={page.answer['next_cursor']}"


def read_final_state(cluster: Cluster, folder: Path) -> None:
    """Records what is stored at the end, and what every node answers."""
    recorder = Recorder(folder / "final.ndjson", "final")
    unrecorded = Api(cluster.url, cluster.admin_key, Recorder(Path(os.devnull), "final"), timeout_s=60)
    runs = "/v1/cameras/runs/training-runs"
    until(lambda: not any(run[1] in ("queued", "running", "cancelling") for run in final_runs(unrecorded, runs)),
          "every run ends", END_S)  # fmt: skip
    until(lambda: is_delivered(cluster, unrecorded), "the outbox is empty", END_S)
    for camera in (name for name in names() if name.startswith("samples-")):
        rows = pages(unrecorded, f"/v1/cameras/{camera}/samples")
        recorder.note("list-samples", camera, {}, [[row["time"], row["bounding_box"]["left_px"]] for row in rows])
    recorder.note("final-runs", "runs", {}, final_runs(unrecorded, runs))
    outcomes = [[run["id"], run["outcome"]] for run in pages(unrecorded, runs) if run["state"] == "failed"]
    recorder.note("final-failures", "runs", {}, outcomes)
    models = pages(unrecorded, "/v1/cameras/runs/models")
    recorder.note("final-models", "runs", {}, [[model["number"], model.get("run_id")] for model in models])
    entries = pages(unrecorded, "/v1/audit")
    log = [[entry.get("request_id"), entry["action"], entry["number"]] for entry in entries]
    recorder.note("final-audit", "", {}, log)
    read_nodes(cluster, recorder)


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


def read_nodes(cluster: Cluster, recorder: Recorder) -> None:
    """Asks every node for the registers."""
    api = Api(cluster.url, cluster.admin_key, recorder, timeout_s=30)
    box = {"left_px": 475, "top_px": 11, "width_px": 28, "height_px": 77}
    body = {"observations": [{"time": "2020-01-01T00:00:00Z", "bounding_box": box}]}
    for node in cluster.serving:
        of = {"node": node.url}
        api.send("final-profile", "profile", "GET", "/v1/cameras/profile", arguments=of, base=node.url,
                 keep=lambda answer, headers: [headers.get("etag"), answer["display_name"]])  # fmt: skip
        api.send("final-active", "active", "GET", "/v1/cameras/active/active-model", arguments=of, base=node.url,
                 keep=lambda answer, _: answer["number"])  # fmt: skip
        api.send("final-fusion", "active", "POST", "/v1/cameras/active/fusions", body, arguments=of, base=node.url,
                 keep=lambda answer, _: answer["items"][0]["model_version"])  # fmt: skip


def make_history(options: argparse.Namespace, folder: Path) -> list[str]:
    """Runs servers, clients and faults; gives what was wrong with the processes themselves."""
    program = binary()
    operations = folder / "history"
    operations.mkdir(parents=True)
    backend = DataFolder(folder) if options.backend == "folder" else PostgreSQL(folder, options.replication)
    try:
        cluster = Cluster(program, folder, backend, random_roles(options.nodes), SETTINGS)
        try:
            hook_port = free_port()
            api = Api(cluster.url, cluster.admin_key, Recorder(operations / "setup.ndjson", "setup"), timeout_s=30)
            prepare(api, MODEL.read_bytes(), training_rows(program, folder), hook_port)
            run_with_faults(options, cluster, folder, hook_port)
        finally:
            faults = cluster.stop()
    finally:
        backend.stop()
    return faults


def run_with_faults(options: argparse.Namespace, cluster: Cluster, folder: Path, hook_port: int) -> None:
    """Runs the clients and the faults, and reads the state after them."""
    context = multiprocessing.get_context("spawn")
    ending, all_over = context.Event(), context.Event()
    nodes = [node.url for node in cluster.serving]
    clients = []
    for name in names():
        setting = Setting(
            name, cluster.url, nodes, cluster.admin_key, options.seed, folder / "history", EPOCHS, hook_port
        )
        # The receiver of webhooks stays until all is delivered.
        is_receiver = name.startswith("hooks")
        clients.append(context.Process(target=run, args=(setting, all_over if is_receiver else ending), name=name))
        clients[-1].start()
    try:
        faults = draw(options.seed, options.faults, options.kinds or kinds_for(cluster, FAKETIME.exists()), len(nodes))
        Nemesis(cluster, folder / "faults.ndjson").run(faults)
        cluster.until_ready()
        time.sleep(SETTLE_S)
        ending.set()
        join([client for client in clients if not client.name.startswith("hooks")])
        read_final_state(cluster, folder / "history")
        all_over.set()
        join(clients)
    finally:
        for client in clients:
            client.terminate()


def join(clients: list[Any]) -> None:
    """Waits for clients.

    Raises:
        HarnessError: One does not end, or has failed.
    """
    for client in clients:
        client.join(60)
        if client.exitcode != 0:
            raise HarnessError(f"client {client.name} ended with {client.exitcode}")


def report(folder: Path, options: dict[str, Any], faults_of_processes: list[str]) -> bool:
    """Checks the history of a folder, writes and prints what was found; whether nothing was."""
    history = History(
        read_operations(folder / "history"), read_intervals(folder / "faults.ndjson"), options["replication"],
        options["backend"] == "folder",
    )  # fmt: skip
    found = check(history) | {"processes_end_as_they_should": faults_of_processes}
    unknown = sum(one.is_unknown for one in history.operations)
    refused = sum(one.is_refused for one in history.operations)
    summary = {
        "options": options, "faults": len(history.intervals), "operations": len(history.operations),
        "unknown": unknown, "refused": refused, "findings": found,
    }  # fmt: skip
    (folder / "report.json").write_text(json.dumps(summary, indent=1) + "\n", encoding="utf-8")
    print(f"{len(history.intervals)} faults, {len(history.operations)} operations, {unknown} of unknown outcome, "
          f"{refused} refused, seed {options['seed']}, {options['backend']}")  # fmt: skip
    for name, findings in found.items():
        print(f"  {'FOUND' if findings else 'holds'}  {name.replace('_', ' ')}")
        for finding in findings:
            print(f"         {finding}")
    print(f"history: {folder}")
    return not any(found.values())


def main() -> int:
    """Runs the command; 1 if a check has found something, 2 if the run could not be made."""
    options = arguments()
    # Servers and disks are removed at an end by a signal, too.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(2))
    try:
        if options.check is not None:
            before = json.loads((options.check / "report.json").read_text("utf-8"))
            return (
                0 if report(options.check, before["options"], before["findings"]["processes_end_as_they_should"]) else 1
            )
        most = DataFolder.most_nodes if options.backend == "folder" else PostgreSQL.most_nodes
        options.nodes = min(options.nodes or 3, most)
        folder = options.out or ROOT / "target" / "histories" / f"{options.backend}-{options.seed}-{int(time.time())}"
        faults = make_history(options, folder.resolve())
        shown = {name: str(value) if isinstance(value, Path) else value for name, value in vars(options).items()}
        return 0 if report(folder, shown, faults) else 1
    except HarnessError as error:
        print(f"the run could not be made: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
