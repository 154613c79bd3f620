"""Boxes of one broker with storing on, beside the same without: items per second, in turn, as a ratio.

    SIGHTFIX=target/release/sightfix python benches/peers/broker.py [--rounds 3] [--boxes 20000] [--rate 2000]

Needs mosquitto and its clients. Prints a table in Markdown. A round publishes boxes of twenty targets as fast as the broker
takes them, and a fix of each target every second of their time; it ends when the server has taken all of them. The last rounds
publish at the given rate, and tell how old boxes were at most when they came.
"""

import argparse
import json
import os
import socket
import statistics
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent.parent
SIGHTFIX = Path(os.environ.get("SIGHTFIX", ROOT / "target/release/sightfix")).resolve()
MODEL = ROOT / "models/demo-square.safetensors"
TARGETS = 20
FRAMES_PER_S = 5
PATIENCE_S = 120


def fail(what: str) -> None:
    sys.exit(f"broker.py: {what}")


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def running(command: list[str], port: int) -> Iterator[None]:
    """A process until the end of the block, from when it listens."""
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        until = time.monotonic() + PATIENCE_S
        while True:
            if process.poll() is not None or time.monotonic() > until:
                fail(f"{command[0]} does not start")
            try:
                socket.create_connection(("127.0.0.1", port), timeout=1).close()
                break
            except OSError:
                time.sleep(0.05)
        yield
    finally:
        process.terminate()
        process.wait()


class Server:
    """The REST interface of a running server."""

    def __init__(self, port: int) -> None:
        self.url = f"http://127.0.0.1:{port}"

    def call(self, method: str, path: str, body: bytes | None = None, kind: str = "application/json") -> Any:
        request = urllib.request.Request(self.url + path, body, {"content-type": kind}, method=method)
        with urllib.request.urlopen(request, timeout=30) as answer:
            content = answer.read()
            return json.loads(content) if content else None

    def send(self, method: str, path: str, body: Any) -> Any:
        return self.call(method, path, json.dumps(body).encode())

    def status(self, connection: str) -> dict[str, Any]:
        return self.call("GET", f"/v1/connections/{connection}")["status"]

    def when(self, connection: str, is_wanted: Any) -> dict[str, Any]:
        until = time.monotonic() + PATIENCE_S
        while time.monotonic() < until:
            status = self.status(connection)
            if is_wanted(status):
                return status
            time.sleep(0.02)
        fail(f"{connection} does not come to its end: {status}")
        raise AssertionError


def prepare(server: Server, broker_port: int, *, stores: bool) -> str:
    """A camera with a model and both connections of it; the id of all of them."""
    name = f"square-{'storing' if stores else 'plain'}-{time.monotonic_ns()}"
    server.send("POST", "/v1/cameras", {"id": name, "image_size": {"width_px": 1920, "height_px": 1080}})
    model = server.call("POST", f"/v1/cameras/{name}/models", MODEL.read_bytes(), "application/vnd.safetensors")
    server.send("PUT", f"/v1/cameras/{name}/active-model", {"number": model["number"]})
    address = f"mqtt://127.0.0.1:{broker_port}"
    boxes = {"address": address, "format": "frigate", "topics": [f"{name}/events"], "store_samples": stores,
             "ids_name_targets": True, "cameras": {"*": {"camera_id": name}}}
    fixes = {"address": address, "format": "traccar", "topics": [f"{name}/positions"], "store_samples": stores,
             "camera_ids": [name]}
    for connection, source in ((name, boxes), (f"{name}-fixes", fixes)):
        server.send("POST", "/v1/connections", {"id": connection, "source": source})
        server.when(connection, lambda status: status["state"] == "running")
    return name


def event(number: int, start_s: float) -> str:
    target, frame = number % TARGETS, number // TARGETS
    left, top = 100 + 80 * target + frame % 40, 300 + 20 * (target % 10)
    after = {"id": f"t{target}", "camera": "c", "frame_time": start_s + frame / FRAMES_PER_S, "label": "person",
             "score": 0.9, "box": [left, top, left + 40, top + 110]}
    return json.dumps({"type": "update", "after": after}) + "\n"


def position(target: int, time_s: float) -> str:
    fix_time = datetime.fromtimestamp(time_s, UTC).isoformat(timespec="milliseconds")
    place = {"fixTime": fix_time, "longitude": 103.9867 + target * 1e-5, "latitude": 30.628, "accuracy": 3.0}
    return json.dumps({"position": place, "device": {"uniqueId": f"t{target}"}}) + "\n"


def publisher(port: int, topic: str) -> "subprocess.Popen[bytes]":
    command = ["mosquitto_pub", "-p", str(port), "-V", "5", "-q", "1", "-t", topic, "-l"]
    return subprocess.Popen(command, stdin=subprocess.PIPE)


def publish(port: int, name: str, boxes: int, rate: float | None) -> None:
    """Publishes the boxes in order of time, each second of it with the fixes; at a rate, or as fast as possible."""
    start_s = time.time() - (boxes / TARGETS / FRAMES_PER_S if rate is None else 0)
    started = time.monotonic()
    events, positions = publisher(port, f"{name}/events"), publisher(port, f"{name}/positions")
    assert events.stdin and positions.stdin
    for number in range(boxes):
        # At a rate, times are those of now.
        at_s = start_s + number / rate if rate else start_s
        frame_s = at_s - (number // TARGETS) / FRAMES_PER_S if rate else start_s
        events.stdin.write(event(number, frame_s).encode())
        second = TARGETS * FRAMES_PER_S if rate is None else int(rate)
        if number % second == 0:
            time_s = at_s if rate else start_s + number / TARGETS / FRAMES_PER_S
            positions.stdin.write("".join(position(target, time_s) for target in range(TARGETS)).encode())
            positions.stdin.flush()
        if rate and (late := started + number / rate - time.monotonic()) > 0.005:
            events.stdin.flush()
            time.sleep(late)
    for process in (events, positions):
        process.stdin.close()  # type: ignore[union-attr]
        process.wait()


def timed(server: Server, port: int, boxes: int, *, stores: bool) -> float:
    """Boxes per second."""
    name = prepare(server, port, stores=stores)
    started = time.monotonic()
    publish(port, name, boxes, None)
    status = server.when(name, lambda status: status["messages"] >= boxes)
    elapsed_s = time.monotonic() - started
    if status["items"] != boxes or status["lost"]:
        fail(f"not all boxes were taken: {status}")
    server.when(name, lambda status: status["acknowledged"] >= boxes)
    return boxes / elapsed_s


def paced(server: Server, port: int, boxes: int, rate: float, *, stores: bool) -> dict[str, float]:
    """The status while boxes come at a rate."""
    name = prepare(server, port, stores=stores)
    worker = os.fork()
    if worker == 0:
        publish(port, name, boxes, rate)
        os._exit(0)
    lags, unsettled = [], 0
    started = time.monotonic()
    while (status := server.status(name))["messages"] < boxes and time.monotonic() < started + PATIENCE_S:
        lags.append(status.get("lag_s", 0.0))
        unsettled = max(unsettled, status["unsettled"])
        time.sleep(0.1)
    elapsed_s = time.monotonic() - started
    os.waitpid(worker, 0)
    status = server.when(name, lambda status: status["acknowledged"] >= boxes)
    samples = server.call("GET", f"/v1/cameras/{name}/samples/count")["count"]
    return {"rate": status["items"] / elapsed_s, "lag_s": max(lags), "unsettled": unsettled,
            "lost": status["lost"] + status["skipped"] + status["rejected"], "samples": samples}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--boxes", type=int, default=20_000)
    parser.add_argument("--rate", type=float, default=2_000)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        broker_port, server_port = free_port(), free_port()
        conf = Path(folder) / "mosquitto.conf"
        # The broker keeps for a subscriber what it has not acknowledged.
        conf.write_text(
            f"user root\nlistener {broker_port} 127.0.0.1\nallow_anonymous true\n"
            "max_queued_messages 0\nmax_inflight_messages 0\n"
        )
        serve = [str(SIGHTFIX), "serve", "--data", f"{folder}/data", "--listen", f"127.0.0.1:{server_port}"]
        with running(["mosquitto", "-c", str(conf)], broker_port), running(serve, server_port):
            server = Server(server_port)
            rates: dict[bool, list[float]] = {False: [], True: []}
            for _ in range(options.rounds):
                for stores, measured in rates.items():
                    measured.append(timed(server, broker_port, options.boxes, stores=stores))
            plain, storing = (statistics.median(rates[stores]) for stores in (False, True))
            beside, seen = (
                paced(server, broker_port, options.boxes, options.rate, stores=stores) for stores in (False, True)
            )
            print("| boxes per second | without storing | with storing | ratio |\n|---|---:|---:|---:|")
            ratio = seen["rate"] / beside["rate"]
            print(f"| published at {options.rate:,.0f} | {beside['rate']:,.0f} | {seen['rate']:,.0f} | {ratio:.2f} |")
            print(f"| as fast as they come | {plain:,.0f} | {storing:,.0f} | {storing / plain:.2f} |")
            print(
                f"\nAt {options.rate:,.0f} boxes per second with storing: at most "
                f"{seen['lag_s']:.2f} s old when they came, at most {seen['unsettled']:,} unsettled, {seen['lost']} lost, "
                f"{seen['samples']:,} samples stored"
            )


if __name__ == "__main__":
    main()
