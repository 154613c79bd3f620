"""The detector without weights, on videos of the simulated square whose truth is known."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from sightfix.edge.motion import CAMERA_MOVES, CROWDED, SPECKLED, VIEW_CHANGES, MotionDetector, MotionOptions
from sightfix.edge.values import Box, Image
from tests.edge.conftest import seeds
from tests.edge.scene import Renderer, Row, TrueBox, Video, render, simulated_rows, simulated_site

LEAST_HEIGHT_PX = 30.0
FRAMES_PER_S = 5


@dataclass
class Score:
    """How detected boxes compare with true ones of at least 30 px."""

    true: int = 0
    found: int = 0
    false: int = 0
    foot_errors_px: list[float] = field(default_factory=list)

    def add(self, boxes: list[Box], truths: list[TrueBox]) -> None:
        """Compares the boxes of a frame: a true box is found by one of IoU above 0.5."""
        matched = set()
        for truth in truths:
            left, top, right, bottom = truth.sides_px
            if bottom - top < LEAST_HEIGHT_PX:
                continue
            self.true += 1
            overlap, index = max(((iou(box, truth), i) for i, box in enumerate(boxes)), default=(0.0, -1))
            if overlap > 0.5:
                matched.add(index)
                self.found += 1
                box = boxes[index]
                middle_error = (box.left_px + box.right_px - left - right) / 2
                self.foot_errors_px.append(float(np.hypot(middle_error, box.bottom_px - bottom)))
        self.false += len(boxes) - len(matched)


def iou(box: Box, truth: TrueBox) -> float:
    """Intersection over union."""
    left, top, right, bottom = truth.sides_px
    width = min(box.right_px, right) - max(box.left_px, left)
    height = min(box.bottom_px, bottom) - max(box.top_px, top)
    if width <= 0 or height <= 0:
        return 0.0
    both = width * height
    return both / (box.width_px * box.height_px + (right - left) * (bottom - top) - both)


def score_of(video: Video, options: MotionOptions | None = None) -> Score:
    detector, score = MotionDetector(options), Score()
    with av.open(str(video.path)) as container:
        for frame, truths in zip(container.decode(video=0), video.boxes, strict=True):
            score.add(detector.detect(np.asarray(frame.to_ndarray(format="bgr24"), np.uint8)), truths)
    return score


def check(name: str, score: Score, *, false_share: float = 0.02) -> None:
    foot_px = float(np.median(score.foot_errors_px))
    print(f"{name}: {score.found} of {score.true} found, {score.false} false, foot point {foot_px:.2f} px")
    assert score.true > 200
    assert score.found >= 0.9 * score.true
    assert score.false <= false_share * score.true
    assert foot_px <= 3.0


def test_a_walker_who_halts_is_found_with_the_foot_point(walk: tuple[Video, list[Row]]) -> None:
    check("one walker", score_of(walk[0]))


@pytest.mark.parametrize("seed", seeds(2))
def test_walkers_of_30_px_are_found_with_their_foot_points(tmp_path: Path, seed: int) -> None:
    rows = simulated_rows(tmp_path, "--targets", "3", "--route", "area", seed=seed, samples=45)
    check(f"three walkers, seed {seed}", score_of(render(rows, tmp_path / "walk.mp4", seed=seed)))


@pytest.mark.parametrize("seed", seeds(5))
def test_people_and_vehicles_of_a_site_are_found_by_each_camera(tmp_path: Path, seed: int) -> None:
    for camera, rows in simulated_site(tmp_path, seed=seed, duration_s=45).items():
        video = render(rows, tmp_path / f"{camera}.mp4", seed=seed, frames_per_s=FRAMES_PER_S)
        # Two who pass each other have one box.
        check(f"site, camera {camera}, seed {seed}", score_of(video), false_share=0.05)


START = datetime(2026, 5, 1, 12, tzinfo=UTC)


def standing(seconds: int, walks_until: int, feet_px: list[float] | None = None) -> list[Row]:
    """Walkers who cross the view and then stand; without times in which they move, they stand all the time."""
    feet = feet_px or [200.0]
    return [
        Row(
            time=START + timedelta(seconds=second),
            target_id=f"person-{number}",
            foot_px=(foot + 25.0 * min(second, walks_until), 420.0),
            width_px=224.0,
            height_px=80.0,
            fix_deg=(0.0, 0.0),
            truth_deg=(0.0, 0.0),
        )
        for second in range(seconds)
        for number, foot in enumerate(feet)
    ]


def rendered(rows: list[Row], seconds: int, frames_per_s: int = 5) -> list[tuple[Image, list[TrueBox]]]:
    """Frames without compression, after two seconds of an empty view."""
    renderer = Renderer(rows, seed=1)
    count = (seconds + 2) * frames_per_s
    return [renderer.frame(START + timedelta(seconds=number / frames_per_s - 2)) for number in range(count)]


def test_vehicles_are_found_with_their_foot_points() -> None:
    seconds, score, detector = 25, Score(), MotionDetector(MotionOptions(class_="car"))
    rows = [
        replace(row, target_id=f"vehicle-{row.target_id}")
        for row in standing(seconds + 1, walks_until=seconds, feet_px=[100.0, 500.0])
    ]
    for image, truths in rendered(rows, seconds):
        score.add(detector.detect(image), truths)
    check("vehicles", score)


def test_who_stops_keeps_the_box_for_longer_than_the_background_needs() -> None:
    options = MotionOptions(history_frames=30)
    detector, seconds = MotionDetector(options), 25
    found = [detector.detect(image) for image, _ in rendered(standing(seconds + 1, walks_until=5), seconds)]
    assert all(len(boxes) == 1 for boxes in found[-60:])


def test_what_stands_for_good_becomes_background() -> None:
    detector, seconds = MotionDetector(MotionOptions(history_frames=8)), 25
    frames = rendered(standing(seconds + 1, walks_until=5), seconds)
    assert [len(detector.detect(image)) for image, _ in frames][-5:] == [0] * 5


def test_a_box_cut_by_the_border_ends_on_it() -> None:
    detector = MotionDetector()
    boxes = [
        box
        for image, truths in rendered(standing(8, walks_until=7, feet_px=[-20.0]), 7)
        for box in detector.detect(image)
        if truths and truths[0].sides_px[0] == 0
    ]
    assert boxes
    assert all(box.left_px == 0.0 for box in boxes)


def test_a_change_of_the_light_is_learnt_within_seconds() -> None:
    seconds = 12
    detector = MotionDetector()
    frames = rendered(standing(seconds + 1, walks_until=seconds), seconds)
    found = []
    for number, (image, _) in enumerate(frames):
        light = 1.0 if number < 20 else 1.7
        found.append(len(detector.detect(np.clip(image * light, 0, 255).astype(np.uint8))))
    assert found[20] == 0, "the view changes as a whole"
    assert found[-20:] == [1] * 20, found


def warned(images: list[Image], options: MotionOptions | None = None) -> str | None:
    """The last warning."""
    detector = MotionDetector(options)
    for image in images:
        detector.detect(image)
    return detector.warning


def test_it_says_when_its_boxes_are_not_to_be_relied_on() -> None:
    seconds = 12
    walk = [image for image, _ in rendered(standing(seconds + 1, walks_until=seconds), seconds)]
    assert warned(walk) is None

    random = np.random.default_rng(1)
    shaken = [np.roll(image, tuple(random.integers(-9, 10, 2)), axis=(0, 1)) for image in walk]
    assert warned(shaken) == CAMERA_MOVES

    covered = [image if number % 14 < 12 else np.full_like(image, 250) for number, image in enumerate(walk)]
    assert warned(covered) == VIEW_CHANGES

    rain = [with_drops(image, random) for image in walk]
    assert warned(rain) == SPECKLED

    crowd = rendered(standing(seconds + 1, walks_until=seconds, feet_px=[60.0 * k for k in range(16)]), seconds)
    assert warned([image for image, _ in crowd]) == CROWDED


def with_drops(image: Image, random: np.random.Generator) -> Image:
    """The image with falling drops."""
    wet = image.copy()
    for column, row in random.integers(0, (image.shape[1], image.shape[0]), (600, 2)):
        cv2.line(wet, (int(column), int(row)), (int(column), int(row) + 5), (215.0, 215.0, 215.0), 1)
    return wet
