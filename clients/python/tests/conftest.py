"""Servers and recordings for the tests.

The binary is that of the environment variable SIGHTFIX, or the debug build.
"""

import csv
import os
import signal
import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from sightfix import Client, ImageSize

BINARY = Path(os.environ.get("SIGHTFIX", Path(__file__).resolve().parents[3] / "target/debug/sightfix"))
START_S = 30.0


class ServerProcess:
    """The real server on a port of its own, with a data folder that survives restarts."""

    def __init__(self, folder: Path, *arguments: str, environment: dict[str, str] | None = None) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port: int = free.getsockname()[1]
        self.folder = folder
        self.url = f"http://127.0.0.1:{self.port}"
        self._arguments = arguments
        self._environment = environment or {}
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Starts the server and waits until it accepts connections."""
        command: list[str | Path] = [
            BINARY,
            "serve",
            "--data",
            self.folder / "data",
            "--listen",
            f"127.0.0.1:{self.port}",
        ]
        environment = {k: v for k, v in os.environ.items() if not k.startswith("SIGHTFIX")} | self._environment
        log = self.folder / "log"
        with log.open("ab") as output:
            self._process = subprocess.Popen(
                [*command, *self._arguments], cwd=self.folder, env=environment, stdout=output, stderr=output
            )
        deadline = time.monotonic() + START_S
        while time.monotonic() < deadline:
            if self._process.poll() is not None:
                break
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", self.port)) == 0:
                    return
            time.sleep(0.05)
        self.kill()
        raise RuntimeError(f"the server does not start:\n{log.read_text()}")

    def kill(self) -> None:
        """Ends the server without giving it time (SIGKILL)."""
        self._end(signal.SIGKILL)

    def stop(self) -> None:
        """Ends the server in order."""
        self._end(signal.SIGTERM)

    def _end(self, number: signal.Signals) -> None:
        if self._process is not None:
            self._process.send_signal(number)
            self._process.wait(START_S)
            self._process = None


@pytest.fixture
def server(tmp_path: Path) -> Iterator[ServerProcess]:
    process = ServerProcess(tmp_path)
    process.start()
    yield process
    process.stop()


@pytest.fixture
def client(server: ServerProcess) -> Iterator[Client]:
    with Client(server.url) as client:
        yield client


@pytest.fixture(scope="session")
def recording(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Rows for training and rows of another day, with true positions."""
    folder = tmp_path_factory.mktemp("recording")
    training, test = folder / "training.csv", folder / "test.csv"
    rows = ["--samples", "240", "--test-out", str(test), "--test-samples", "120"]
    subprocess.run([BINARY, "simulate", "square", "--out", str(training), *rows], check=True, capture_output=True)
    return training, test


@pytest.fixture(scope="session")
def site_recording(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Rows for training by camera of a site: the boxes of those who carry a receiver, with its fixes."""
    folder = tmp_path_factory.mktemp("site")
    scene = ["--cameras", "2", "--walkers", "10", "--vehicles", "0", "--receivers", "1"]
    length = ["--duration-s", "60", "--frame-interval-s", "1"]
    subprocess.run([BINARY, "simulate", "site", "--out", str(folder), *scene, *length], check=True, capture_output=True)

    def rows(name: str) -> Iterator[dict[str, str]]:
        with (folder / name).open(newline="") as file:
            yield from csv.DictReader(file)

    person = {(row["camera"], row["target_id"]): row["person"] for row in rows("identity.csv")}
    # `phone-3` is carried by `person-3`.
    fixes = {(row["time"], row["receiver_id"].replace("phone", "person")): row for row in rows("fixes.csv")}
    files = {}
    for camera in ("c1", "c2"):
        files[camera] = folder / f"{camera}.csv"
        with files[camera].open("w", newline="") as file:
            box = ["time", "target_id", "left", "top", "width", "height"]
            writer = csv.DictWriter(file, [*box, "longitude", "latitude"], extrasaction="ignore")
            writer.writeheader()
            for row in rows(f"detections_{camera}.csv"):
                target_id = person[camera, row["target_id"]]
                fix = fixes.get((row["time"], target_id))
                if fix is not None:
                    writer.writerow(fix | row | {"target_id": target_id})
    return files


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory, recording: tuple[Path, Path]) -> Iterator[ServerProcess]:
    """A server whose camera `square` has a model. Tests that use it change nothing."""
    process = ServerProcess(tmp_path_factory.mktemp("trained"))
    process.start()
    with Client(process.url) as client:
        client.cameras.create(id="square", image_size=ImageSize(width_px=1280, height_px=720))
        client.samples.import_file("square", recording[0])
        client.training_runs.wait(client.training_runs.start("square", recipe="projective", epochs=40))
    yield process
    process.stop()


def admin_key() -> str:
    """A secret that the server takes as an administrator's key."""
    printed = subprocess.run([BINARY, "keys", "generate"], check=True, capture_output=True, text=True).stdout
    return next(word for word in printed.split() if word.startswith("sf_"))
