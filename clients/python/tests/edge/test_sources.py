"""Sources of frames, and what becomes of frames that come too fast."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from fractions import Fraction
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from sightfix import RetryPolicy
from sightfix.edge.latest import LatestFrames
from sightfix.edge.sources import FrameTimes, SourceError, SourceOptions, frames, thinned, video_frames
from sightfix.edge.values import Frame
from tests.edge.scene import VideoFile

START = datetime(2026, 5, 1, 12, tzinfo=UTC)
SHORT_RETRY = RetryPolicy(initial_delay_s=0.01, max_delay_s=0.02)


class Now:
    """A clock that is set by hand; sleeping lets it go on."""

    def __init__(self) -> None:
        self.time = START

    def __call__(self) -> datetime:
        return self.time

    def sleep(self, seconds: float) -> None:
        self.time += timedelta(seconds=seconds)


@pytest.fixture
def video(tmp_path: Path) -> Path:
    """Two seconds of 20 frames per second, each of one grey."""
    path = tmp_path / "video.mp4"
    file = VideoFile(path, (320, 180))
    for number in range(40):
        file.write(np.full((180, 320, 3), 5 * number + 20, np.uint8), timedelta(seconds=number / 20))
    file.close()
    return path


def test_frames_of_a_file_have_its_time(video: Path) -> None:
    now = Now()
    read = list(frames(SourceOptions(address=str(video), start=START, max_frames_per_s=10), now, now.sleep))
    assert [frame.time for frame in read] == [START + timedelta(seconds=number / 10) for number in range(20)]
    assert read[0].image.shape == (180, 320, 3)
    assert abs(float(read[19].image.mean()) - (5 * 38 + 20)) < 3


def test_a_file_that_says_no_time_or_is_no_video_is_refused(video: Path, tmp_path: Path) -> None:
    now = Now()
    with pytest.raises(SourceError, match="--start"):
        next(frames(SourceOptions(address=str(video)), now, now.sleep))
    (tmp_path / "text.mp4").write_text("no video")
    for name in ("text.mp4", "nothing.mp4"):
        with pytest.raises(SourceError, match=name):
            next(frames(SourceOptions(address=str(tmp_path / name), start=START), now, now.sleep))


class PictureHandler(BaseHTTPRequestHandler):
    """Answers with what the server has next."""

    def do_GET(self) -> None:
        status, body = self.server.answers.pop(0)  # type: ignore[attr-defined]
        self.send_response(status)
        self.send_header("content-length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002, the name of the base class
        """Requests are not logged."""


@pytest.fixture
def pictures() -> Iterator[tuple[str, list[tuple[int, bytes]]]]:
    """Address of a picture, and what is answered there."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), PictureHandler)
    server.answers = []  # type: ignore[attr-defined]
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}/snapshot.jpg?now", server.answers  # type: ignore[attr-defined]
    server.shutdown()
    server.server_close()


def test_pictures_are_requested_again_after_any_failure(pictures: tuple[str, list[tuple[int, bytes]]]) -> None:
    address, answers = pictures
    jpeg = cv2.imencode(".jpg", np.full((90, 160, 3), 77, np.uint8))[1].tobytes()
    answers += [(200, jpeg), (503, b""), (200, b"no picture"), (200, jpeg), (200, jpeg)]
    now = Now()
    options = SourceOptions(address=address, delay_s=0.5, max_frames_per_s=2, retry=SHORT_RETRY)
    read = frames(options, now, now.sleep)
    first, second, third = (next(read) for _ in range(3))
    assert first.time == START - timedelta(seconds=0.5)
    assert first.time < second.time < third.time
    assert abs(float(third.image.mean()) - 77) < 2
    assert answers == []


def test_a_clock_that_is_set_back_does_not_stop_the_frames(pictures: tuple[str, list[tuple[int, bytes]]]) -> None:
    address, answers = pictures
    jpeg = cv2.imencode(".jpg", np.zeros((90, 160, 3), np.uint8))[1].tobytes()
    answers += [(200, jpeg)] * 4
    now, slept_s = Now(), list[float]()

    def sleep(seconds: float) -> None:
        slept_s.append(seconds)
        now.sleep(seconds)

    read = frames(SourceOptions(address=address, max_frames_per_s=2), now, sleep)
    times = [next(read).time for _ in range(2)]
    now.time -= timedelta(hours=1)
    times += [next(read).time for _ in range(2)]
    assert times[0] < times[1]
    assert times[1] - timedelta(hours=1) < times[2] < times[3] < times[1]
    assert max(slept_s) <= 0.5


def test_a_source_that_is_no_longer_wanted_is_not_opened_again() -> None:
    options = SourceOptions(address="http://127.0.0.1:1/stream", retry=SHORT_RETRY)
    assert list(frames(options, Now(), lambda _seconds: True)) == []


def test_no_message_has_the_password() -> None:
    now = Now()
    address = "http://user:secret@127.0.0.1:1/stream"
    read = video_frames(SourceOptions(address=address), now)
    with pytest.raises(SourceError) as refused:
        next(read)
    assert "http://127.0.0.1:1/stream" in str(refused.value)
    assert "secret" not in str(refused.value)


@dataclass
class Report:
    """A packet, or the stream that it is of, with the sender's clock as FFmpeg hands it on."""

    wall_clock: datetime
    pts: int = 9000
    time_base: Fraction = Fraction(1, 90_000)

    def has_sidedata(self, kind: str) -> bool:
        return kind == "prft"

    def get_sidedata(self, kind: str) -> bytes:
        microseconds = round(self.wall_clock.timestamp() * 1e6)
        return microseconds.to_bytes(8, "little", signed=True) + bytes(8)


def test_a_wrong_clock_of_the_sender_is_not_used(caplog: pytest.LogCaptureFixture) -> None:
    now = Now()
    options = SourceOptions(address="rtsp://camera", delay_s=0.2)
    right, wrong = Report(START - timedelta(seconds=1)), Report(datetime(1970, 1, 1, tzinfo=UTC))
    times = FrameTimes(options, now, None, right)
    assert times.of(right) == START - timedelta(seconds=0.2), "arrival less the delay, before the first report"
    times.note(right)
    assert times.of(right) == right.wall_clock
    times.note(wrong)
    assert times.of(wrong) == START - timedelta(seconds=0.2)
    assert "is not used: set it" in caplog.text
    times.note(right)
    assert times.of(right) == right.wall_clock


@pytest.mark.parametrize(
    ("given_s", "taken_s"),
    [
        ([0.0, 1.0, 1.0, 0.5, 1.05, 2.0, -7.0], [0.0, 1.0, 2.0]),
        ([0.0, 1.0, -60.0, -60.0, -59.0], [0.0, 1.0, -60.0, -59.0]),
    ],
)
def test_times_increase_unless_the_clock_is_set_back(given_s: list[float], taken_s: list[float]) -> None:
    given = [Frame(np.zeros((2, 2, 3), np.uint8), START + timedelta(seconds=it)) for it in given_s]
    assert [(frame.time - START).total_seconds() for frame in thinned(given, 10)] == taken_s


def test_frames_are_dropped_instead_of_waiting() -> None:
    image, taken = np.zeros((2, 2, 3), np.uint8), threading.Event()

    def source() -> Iterator[Frame]:
        yield Frame(image, START)
        assert taken.wait(10)
        for number in range(1, 10):
            yield Frame(image, START + timedelta(seconds=number))

    latest = LatestFrames(source())
    assert next(latest).time == START
    taken.set()
    while latest.read < 10:
        pass
    assert [frame.time for frame in latest] == [START + timedelta(seconds=9)]
    assert latest.dropped == 8


def test_an_error_of_the_source_is_raised_where_frames_are_taken() -> None:
    def source() -> Iterator[Frame]:
        raise SourceError("broken")
        yield

    with pytest.raises(SourceError, match="broken"):
        next(LatestFrames(source()))
