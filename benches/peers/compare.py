"""sightfix beside service.py: the same requests, in turn, on this machine, as ratios.

    SIGHTFIX=target/release/sightfix python benches/peers/compare.py [--rounds 5] [--seconds 2] [--patience 120]

Run by the Python of requirements.txt; needs wrk. Prints tables in Markdown. Ends with an error if one of both does
not answer, answers wrongly, or fuses to worse positions than the fixes.
"""

import argparse
import csv
import http.client
import io
import json
import math
import os
import re
import shutil
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
SIGHTFIX = Path(os.environ.get("SIGHTFIX", HERE.parent.parent / "target/release/sightfix")).resolve()
ROWS = 10_000
SIGMA_M = 2.0
CAMERA = "square"
CONNECTIONS = 32
PER_REQUEST = 32
CORES = len(os.sched_getaffinity(0))
TICK_S = 1 / os.sysconf("SC_CLK_TCK")
METRES_PER_DEGREE = math.radians(6_371_008.8)
# Libraries of the usual PyTorch wheel that a machine without a graphics processor maps, but does not use.
OF_CUDA = re.compile(r"/nvidia/|cuda|cudnn|nccl|cublas|cupti|nvrtc|nvshmem|triton")


def fail(what: str) -> None:
    sys.exit(f"compare.py: {what}")


# Processes --------------------------------------------------------------------------------------------


def tree(root: int) -> list[int]:
    """A process and all that descend from it."""
    found = [root]
    for pid in found:
        try:
            for task in Path(f"/proc/{pid}/task").iterdir():
                found += map(int, (task / "children").read_text().split())
        except FileNotFoundError:
            pass
    return found


def cpu_s(root: int) -> float:
    """Processor time of a process and its descendants that live, with that of their ended threads."""
    # The clock of another process: what clock_getcpuclockid gives.
    return sum(time.clock_gettime((~pid << 3) | 2) for pid in tree(root))


def memory_mib(root: int) -> tuple[float, float]:
    """Resident memory of a tree, shared pages divided by those who share them; and that without CUDA's libraries."""
    whole = of_cuda = 0
    for pid in tree(root):
        mapped = ""
        for line in Path(f"/proc/{pid}/smaps").read_text().splitlines():
            name, _, rest = line.partition(" ")
            if not name.endswith(":"):
                mapped = line
            elif name == "Pss:":
                size = int(rest.split()[0])
                whole += size
                of_cuda += size if OF_CUDA.search(mapped) else 0
    return whole / 1024, (whole - of_cuda) / 1024


def level(root: int) -> None:
    """Gives all threads the priority of their process.

    sightfix trains at the lowest one, so that it does not disturb who is waited for; on a machine that others use, its
    time would be theirs. That needs the rights of an administrator; without them the time stays as it is.
    """
    for pid in tree(root):
        for thread in Path(f"/proc/{pid}/task").iterdir():
            try:
                of_process = os.getpriority(os.PRIO_PROCESS, pid)
                if os.getpriority(os.PRIO_PROCESS, int(thread.name)) > of_process:
                    os.setpriority(os.PRIO_PROCESS, int(thread.name), of_process)
            except ProcessLookupError:
                pass
            except PermissionError:
                Others.level = False


def busy_s() -> float:
    """Processor time that everything on this machine has used."""
    fields = list(map(int, Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:9]))
    return (sum(fields) - fields[3] - fields[4]) * TICK_S


class Patience:
    """What is left of the time that may be spent waiting for a quiet machine."""

    left_s = 0.0

    @classmethod
    def wait(cls) -> None:
        """Until others leave the processors alone, but no longer than that."""
        while cls.left_s > 0:
            before = busy_s()
            time.sleep(0.3)
            if (busy_s() - before) / 0.3 < 0.2 * CORES:
                return
            cls.left_s -= 0.3


class Others:
    """Share of the processors that others used while something was measured."""

    shares: list[float] = []
    level = True

    @classmethod
    @contextmanager
    def watched(cls, roots: list[int]) -> Iterator[None]:
        own = resource_s() + sum(map(cpu_s, roots))
        busy, began = busy_s(), time.monotonic()
        yield
        own = resource_s() + sum(map(cpu_s, roots)) - own
        busy, took = busy_s() - busy, time.monotonic() - began
        # The system counts in steps of TICK_S, too coarse for less.
        if took > 1:
            cls.shares.append(max(busy - own, 0) / (took * CORES))


def resource_s() -> float:
    """Processor time of this script and of the load clients that it has started."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


# The two sides ----------------------------------------------------------------------------------------


def free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


# By the clock, and by the processor time of the service, which others on the machine change less.
Figure = tuple[float, float | None]


@dataclass
class Side:
    """A service: how it is started and what differs in its answers."""

    name: str
    command: Callable[[int, Path], list[str]]
    data: Path
    workers: int = 1
    needs_camera: bool = False
    environment: Callable[[Path], dict[str, str]] = lambda _: {}
    port: int = 0
    process: subprocess.Popen[bytes] | None = None
    measures: dict[str, list[Figure]] = field(default_factory=dict)

    @property
    def pid(self) -> int:
        assert self.process is not None
        return self.process.pid

    def start(self, data: Path | None = None) -> Figure:
        """Starts it; gives the seconds until it first answers, and returns when all workers do."""
        data = data or self.data
        data.mkdir(parents=True, exist_ok=True)
        self.port = free_port()
        # Standard output goes to the file, too: a pipe that nobody reads would stop it.
        log = (data / "log.txt").open("wb")
        began = time.monotonic()
        self.process = subprocess.Popen(
            self.command(self.port, data), stdout=log, stderr=log, cwd=HERE, start_new_session=True,
            env={**os.environ, **self.environment(data)},
        )  # fmt: skip
        answered: Figure | None = None
        seen: set[int] = set()
        while len(seen) < self.workers:
            if self.process.poll() is not None or time.monotonic() - began > 120:
                fail(f"{self.name} does not start:\n{(data / 'log.txt').read_text()}")
            try:
                status, body = self.send("GET", "/readyz", connection=None)
            except OSError:
                time.sleep(0.001)
                continue
            if status == 200:
                answered = answered or (time.monotonic() - began, cpu_s(self.pid))
                seen.add(json.loads(body).get("pid", 0) if self.workers > 1 else 0)
            time.sleep(0.001)
        assert answered is not None
        return answered

    def stop(self) -> None:
        if self.process is None or self.process.poll() is not None:
            return
        self.process.send_signal(signal.SIGTERM)
        try:
            self.process.wait(20)
        except subprocess.TimeoutExpired:
            os.killpg(self.process.pid, signal.SIGKILL)
            self.process.wait()

    def send(
        self, method: str, path: str, body: bytes | None = None, kind: str = "application/json",
        connection: http.client.HTTPConnection | None = None,
    ) -> tuple[int, bytes]:  # fmt: skip
        over = connection or http.client.HTTPConnection("127.0.0.1", self.port, timeout=120)
        try:
            over.request(method, path, body, {"content-type": kind} if body is not None else {})
            answer = over.getresponse()
            return answer.status, answer.read()
        except http.client.HTTPException as error:
            raise OSError(str(error)) from error
        finally:
            if connection is None:
                over.close()

    def expect(self, status: int, method: str, path: str, body: bytes | None = None, kind: str = "application/json") -> Any:
        got, text = self.send(method, path, body, kind)
        if got != status:
            fail(f"{self.name}: {method} {path} gives {got}, not {status}: {text[:500]!r}")
        return json.loads(text)

    def add_camera(self, camera: str) -> None:
        if self.needs_camera:
            draft = {"id": camera, "image_size": {"width_px": 1280, "height_px": 720}}
            self.expect(201, "POST", "/v1/cameras", json.dumps(draft).encode())

    def import_rows(self, camera: str, body: bytes, kind: str) -> Figure:
        """Rows per second."""
        self.add_camera(camera)
        spent, began = cpu_s(self.pid), time.monotonic()
        imported = self.expect(200, "POST", f"/v1/cameras/{camera}/samples", body, kind)
        took = time.monotonic() - began
        if imported["accepted"] != ROWS:
            fail(f"{self.name} stored {imported} of {ROWS} rows")
        return ROWS / took, ROWS / (cpu_s(self.pid) - spent)

    def train(self, camera: str, wish: dict[str, Any]) -> Figure:
        """Seconds from the request until the run has succeeded."""
        spent, began = cpu_s(self.pid), time.monotonic()
        run = self.expect(202, "POST", f"/v1/cameras/{camera}/training-runs", json.dumps(wish).encode())
        path = f"/v1/cameras/{camera}/training-runs/{run['id']}"
        while run["state"] != "succeeded":
            if run["state"] not in ("queued", "running") or time.monotonic() - began > 600:
                fail(f"{self.name}: the training run does not succeed: {run}")
            time.sleep(0.05)
            level(self.pid)
            run = self.expect(200, "GET", path)
        return time.monotonic() - began, cpu_s(self.pid) - spent

    def load(self, bodies: Path, connections: int, seconds: int) -> tuple[Figure, Figure]:
        """Requests per second, and the 99th percentile of the latency in ms."""
        threads, spent = min(connections, CORES), cpu_s(self.pid)
        output = subprocess.run(
            ["wrk", "--timeout", "60", "-t", str(threads), "-c", str(connections), "-d", str(seconds),
             "-s", str(HERE / "fuse.lua"), f"http://127.0.0.1:{self.port}/v1/cameras/{CAMERA}/fusions", "--", str(bodies)],
            capture_output=True, text=True, check=False,
        )  # fmt: skip
        figures = re.search(r"^figures (\d+) (\d+) (\d+) (\d+) (\d+)$", output.stdout, re.MULTILINE)
        if figures is None:
            fail(f"wrk: {output.stdout}{output.stderr}")
            raise AssertionError
        requests, microseconds, broken, refused, late = map(int, figures.groups())
        if requests == 0 or broken or refused:
            fail(f"{self.name}: {requests} requests, {broken} without an answer, {refused} refused")
        return (requests / microseconds * 1e6, requests / (cpu_s(self.pid) - spent)), (late / 1000, None)

    def note(self, measure: str, value: Figure) -> None:
        self.measures.setdefault(measure, []).append(value)


# The scene --------------------------------------------------------------------------------------------


@dataclass
class World:
    csv: bytes
    json: bytes
    test: list[dict[str, str]]

    @classmethod
    def simulate(cls, folder: Path) -> "World":
        training, test = folder / "training.csv", folder / "test.csv"
        subprocess.run(
            [SIGHTFIX, "simulate", "square", "--out", training, "--test-out", test, "--samples", str(ROWS),
             "--gnss-sigma-m", str(SIGMA_M), "--quiet"], check=True,
        )  # fmt: skip
        # Both are told the receiver's error with every fix.
        rows = list(csv.DictReader(training.open()))
        names = ["time", "target_id", "left", "top", "width", "height", "longitude", "latitude", "sigma_m"]
        text = io.StringIO()
        writer = csv.DictWriter(text, names, extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        writer.writerows({**row, "sigma_m": SIGMA_M} for row in rows)
        samples = [{**observation(row), "target_id": row["target_id"]} for row in rows]
        return cls(text.getvalue().encode(), json.dumps(samples).encode(), list(csv.DictReader(test.open())))

    def bodies(self, folder: Path) -> tuple[Path, Path]:
        """Files of request bodies: one observation each, and PER_REQUEST each."""
        single, many = folder / "single.jsonl", folder / "many.jsonl"
        observations = [observation(row) for row in self.test]
        single.write_text("".join(json.dumps(one) + "\n" for one in observations))
        groups = [observations[at : at + PER_REQUEST] for at in range(0, len(observations), PER_REQUEST)]
        full = [group for group in groups if len(group) == PER_REQUEST]
        many.write_text("".join(json.dumps({"observations": group}) + "\n" for group in full))
        return single, many

    def distance_m(self, row: dict[str, str], longitude: float, latitude: float) -> float:
        north = latitude - float(row["truth_latitude"])
        east = (longitude - float(row["truth_longitude"])) * math.cos(math.radians(latitude))
        return math.hypot(east, north) * METRES_PER_DEGREE

    def fixes_m(self) -> float:
        return statistics.fmean(self.distance_m(row, float(row["longitude"]), float(row["latitude"])) for row in self.test)

    def errors(self, side: Side) -> tuple[float, float, float]:
        """Mean error of the fused and of the regressed positions, m, and share of true ones inside the radius."""
        body = json.dumps({"observations": [observation(row) for row in self.test]}).encode()
        answers = side.expect(200, "POST", f"/v1/cameras/{CAMERA}/fusions", body)["items"]
        if len(answers) != len(self.test):
            fail(f"{side.name}: {len(answers)} positions of {len(self.test)} observations")
        fused, regressed, inside = [], [], 0
        for row, answer in zip(self.test, answers, strict=True):
            fused.append(self.distance_m(row, answer["fused"]["longitude_deg"], answer["fused"]["latitude_deg"]))
            place = answer["regressed"]
            regressed.append(self.distance_m(row, place["longitude_deg"], place["latitude_deg"]))
            if not 0 <= answer["confidence_regression"] <= 1:
                fail(f"{side.name}: a confidence of {answer['confidence_regression']}")
            inside += fused[-1] <= answer["r95_m"]
        return statistics.fmean(fused), statistics.fmean(regressed), inside / len(answers)


def observation(row: dict[str, str]) -> dict[str, Any]:
    box = {f"{side}_px": float(row[side]) for side in ("left", "top", "width", "height")}
    fix = {"longitude_deg": float(row["longitude"]), "latitude_deg": float(row["latitude"]), "sigma_m": SIGMA_M}
    return {"time": row["time"], "bounding_box": box, "fix": fix}


# Measurement ------------------------------------------------------------------------------------------


def copy_of(data: Path, into: Path) -> Path:
    shutil.rmtree(into, ignore_errors=True)
    shutil.copytree(data, into)
    return into


def main() -> None:
    parser = argparse.ArgumentParser(description="sightfix beside service.py, as ratios of one run")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=int, default=2, help="of each load")
    parser.add_argument("--patience", type=float, default=120, help="seconds to wait for a quiet machine, in all")
    options = parser.parse_args()
    # So that the services end with this script.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit("compare.py: ended by a signal"))
    if not SIGHTFIX.is_file():
        fail(f"{SIGHTFIX} is not there; build it with cargo build --release, or set SIGHTFIX")
    if shutil.which("wrk") is None:
        fail("wrk is not installed")
    with tempfile.TemporaryDirectory() as folder:
        sides = [
            Side("sightfix", lambda port, data: [str(SIGHTFIX), "serve", "--listen", f"127.0.0.1:{port}", "--data", str(data)],
                 Path(folder) / "sightfix", needs_camera=True),
            Side("FastAPI", lambda port, _: [sys.executable, "-m", "uvicorn", "service:app", "--port", str(port),
                 "--workers", str(CORES), "--no-access-log", "--log-level", "warning"],
                 Path(folder) / "service", workers=CORES, environment=lambda data: {"SERVICE_DATA": str(data)}),
        ]  # fmt: skip
        try:
            compare(options, sides, Path(folder))
        finally:
            for side in sides:
                side.stop()


# Name, heading, unit, and whether less is better.
MEASURES = [
    ("single", "fuse, 1 connection", "requests/s", False),
    ("many", f"fuse, {CONNECTIONS} connections", "requests/s", False),
    ("late", "99th percentile of the latency of these", "ms", True),
    ("batch", f"fuse, {CONNECTIONS} connections, {PER_REQUEST} observations each", "observations/s", False),
    ("csv", f"import of {ROWS:,} rows, CSV", "rows/s", False),
    ("json", f"import of {ROWS:,} rows, JSON", "rows/s", False),
    ("train", "training, `auto` beside the one net", "s", True),
    ("hybrid", "training, `hybrid` with 100 epochs beside the one net", "s", True),
    ("start", "start until the first answer, with a trained camera", "s", True),
    ("idle", "memory after the start", "MiB", True),
    ("idle_own", "the same without CUDA's libraries", "MiB", True),
    ("after", "memory after all rounds so far", "MiB", True),
    ("after_own", "the same without CUDA's libraries", "MiB", True),
]


def compare(options: argparse.Namespace, sides: list[Side], folder: Path) -> None:
    world = World.simulate(folder)
    single, many = world.bodies(folder)
    ours, peer = sides
    for side in sides:
        side.start()
        side.import_rows(CAMERA, world.csv, "text/csv")
        side.train(CAMERA, {})
    time.sleep(1)  # until every worker of the peer has the model

    print("| | fused, mean error | regressed, mean error | true positions inside `r95_m` |\n|---|---:|---:|---:|")
    fixes_m = world.fixes_m()
    for side in sides:
        fused, regressed, inside = world.errors(side)
        print(f"| {side.name} | {fused:.2f} m | {regressed:.2f} m | {inside:.0%} |", flush=True)
        if not fused < fixes_m:
            fail(f"{side.name}: the fused positions are off by {fused:.2f} m, the fixes by {fixes_m:.2f} m")
    print(f"| the fixes alone | {fixes_m:.2f} m | | |\n", flush=True)

    fresh = {
        side.name: Side(side.name, side.command, folder / f"fresh-{side.name}", side.workers, side.needs_camera, side.environment)
        for side in sides
    }
    for round_ in range(options.rounds + 1):
        Patience.left_s = options.patience / options.rounds if round_ else 0
        # The first round warms both up and does not count; both have trained before.
        in_turn = sides if round_ % 2 else sides[::-1]
        for name in ("single", "many", "batch", "csv", "json", "train", "start"):
            if name == "train" and not round_:
                continue
            for side in in_turn:
                Patience.wait()
                # A start ends the processes that it began, so their time could not be told from that of others.
                watched = nullcontext() if name == "start" else Others.watched([each.pid for each in sides])
                with watched:
                    figures = measure(name, side, fresh[side.name], world, single, many, round_, options.seconds)
                if round_:
                    for key, value in figures.items():
                        side.note(key, value)
                    print(f"round {round_}: {side.name}: {figures}", file=sys.stderr)
        for side in sides:
            whole, own = memory_mib(side.pid)
            if round_:
                side.note("after", (whole, None))
                side.note("after_own", (own, None))
    table(ours, peer)
    shares = sorted(Others.shares)
    if not Others.level:
        print("\nThe training times of sightfix are at its low priority: this user may not raise it.")
    print(
        f"\nMedian of {options.rounds} rounds in turn on {CORES} cores; other processes used "
        f"{statistics.median(shares):.0%} of them while measuring (median; {shares[0]:.0%} to {shares[-1]:.0%})."
    )


def measure(
    name: str, side: Side, fresh: Side, world: World, single: Path, many: Path, round_: int, seconds: int
) -> dict[str, Figure]:  # fmt: skip
    camera = f"{name}-{round_}"
    match name:
        case "single":
            return {"single": side.load(single, 1, seconds)[0]}
        case "many":
            rate, late = side.load(single, CONNECTIONS, seconds)
            return {"many": rate, "late": late}
        case "batch":
            clock, spent = side.load(many, CONNECTIONS, seconds)[0]
            return {"batch": (clock * PER_REQUEST, spent * PER_REQUEST if spent else None)}
        case "csv":
            return {"csv": side.import_rows(camera, world.csv, "text/csv")}
        case "json":
            return {"json": side.import_rows(camera, world.json, "application/json")}
        case "train" if side.needs_camera:
            return {
                "train": side.train(CAMERA, {}),
                "hybrid": side.train(f"csv-{round_}", {"recipe": "hybrid", "epochs": 100}),
            }
        case "train":
            took = side.train(CAMERA, {})
            return {"train": took, "hybrid": took}
        case "start":
            try:
                started = fresh.start(copy_of(side.data, fresh.data))
                world.errors(fresh)
                whole, own = memory_mib(fresh.pid)
            finally:
                fresh.stop()
            return {"start": started, "idle": (whole, None), "idle_own": (own, None)}
    raise AssertionError(name)


def table(ours: Side, peer: Side) -> None:
    print(f"| case | unit | {ours.name} | {peer.name} | ratio | min | max | ratio by processor time |")
    print("|---|---|---:|---:|---:|---:|---:|---:|")
    for name, heading, unit, less in MEASURES:
        pairs = list(zip(ours.measures[name], peer.measures[name], strict=True))
        ratios = sorted(a / b for (a, _), (b, _) in pairs)
        spent = [a / b for (_, a), (_, b) in pairs if a and b]
        medians = [statistics.median(clock for clock, _ in side.measures[name]) for side in (ours, peer)]
        cells = [*medians, statistics.median(ratios), ratios[0], ratios[-1]]
        cells += [statistics.median(spent)] if spent else []
        note = ", less is better" if less else ""
        print(f"| {heading}{note} | {unit} | {' | '.join(map(figure, cells))} |{'' if spent else ' |'}")


def figure(value: float) -> str:
    """Three digits that count."""
    if value >= 1000:
        return f"{value:,.0f}"
    digits = 0 if value >= 100 else 1 if value >= 10 else 2 if value >= 1 else 3
    return f"{value:.{digits}f}"


if __name__ == "__main__":
    main()
