"""The costs of many cameras: start and memory of a node, and in a cluster idle polls and activation on every node.

Usage: python3 benches/cluster/many_cameras.py PLACE [CAMERAS]

PLACE is the URL of an empty PostgreSQL database on this machine (psql is needed), or a data folder, or one of these that an earlier run has filled. A release
build is needed (SIGHTFIX, by default target/release/sightfix). One simulated camera is trained; the others have a copy of its model. On PostgreSQL
three nodes answer and two processes train. Prints a Markdown table.
"""

import json
import os
import socket
import sqlite3
import statistics
import subprocess
import sys
import tempfile
import time
import urllib.request
from contextlib import closing
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

SERVING, TRAINING = 3, 2
IDLE_S = 20
ACTIVATIONS = 20
LONGEST_S = 30
STARTS = 9
TICKS = os.sysconf("SC_CLK_TCK")
BINARY = os.environ.get("SIGHTFIX", "target/release/sightfix")

COPIES = """
WITH RECURSIVE numbers (number) AS (SELECT 2 UNION ALL SELECT number + 1 FROM numbers WHERE number < {cameras})
INSERT INTO cameras (id, profile, learn_automatically, updated_at_us, created_at_us, revision, last_model_number)
SELECT 'copy-' || number, profile, learn_automatically, updated_at_us, created_at_us, revision, last_model_number
FROM cameras, numbers WHERE id = 'trained';
INSERT INTO sample_counts (camera_key, samples, without_fix) SELECT key, 0, 0 FROM cameras WHERE id LIKE 'copy-%';
INSERT INTO models (camera_key, number, created_at_us, metadata, weights, sha256)
SELECT cameras.key, number, models.created_at_us, metadata, weights, sha256 FROM models, cameras
WHERE camera_key = (SELECT key FROM cameras WHERE id = 'trained') AND number = 1 AND cameras.id LIKE 'copy-%';
UPDATE cameras SET active_model = 1 WHERE id LIKE 'copy-%';
ANALYZE;
"""


def is_folder(place: str) -> bool:
    return "://" not in place


def sql(place: str, statement: str) -> str:
    if is_folder(place):
        with closing(sqlite3.connect(Path(place) / "sightfix.db")) as database:
            database.executescript(statement)
        return ""
    answer = subprocess.run(
        ["psql", place, "-v", "ON_ERROR_STOP=1", "-AtqX", "-c", statement], check=True, text=True, stdout=subprocess.PIPE
    )
    return answer.stdout.strip()


def sightfix(*arguments: str, **environment: str) -> None:
    subprocess.run([BINARY, "--quiet", *arguments], check=True, env=os.environ | environment, stdout=subprocess.DEVNULL)


def stored_in(place: str) -> dict[str, str]:
    return {"SIGHTFIX_DATA" if is_folder(place) else "SIGHTFIX_DATABASE": place}


def is_filled(place: str) -> bool:
    if is_folder(place):
        return (Path(place) / "sightfix.db").exists()
    return sql(place, "SELECT to_regclass('cameras') IS NULL") == "f"


def fill(place: str, cameras: int) -> None:
    """One trained camera, and copies of it."""
    with tempfile.TemporaryDirectory() as folder:
        sightfix("simulate", "square", "--out", f"{folder}/train.csv", "--seed", "7")
        sightfix("import", f"{folder}/train.csv", "--camera", "trained", "--create", **stored_in(place))
        for seed in ["1", "2"]:
            sightfix("train", "--camera", "trained", "--seed", seed, **stored_in(place))
    sql(place, COPIES.format(cameras=cameras))


def free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


class Node:
    """A process of the cluster."""

    def __init__(self, place: str, role: str, folder: Path, cameras: int) -> None:
        self.port = free_port()
        settings = folder / f"{self.port}.toml"
        settings.write_text(f'role = "{role}"\n[limits]\ncameras = {2 * cameras}\n')
        self.began = time.monotonic()
        with (folder / f"{self.port}.log").open("w") as log:
            self.process = subprocess.Popen(
                [BINARY, "--config", str(settings), "serve", "--listen", f"127.0.0.1:{self.port}"],
                env=os.environ | stored_in(place),
                stdout=log,
                stderr=log,
            )

    def ask(self, path: str, body: object = None, method: str | None = None) -> dict:
        data = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(
            f"http://127.0.0.1:{self.port}{path}", data, {"content-type": "application/json"}, method=method
        )
        with urllib.request.urlopen(request, timeout=60) as answer:
            text = answer.read()
        return json.loads(text) if text[:1] == b"{" else {}

    def wait(self) -> float:
        """Seconds from its start until it is ready."""
        while True:
            assert self.process.poll() is None, "the node has ended"
            try:
                self.ask("/readyz")
                return time.monotonic() - self.began
            except OSError:
                time.sleep(0.02)

    def version(self, observation: dict) -> int:
        """The version by which it answers."""
        return self.ask("/v1/cameras/trained/fusions", observation)["items"][0]["model_version"]

    def resident_mib(self) -> float:
        status = Path(f"/proc/{self.process.pid}/status").read_text()
        return int(next(line for line in status.splitlines() if line.startswith("VmRSS")).split()[1]) / 1024

    def cpu_s(self) -> float:
        return cpu_s(self.process.pid)


def cpu_s(pid: int) -> float:
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    except FileNotFoundError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / TICKS


def postgres_cpu_s() -> float:
    pids = subprocess.run(["pgrep", "-x", "postgres"], text=True, stdout=subprocess.PIPE).stdout.split()
    return sum(cpu_s(int(pid)) for pid in pids)


def activations(nodes: list[Node]) -> list[float]:
    """Seconds from the answer of an activation until every node answers by it."""
    box = {"left_px": 900, "top_px": 500, "width_px": 60, "height_px": 150}
    observation = {"time": "2026-01-01T00:00:00Z", "target_id": "t", "bounding_box": box}
    seconds = []
    for number in range(ACTIVATIONS):
        version = 2 - number % 2
        nodes[number % len(nodes)].ask("/v1/cameras/trained/active-model", {"number": version}, "PUT")
        began = time.monotonic()
        waiting = list(nodes)
        while waiting:
            assert time.monotonic() < began + LONGEST_S, "a node goes on with the version before"
            waiting = [node for node in waiting if node.version(observation) != version]
            time.sleep(0.01)
        seconds.append(time.monotonic() - began)
    return seconds


def of_one_node(folder: str, settings: Path, cameras: int) -> None:
    started, computed, resident = [], [], []
    for _ in range(STARTS):
        node = Node(folder, "both", settings, cameras)
        started.append(node.wait())
        computed.append(node.cpu_s())
        resident.append(node.resident_mib())
        node.process.terminate()
        node.process.wait(30)
    print(f"| {cameras:,} cameras, {STARTS} starts of one node | median | least | most |\n|---|---:|---:|---:|")
    for title, values in [("until it is ready, s", started), ("CPU time, s", computed), ("memory, MiB", resident)]:
        print(f"| {title} | {statistics.median(values):.2f} | {min(values):.2f} | {max(values):.2f} |")


def of_a_cluster(url: str, settings: Path, cameras: int) -> None:
    nodes, workers = [Node(url, "serve", settings, cameras)], []
    alone_s = nodes[0].wait()
    print(f"| {cameras:,} cameras, {SERVING} serving and {TRAINING} training processes | |\n|---|---:|")
    print(f"| start of a serving node until it is ready | {alone_s:.1f} s |")
    print(f"| of it CPU time of the node | {nodes[0].cpu_s():.1f} s |")
    try:
        nodes += [Node(url, "serve", settings, cameras) for _ in range(SERVING - 1)]
        workers = [Node(url, "train", settings, cameras) for _ in range(TRAINING)]
        with ThreadPoolExecutor() as waiting:
            started = list(waiting.map(Node.wait, [*nodes[1:], *workers]))
        nodes_s, workers_s = started[: SERVING - 1], started[SERVING - 1 :]
        print(f"| start of {SERVING - 1} more at once, slowest | {max(nodes_s):.1f} s |")
        print(f"| start of {TRAINING} training processes beside them, slowest | {max(workers_s):.1f} s |")
        print(f"| memory of a serving node | {nodes[0].resident_mib():.0f} MiB |")
        print(f"| memory of a training process | {workers[0].resident_mib():.0f} MiB |")
        time.sleep(5)
        before = [node.cpu_s() for node in [*nodes, *workers]], postgres_cpu_s()
        time.sleep(IDLE_S)
        after = [node.cpu_s() for node in [*nodes, *workers]], postgres_cpu_s()
        idle = [100 * (late - early) / IDLE_S for early, late in zip(before[0], after[0])]
        print(f"| idle: CPU of a serving node | {statistics.mean(idle[:SERVING]):.1f} % of a core |")
        print(f"| idle: CPU of a training process | {statistics.mean(idle[SERVING:]):.1f} % of a core |")
        database = 100 * (after[1] - before[1]) / IDLE_S
        print(f"| idle: CPU of the database for all {SERVING + TRAINING} | {database:.1f} % of a core |")
        seconds = sorted(activations(nodes))
        print(
            f"| activation until all serving nodes answer by it, {len(seconds)} times, p50 and slowest "
            f"| {statistics.median(seconds):.1f} s, {seconds[-1]:.1f} s |"
        )
    finally:
        for node in [*nodes, *workers]:
            node.process.terminate()
        for node in [*nodes, *workers]:
            node.process.wait(30)


def main() -> None:
    place, cameras = sys.argv[1], int(sys.argv[2]) if len(sys.argv) > 2 else 100_000
    if not is_filled(place):
        fill(place, cameras)
    with tempfile.TemporaryDirectory() as settings:
        measure = of_one_node if is_folder(place) else of_a_cluster
        measure(place, Path(settings), cameras)


main()
