"""The edge client as a process of its own."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import pytest

from tests.edge.scene import Row, Video, render, simulated_rows

PATIENCE_S = 30.0


def seeds(first: int) -> range:
    """Seeds of a test: as many as the environment variable EDGE_SEEDS says."""
    return range(first, first + int(os.environ.get("EDGE_SEEDS", "1")))


def eventually(condition: Callable[[], bool], patience_s: float = PATIENCE_S) -> None:
    """Waits until a condition holds."""
    deadline = time.monotonic() + patience_s
    while not condition():
        assert time.monotonic() < deadline, "the condition never held"
        time.sleep(0.1)


class EdgeProcess:
    """`sightfix-edge` with these arguments."""

    def __init__(self, folder: Path, *arguments: str) -> None:
        self._log = folder / "edge.log"
        environment = {k: v for k, v in os.environ.items() if not k.startswith("SIGHTFIX_")}
        with self._log.open("wb") as output:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "sightfix.edge.cli", *arguments], env=environment, stdout=output, stderr=output
            )

    @property
    def log(self) -> str:
        """The printed text."""
        return self._log.read_text()

    def wait_for(self, text: str, count: int = 1) -> None:
        """Waits until it has printed a text so often."""
        eventually(lambda: self.log.count(text) >= count or self._process.poll() is not None)
        assert self.log.count(text) >= count, self.log

    def stop(self) -> int:
        """Ends it in order; returns its exit status."""
        self._process.send_signal(signal.SIGTERM)
        return self._process.wait(PATIENCE_S)

    def wait(self, patience_s: float = PATIENCE_S) -> int:
        """Waits until it ends by itself; returns its exit status."""
        return self._process.wait(patience_s)

    def kill(self) -> None:
        """Ends it if it still runs."""
        self._process.kill()
        self._process.wait()


@pytest.fixture
def edge(tmp_path: Path) -> Iterator[Callable[..., EdgeProcess]]:
    """Starts the command."""
    started: list[EdgeProcess] = []

    def start(*arguments: str) -> EdgeProcess:
        started.append(EdgeProcess(tmp_path, *arguments))
        return started[-1]

    yield start
    for process in started:
        process.kill()


@pytest.fixture(scope="session")
def walk_of(tmp_path_factory: pytest.TempPathFactory) -> Callable[[int], tuple[Video, list[Row]]]:
    """Two minutes of one walker, by seed."""
    folder = tmp_path_factory.mktemp("walk")

    @cache
    def rendered(seed: int) -> tuple[Video, list[Row]]:
        rows = simulated_rows(folder, seed=seed, samples=120)
        return render(rows, folder / f"{seed}.mp4", seed=seed, frames_per_s=5), rows

    return rendered


@pytest.fixture(scope="session")
def walk(walk_of: Callable[[int], tuple[Video, list[Row]]]) -> tuple[Video, list[Row]]:
    """The walk that most tests show."""
    return walk_of(11)
