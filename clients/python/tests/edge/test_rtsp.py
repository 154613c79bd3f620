"""A camera over RTSP, which dies and comes back, as does the server."""

from __future__ import annotations

import csv
import re
import shutil
import socket
import subprocess
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from pathlib import Path

import pytest

from tests.conftest import ServerProcess
from tests.edge.conftest import EdgeProcess, eventually
from tests.edge.scene import Row, Video

PYTHON = "/usr/bin/python3"
"""Debian's, which has GStreamer's bindings."""
SCRIPT = Path(__file__).with_name("rtsp_server.py")


class Camera:
    """An RTSP server of a video."""

    def __init__(self, video: Path) -> None:
        self._video = video
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self._port: int = free.getsockname()[1]
        self.address = f"rtsp://127.0.0.1:{self._port}/camera"
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Starts it; the video begins with the first viewer."""
        command = [PYTHON, str(SCRIPT), str(self._video), str(self._port)]
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
    camera = Camera(walk[0].path)
    camera.start()
    yield camera
    camera.kill()


def recorded(file: Path) -> list[tuple[datetime, str]]:
    """Times and ids of recorded boxes."""
    with file.open(newline="") as opened:
        return [(datetime.fromisoformat(row["time"]), row["target_id"]) for row in csv.DictReader(opened)]


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
    steps = {(b - a).total_seconds() for a, b in pairwise(times) if b > a}
    assert min(steps) >= 0.09, "frames are 0.1 s apart"
    sent, answered, refused, reconnects = map(int, re.findall(SUMMARY, process.log)[0])
    assert (sent, answered, refused) == (len(boxes), len(boxes), 0), process.log
    assert reconnects >= 1


SUMMARY = r"(\d+) boxes sent, (\d+) answered, (\d+) of them refused, (\d+) reconnects"
