"""From a video and a phone's track to a camera that gives positions."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from sightfix import BoundingBox, Client, Fix, ImageSize, Observation, Sample
from sightfix.edge.clock_offset import estimate_offset
from sightfix.edge.fixes import FixesError, TimedFix, read_track
from sightfix.edge.learn import Collector, LearnError, learn
from sightfix.edge.values import Box, TrackedBox
from tests.conftest import ServerProcess
from tests.edge.conftest import EdgeProcess, seeds
from tests.edge.scene import HEIGHT_PX, WIDTH_PX, Row, Video, render, simulated_rows, write_gpx

CLOCK_OFFSET_S = 42.5
"""How much more the phone's clock shows than the video's."""
TEST_ROWS = 45
FRAMES_PER_S = 5


class TruePlaces:
    """Where the walker was at any time."""

    def __init__(self, rows: list[Row]) -> None:
        self._places = {row.time: np.array(row.truth_deg) for row in rows}

    def distance_m(self, time: datetime, longitude_deg: float, latitude_deg: float) -> float | None:
        """Distance of a position from the truth; None while nobody was in view."""
        whole = time.replace(microsecond=0)
        first, second = self._places.get(whole), self._places.get(whole + timedelta(seconds=1))
        if first is None or second is None:
            return None
        place = first + (time - whole).total_seconds() * (second - first)
        degree_m = 111_320.0
        east, north = (np.array((longitude_deg, latitude_deg)) - place) * degree_m
        return float(np.hypot(east * np.cos(np.radians(place[1])), north))


def mean_error_m(
    client: Client, camera_id: str, boxes: Iterable[tuple[datetime, BoundingBox]], rows: list[Row]
) -> float:
    """Mean error of the positions of boxes alone."""
    observations = [Observation(time=time, bounding_box=box) for time, box in boxes]
    truth, errors = TruePlaces(rows), []
    for observation, fused in zip(observations, client.fusions.fuse_batch(camera_id, observations), strict=True):
        position = fused.fused
        errors.append(truth.distance_m(observation.time, position.longitude_deg, position.latitude_deg))
    known = [error for error in errors if error is not None]
    assert len(known) > 0.9 * TEST_ROWS * FRAMES_PER_S * 0.9
    return float(np.mean(known))


def true_boxes(video: Video) -> Iterator[tuple[datetime, BoundingBox]]:
    """The boxes that the frames show."""
    for time, boxes in zip(video.times, video.boxes, strict=True):
        for box in boxes:
            left, top, right, bottom = box.sides_px
            yield time, BoundingBox(left_px=left, top_px=top, width_px=right - left, height_px=bottom - top)


def recorded_boxes(file: Path) -> Iterator[tuple[datetime, BoundingBox]]:
    """The boxes that were recorded."""
    with file.open(newline="") as opened:
        for row in csv.DictReader(opened):
            left, top, width, height = (float(row[name]) for name in ("left", "top", "width", "height"))
            box = BoundingBox(left_px=left, top_px=top, width_px=width, height_px=height)
            yield datetime.fromisoformat(row["time"]), box


def train_on_truth(client: Client, camera_id: str, video: Video, rows: list[Row]) -> None:
    """Trains a camera on true boxes, with the clocks in step."""
    client.cameras.create(id=camera_id, image_size=ImageSize(width_px=WIDTH_PX, height_px=HEIGHT_PX))
    boxes = dict(true_boxes(video))
    samples = [
        Sample(
            time=row.time,
            target_id="walker",
            bounding_box=boxes[row.time],
            fix=Fix(longitude_deg=row.fix_deg[0], latitude_deg=row.fix_deg[1]),
        )
        for row in rows
        if row.time in boxes
    ]
    client.samples.import_samples(camera_id, samples)
    client.training_runs.wait(client.training_runs.start(camera_id))


@pytest.mark.parametrize("seed", seeds(11))
def test_positions_are_nearly_as_good_as_with_true_boxes(
    tmp_path: Path,
    server: ServerProcess,
    edge: Callable[..., EdgeProcess],
    walk_of: Callable[[int], tuple[Video, list[Row]]],
    seed: int,
) -> None:
    video, rows = walk_of(seed)
    write_gpx(rows, tmp_path / "walk.gpx", clock_offset_s=CLOCK_OFFSET_S)
    learning = edge(
        "learn", "--video", str(video.path), "--start", video.start.isoformat(), "--fixes", str(tmp_path / "walk.gpx"),
        "--camera", "square", "--server", server.url,
    )  # fmt: skip
    assert learning.wait(120) == 0, learning.log
    print(learning.log)
    assert "pairs of box and fix" in learning.log
    assert "became active" in learning.log

    test_rows = simulated_rows(tmp_path, seed=seed + 1000, samples=TEST_ROWS)
    test_video = render(test_rows, tmp_path / "test.mp4", seed=seed + 1000, frames_per_s=FRAMES_PER_S)
    start, boxes = test_video.start.isoformat(), tmp_path / "boxes.csv"
    recording = edge("--source", str(test_video.path), "--start", start, "--record", str(boxes))
    assert recording.wait(60) == 0, recording.log
    with Client(server.url) as client:
        train_on_truth(client, "truth", video, rows)
        with_edge_m = mean_error_m(client, "square", recorded_boxes(boxes), test_rows)
        with_truth_m = mean_error_m(client, "truth", true_boxes(test_video), test_rows)
    print(f"seed {seed}: mean error {with_edge_m:.2f} m, with true boxes {with_truth_m:.2f} m")
    assert with_edge_m <= 1.3 * with_truth_m


def boxes_of(rows: list[Row], random: np.random.Generator) -> list[tuple[datetime, TrackedBox]]:
    """Boxes of the rows, twice a second, with an error of 1 px."""
    by_time = {(row.time, row.target_id): row for row in rows}
    boxes = []
    for row in rows:
        later = by_time.get((row.time + timedelta(seconds=1), row.target_id), row)
        for share in (0.0, 0.5):
            (x, y), (next_x, next_y) = row.foot_px, later.foot_px
            exact = np.array((x + share * (next_x - x), y + share * (next_y - y), row.height_px))
            middle, bottom, height = exact + random.normal(0, 1, 3)
            box = Box(middle - 10, bottom - height, 20, height, "person", 1.0)
            boxes.append((row.time + timedelta(seconds=share), TrackedBox(box, f"run-{row.target_id}")))
    return boxes


def test_the_offset_between_the_clocks_is_as_sure_as_stated(tmp_path: Path) -> None:
    deviations = []
    for seed in range(20, 28):
        rows = simulated_rows(tmp_path, seed=seed, samples=240)
        fixes = [TimedFix(row.time + timedelta(seconds=CLOCK_OFFSET_S), *row.fix_deg) for row in rows]
        offset = estimate_offset(boxes_of(rows, np.random.default_rng(seed)), fixes, (WIDTH_PX, HEIGHT_PX), 120)
        assert offset is not None
        assert offset.is_sure
        deviations.append((offset.offset_s + CLOCK_OFFSET_S) / offset.sigma_s)
    print(f"errors of the offset over their stated deviation: {np.round(deviations, 1)}")
    assert np.sqrt(np.mean(np.square(deviations))) < 2.0
    assert np.abs(deviations).max() < 4.0


def test_fixes_of_another_walk_give_no_sure_offset(tmp_path: Path) -> None:
    rows = simulated_rows(tmp_path, seed=1, samples=120)
    straight = [TimedFix(row.time, 24.7453 + 1e-5 * second, 59.4371) for second, row in enumerate(rows)]
    offset = estimate_offset(boxes_of(rows, np.random.default_rng(1)), straight, (WIDTH_PX, HEIGHT_PX), 60)
    assert offset is None or not offset.is_sure


def test_among_several_people_the_server_finds_who_has_the_phone(tmp_path: Path, client: Client) -> None:
    rows = simulated_rows(tmp_path, "--targets", "3", seed=5, samples=750)
    own = [row for row in rows if row.target_id == "person-2"]
    write_gpx(own, tmp_path / "walk.gpx", clock_offset_s=3.0)
    collected = Collector()
    collected.image_size_px = (WIDTH_PX, HEIGHT_PX)
    collected.boxes = sorted(boxes_of(rows, np.random.default_rng(5)), key=lambda it: it[0])
    for camera_id in ("square", "yard"):
        client.cameras.create(id=camera_id, image_size=ImageSize(width_px=WIDTH_PX, height_px=HEIGHT_PX))

    learnt = learn(client, "square", collected, read_track(tmp_path / "walk.gpx"), clock_window_s=5)
    print(learnt.lines())
    assert learnt.is_active
    assert learnt.paired.matching is not None
    assert {pair.tracker_id for pair in learnt.paired.matching.pairs} == {"run-person-2"}
    assert learnt.paired.accepted > 0.5 * len(own)

    collected.boxes = collected.boxes[:200]
    with pytest.raises(LearnError, match="several people"):
        learn(client, "yard", collected, read_track(tmp_path / "walk.gpx"), clock_window_s=5)


def test_learning_says_what_is_missing(
    tmp_path: Path, server: ServerProcess, edge: Callable[..., EdgeProcess], walk: tuple[Video, list[Row]]
) -> None:
    video, rows = walk
    arguments = ("learn", "--video", str(video.path), "--camera", "square", "--server", server.url, "--fixes")
    write_gpx(rows, tmp_path / "walk.gpx")

    undated = edge(*arguments, str(tmp_path / "walk.gpx"))
    assert undated.wait() == 1
    assert "does not say when it was recorded; give --start" in undated.log

    start = ("--start", (video.start + timedelta(days=1)).isoformat())
    another_day = edge(*arguments, str(tmp_path / "walk.gpx"), *start)
    assert another_day.wait(60) == 1
    assert "do not overlap" in another_day.log
    with Client(server.url) as client:
        assert client.samples.count("square").count == 0


def test_tracks_of_a_gpx_file_are_read(tmp_path: Path) -> None:
    file = tmp_path / "walk.gpx"
    file.write_text(
        '<gpx xmlns="http://www.topografix.com/GPX/1/1"><wpt lat="1" lon="2"><time>2026-05-01T12:00:00Z</time></wpt>'
        '<trk><trkseg><trkpt lat="59.1" lon="24.2"><time>2026-05-01T12:00:01Z</time></trkpt>'
        '<trkpt lat="59.2" lon="24.3"/><trkpt lat="59.0" lon="24.1"><time>2026-05-01T12:00:00</time></trkpt>'
        "</trkseg></trk></gpx>"
    )
    start = datetime(2026, 5, 1, 12, tzinfo=UTC)
    assert read_track(file).fixes == [TimedFix(start, 24.1, 59.0), TimedFix(start + timedelta(seconds=1), 24.2, 59.1)]
    for text in ("no XML", "<gpx><trk>", "<gpx/>", '<!DOCTYPE a [<!ENTITY b "c">]><gpx>&b;</gpx>'):
        file.write_text(text)
        with pytest.raises(FixesError):
            read_track(file)


def test_files_of_the_page_walk_are_read(tmp_path: Path) -> None:
    file, header = tmp_path / "walk-phone-7.csv", "time,receiver_id,longitude,latitude,sigma_m\n"
    file.write_text(f"{header}2026-05-01T12:00:00.000Z,phone-7,24.10000000,59.00000000,2.5\n")
    track = read_track(file)
    assert track.receiver_id == "phone-7"
    assert track.fixes == [TimedFix(datetime(2026, 5, 1, 12, tzinfo=UTC), 24.1, 59.0)]
    first, second = (f"2026-05-01T12:00:00Z,phone-{number},24.1,59.0,\n" for number in (1, 2))
    faults = {first + second: "several receivers", "2026-05-01T12:00:00,a,24.1,59.0,\n": "UTC offset", "": "no fixes"}
    for rows, fault in faults.items():
        file.write_text(header + rows)
        with pytest.raises(FixesError, match=fault):
            read_track(file)
