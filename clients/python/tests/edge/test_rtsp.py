"""A camera over RTSP, which dies and comes back, as does the server."""

from __future__ import annotations

import csv
import itertools
import math
import re
import shutil
import socket
import subprocess
import threading
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from sightfix import Client, Fix, ImageSize, LiveItem
from tests.conftest import ServerProcess
from tests.edge.conftest import EdgeProcess, eventually
from tests.edge.scene import Row, TrueBox, Video

PYTHON = "/usr/bin/python3"
"""Debian's, which has GStreamer's bindings."""
SCRIPT = Path(__file__).with_name("rtsp_server.py")


class Camera:
    """An RTSP server of a video."""

    def __init__(self, video: Video, rows: list[Row]) -> None:
        self.video = video
        self.rows = rows
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self._port: int = free.getsockname()[1]
        self.address = f"rtsp://127.0.0.1:{self._port}/camera"
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Starts it; the video begins with the first viewer."""
        command = [PYTHON, str(SCRIPT), str(self.video.path), str(self._port)]
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE)
        assert self._process.stdout is not None
        assert self._process.stdout.readline() == b"ready\n"

    def kill(self) -> None:
        """Ends it without giving it time."""
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None


@pytest.fixture
def camera(walk: tuple[Video, list[Row]]) -> Iterator[Camera]:
    assert shutil.which(PYTHON), "GStreamer's bindings are those of Debian's Python"
    camera = Camera(*walk)
    camera.start()
    yield camera
    camera.kill()


def recorded_rows(file: Path) -> list[dict[str, str]]:
    """Recorded boxes."""
    with file.open(newline="") as opened:
        return list(csv.DictReader(opened))


def recorded(file: Path) -> list[tuple[datetime, str]]:
    """Times and ids of recorded boxes."""
    return [(datetime.fromisoformat(row["time"]), row["target_id"]) for row in recorded_rows(file)]


def test_a_camera_and_a_server_that_die_and_come_back(
    tmp_path: Path, server: ServerProcess, camera: Camera, edge: Callable[..., EdgeProcess]
) -> None:
    began = datetime.now(UTC)
    file = tmp_path / "boxes.csv"
    process = edge(
        "--source", camera.address, "--camera", "square", "--create", "--server", server.url,
        "--record", str(file), "--timeout-s", "3",
    )  # fmt: skip
    reports = "times of frames are the sender's"
    process.wait_for(reports)
    eventually(lambda: len(recorded(file)) > 30)

    camera.kill()
    process.wait_for("the source gives no frames")
    camera.start()
    process.wait_for(reports, count=2)
    before = len(recorded(file))
    server.kill()
    eventually(lambda: len(recorded(file)) > before + 30)
    server.start()
    eventually(lambda: len(recorded(file)) > before + 60)
    assert process.stop() == 0, process.log

    boxes = recorded(file)
    times = [time for time, _ in boxes]
    assert times == sorted(times)
    assert len(set(boxes)) == len(boxes), "no duplicates"
    assert began - timedelta(seconds=1) < times[0] <= times[-1] < datetime.now(UTC), "the sender's clock is ours"
    steps = {(b - a).total_seconds() for a, b in itertools.pairwise(times) if b > a}
    assert min(steps) >= 0.09, "frames are 0.1 s apart"
    sent, answered, refused, reconnects = map(int, re.findall(SUMMARY, process.log)[0])
    assert (sent, answered, refused) == (len(boxes), len(boxes), 0), process.log
    assert reconnects >= 1


class Phone:
    """Streams the fixes of a walk that is shown now, twice a second, as the receiver `phone`."""

    def __init__(self, client: Client, rows: list[Row], start: datetime) -> None:
        """Begins; `start` is the instant at which the first row is shown."""
        self._rows = {row.time - rows[0].time: row for row in rows}
        self._start = start
        self._stopped = threading.Event()
        self.stream = client.stream("square", store_samples=True)
        self.stream.__enter__()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._stopped.wait(0.5):
            now = datetime.now(UTC)
            row = self._rows.get(timedelta(seconds=round((now - self._start).total_seconds())))
            if row is not None:
                longitude_deg, latitude_deg = row.fix_deg
                fix = Fix(longitude_deg=longitude_deg, latitude_deg=latitude_deg)
                self.stream.send(LiveItem(time=now, receiver_id="phone", fix=fix))

    def stop(self) -> None:
        """Ends when everything is acknowledged."""
        self._stopped.set()
        self._thread.join()
        self.stream.close()


@pytest.fixture
def square(server: ServerProcess, recording: tuple[Path, Path]) -> Iterator[Client]:
    """A client of the server, whose camera `square` has a model."""
    with Client(server.url) as client:
        client.cameras.create(id="square", image_size=ImageSize(width_px=1280, height_px=720))
        client.samples.import_file("square", recording[0])
        client.training_runs.wait(client.training_runs.start("square", recipe="projective", epochs=40))
        yield client


def start_of_walk(camera: Camera, file: Path) -> datetime:
    """The instant at which the video began to show its first row, from a recorded box and the true ones."""
    row = recorded_rows(file)[-1]
    left, bottom = float(row["left"]), float(row["top"]) + float(row["height"])

    def distance_px(shown: tuple[datetime, list[TrueBox]]) -> float:
        return min((abs(it.sides_px[0] - left) + abs(it.sides_px[3] - bottom) for it in shown[1]), default=math.inf)

    time, _ = min(zip(camera.video.times, camera.video.boxes, strict=True), key=distance_px)
    return datetime.fromisoformat(row["time"]) - (time - camera.rows[0].time)


def test_what_was_acknowledged_is_stored_though_the_server_is_killed(
    tmp_path: Path, server: ServerProcess, square: Client, camera: Camera, edge: Callable[..., EdgeProcess]
) -> None:
    def stored() -> dict[datetime, float]:
        samples = square.samples.list("square", target_id="phone")
        return {it.time: it.bounding_box.left_px for it in samples}

    file = tmp_path / "boxes.csv"
    process = edge(
        "--source", camera.address, "--camera", "square", "--server", server.url, "--record", str(file),
        "--store-samples",
    )  # fmt: skip
    eventually(lambda: file.exists() and len(recorded(file)) > 10)
    phone = Phone(square, camera.rows, start_of_walk(camera, file))
    eventually(lambda: len(stored()) > 10, patience_s=60)
    before, acknowledgement = stored(), phone.stream.acknowledgement
    server.kill()
    server.start()
    after = stored()
    assert acknowledgement is not None
    print(f"{acknowledgement.stored} acknowledged, {len(before)} stored before, {len(after)} after")
    assert before.items() <= after.items()
    assert 0 < acknowledgement.stored <= len(after)

    eventually(lambda: len(stored()) > len(after) + 10, patience_s=60)
    assert process.stop() == 0, process.log
    phone.stop()
    sent = {datetime.fromisoformat(row["time"]): float(row["left"]) for row in recorded_rows(file)}
    assert stored().items() <= sent.items(), "each sample has a box that was sent"


SUMMARY = r"(\d+) boxes sent, (\d+) answered, (\d+) of them refused, (\d+) reconnects"
