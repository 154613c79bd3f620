"""The outputs of boxes and stills."""

from __future__ import annotations

import urllib.request
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from sightfix import Client, ImageSize, SightfixError
from sightfix.edge import outputs
from sightfix.edge.outputs import LARGEST_STILL_BYTES, Delivery, Recorder, Stills, ensure_camera, jpeg_within
from sightfix.edge.preview import VIEWERS, Preview
from sightfix.edge.values import Box, Frame, Image, TrackedBox
from tests.conftest import ServerProcess
from tests.edge.conftest import EdgeProcess, eventually
from tests.edge.scene import Row, Video

IMAGE = np.full((180, 320, 3), 90, np.uint8)
FRAME = Frame(IMAGE, datetime(2026, 5, 1, 12, tzinfo=UTC))
BOX = TrackedBox(Box(100, 50, 30.126, 80, "person", 0.87654), "a-1")


def decoded(jpeg: bytes) -> Image:
    image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    return np.asarray(image, np.uint8)


def test_the_record_is_a_file_for_pairing(tmp_path: Path) -> None:
    with Recorder(tmp_path / "boxes.csv") as recorder:
        recorder.take(FRAME, [BOX])
    assert (tmp_path / "boxes.csv").read_text().splitlines() == [
        "time,target_id,left,top,width,height,class,score",
        "2026-05-01T12:00:00+00:00,a-1,100,50,30.13,80,person,0.8765",
    ]


def test_a_camera_is_created_only_on_request(client: Client, caplog: pytest.LogCaptureFixture) -> None:
    with pytest.raises(SightfixError, match="--create"):
        ensure_camera(client, "gate", IMAGE, create=False)
    ensure_camera(client, "gate", IMAGE, create=True)
    assert client.cameras.get("gate").image_size == ImageSize(width_px=320, height_px=180)
    ensure_camera(client, "gate", IMAGE, create=False)
    assert "positions will be wrong" not in caplog.text
    ensure_camera(client, "gate", np.zeros((360, 640, 3), np.uint8), create=False)
    assert "320 x 180 px, the source has 640 x 360 px: positions will be wrong" in caplog.text


def test_a_stream_ends_though_the_server_is_gone(
    server: ServerProcess, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(outputs, "LONGEST_SILENCE_S", 0.5)
    with Client(server.url) as client:
        ensure_camera(client, "gate", IMAGE, create=True)
        delivery = Delivery(client, "gate")
        delivery.take(FRAME, [BOX])
        eventually(lambda: delivery.answered == 1)
        server.kill()
        delivery.take(FRAME, [BOX, BOX])
        delivery.close()
    assert "2 boxes are not answered" in caplog.text


def test_the_command_waits_for_a_server(
    tmp_path: Path, edge: Callable[..., EdgeProcess], walk: tuple[Video, list[Row]]
) -> None:
    server = ServerProcess(tmp_path)
    source = ("--source", str(walk[0].path), "--start", walk[0].start.isoformat(), "--max-fps", "2")
    process = edge(*source, "--camera", "gate", "--create", "--server", server.url)
    process.wait_for("the server cannot be reached")
    server.start()
    try:
        assert process.wait(60) == 0, process.log
        assert "0 of them refused" in process.log
    finally:
        server.stop()


def send_still(stills: Stills, brightness: int) -> None:
    """Has a grey picture sent, if it is time for one."""
    stills.take(Frame(np.full_like(IMAGE, brightness), FRAME.time), [])
    stills.close()


def stored_brightness(client: Client, camera_id: str) -> int:
    picture = client.cameras.picture(camera_id)
    assert picture is not None
    return round(float(decoded(picture).mean()))


def test_the_picture_is_replaced_after_the_interval(client: Client) -> None:
    client.cameras.create(id="gate")
    rare, frequent = Stills(client, "gate", interval_s=3600), Stills(client, "gate", interval_s=0)
    send_still(rare, 90)
    send_still(rare, 150)
    assert stored_brightness(client, "gate") == 90
    send_still(frequent, 120)
    send_still(frequent, 150)
    assert stored_brightness(client, "gate") == 150


def test_a_refused_picture_is_reported_and_the_next_one_sent(client: Client, caplog: pytest.LogCaptureFixture) -> None:
    stills = Stills(client, "gate", interval_s=0)
    send_still(stills, 90)
    assert "a picture could not be sent: " in caplog.text
    client.cameras.create(id="gate")
    send_still(stills, 120)
    assert stored_brightness(client, "gate") == 120


def test_a_still_is_within_the_limit_of_the_server() -> None:
    noise = np.random.default_rng(1).integers(0, 256, (2160, 3840, 3), dtype=np.uint8)
    jpeg = jpeg_within(noise, LARGEST_STILL_BYTES)
    assert len(jpeg) <= LARGEST_STILL_BYTES
    assert decoded(jpeg).shape[1] in (3840, 1920)
    assert len(jpeg_within(noise, 50_000)) <= 50_000


def test_the_preview_shows_boxes_to_a_few_viewers() -> None:
    preview = Preview(0)
    try:
        with urllib.request.urlopen(preview.address) as page:
            assert b"/video" in page.read()
        viewers = [urllib.request.urlopen(f"{preview.address}video") for _ in range(VIEWERS)]
        with pytest.raises(urllib.error.HTTPError, match="503"):
            urllib.request.urlopen(f"{preview.address}video")
        foreign = urllib.request.Request(preview.address, headers={"host": "example.org"})
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(foreign)
        preview.take(FRAME, [BOX])
        for viewer in viewers:
            assert viewer.readline() == b"--frame\r\n"
            headers = [viewer.readline() for _ in range(3)]
            jpeg = viewer.read(int(headers[1].split()[1]))
            shown = decoded(jpeg)
            assert shown[90, 100, 1] > 150, "the left side of the box is green"
            assert abs(int(shown[150, 250, 1]) - 90) < 5
            viewer.close()
    finally:
        preview.close()


def test_the_benchmark_measures_each_stage(edge: Callable[..., EdgeProcess], walk: tuple[Video, list[Row]]) -> None:
    process = edge("--source", str(walk[0].path), "--start", walk[0].start.isoformat(), "--benchmark", "100")
    assert process.wait(60) == 0, process.log
    print(process.log)
    assert "100 frames" in process.log
    for stage in ("decode", "detect", "track", "all"):
        assert f"\n{stage} " in process.log


def test_a_camera_that_does_not_exist_and_wrong_arguments_are_reported(
    server: ServerProcess, edge: Callable[..., EdgeProcess], walk: tuple[Video, list[Row]]
) -> None:
    source = ("--source", str(walk[0].path), "--start", walk[0].start.isoformat())
    missing = edge(*source, "--camera", "gate", "--server", server.url)
    assert missing.wait() == 1
    assert "gate" in missing.log
    assert "--create" in missing.log
    assert edge(*source).wait() == 2
    assert edge("--source", "x.mp4", "--start", "2026-05-01T12:00:00", "--camera", "gate").wait() == 2


def test_a_file_is_streamed_to_its_end_with_a_picture_of_the_view(
    client: Client, server: ServerProcess, edge: Callable[..., EdgeProcess], walk: tuple[Video, list[Row]]
) -> None:
    process = edge(
        "--source", str(walk[0].path), "--start", walk[0].start.isoformat(), "--camera", "gate", "--create",
        "--server", server.url, "--preview", "0", "--store-samples",
    )  # fmt: skip
    assert process.wait(60) == 0, process.log
    assert "0 of them refused" in process.log
    assert client.cameras.get("gate").image_size == ImageSize(width_px=1280, height_px=720)
    picture = client.cameras.picture("gate")
    assert picture is not None
    with av.open(str(walk[0].path)) as video:
        first = next(video.decode(video=0)).to_ndarray(format="bgr24")
    assert np.abs(decoded(picture).astype(int) - first).mean() < 2.0, "the picture is the first frame"
