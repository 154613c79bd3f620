"""Ids over time."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import numpy as np

from sightfix.edge.tracking import Tracker
from sightfix.edge.values import Box

START = datetime(2026, 5, 1, 12, tzinfo=UTC)
FRAMES_PER_S = 10


@dataclass
class Walk:
    """Four walkers who cross each other; each is hidden for a second, and 3 % of the boxes are missing."""

    random: np.random.Generator

    def __post_init__(self) -> None:
        self.heights = self.random.uniform(35, 95, 4)
        self.speeds = self.random.choice((-1, 1), 4) * self.heights * self.random.uniform(0.55, 0.85, 4)
        self.hidden_s = self.random.uniform(8, 12, 4)
        self.meeting_s = self.random.uniform(5, 15, 4)

    def boxes(self, time_s: float) -> list[tuple[int, Box]]:
        """The boxes of an instant with their walkers."""
        boxes = []
        for walker, height in enumerate(self.heights):
            middle = 640 + self.speeds[walker] * (time_s - self.meeting_s[walker])
            is_hidden = 0 <= time_s - self.hidden_s[walker] < 1 or self.random.random() < 0.03
            if is_hidden or not 0 < middle < 1280:
                continue
            width = 0.3 * height * (0.75 + 0.25 * abs(np.sin(5.6 * time_s + walker)))
            exact = (middle - width / 2, 120 + 4 * height, middle + width / 2, 120 + 5 * height)
            left, top, right, bottom = self.random.normal(0, 1, 4) + exact
            boxes.append((walker, Box(left, top, right - left, bottom - top, "person", 1.0)))
        return boxes


def test_ids_last_over_occlusions_of_a_second() -> None:
    same = occlusions = 0
    for seed in range(12):
        tracker, walk = Tracker(lambda: "a-"), Walk(np.random.default_rng(seed))
        ids: dict[int, dict[int, str]] = defaultdict(dict)
        for number in range(20 * FRAMES_PER_S):
            boxes = walk.boxes(number / FRAMES_PER_S)
            walker_of = {id(box): walker for walker, box in boxes}
            time = START + timedelta(seconds=number / FRAMES_PER_S)
            for tracked in tracker.update([box for _, box in boxes], time):
                ids[walker_of[id(tracked.box)]][number] = tracked.tracker_id
        for walker, hidden_s in enumerate(walk.hidden_s):
            around = int(hidden_s * FRAMES_PER_S)
            before = [id_ for number, id_ in ids[walker].items() if around - 10 <= number <= around]
            after = [id_ for number, id_ in ids[walker].items() if around + 10 < number <= around + 20]
            if before and after:
                occlusions += 1
                same += before[-1] == after[-1]
    print(f"{same} of {occlusions} ids last over an occlusion of a second")
    assert occlusions > 30
    assert same >= 0.95 * occlusions


def test_a_box_of_one_frame_has_no_id_and_ids_begin_with_the_prefix() -> None:
    tracker, box = Tracker(lambda: "run-"), Box(100, 100, 20, 60, "person", 1.0)
    assert tracker.update([box], START) == []
    (tracked,) = tracker.update([box], START + timedelta(seconds=0.1))
    assert tracked.tracker_id.startswith("run-")
    assert tracker.update([], START + timedelta(seconds=0.2)) == []


def test_a_target_that_is_away_for_long_comes_back_with_a_new_id() -> None:
    tracker, box = Tracker(lambda: "", longest_occlusion_s=2.0), Box(100, 100, 20, 60, "person", 1.0)

    def id_after(since_s: float) -> str:
        times = [START + timedelta(seconds=since_s + number / FRAMES_PER_S) for number in range(4)]
        return [tracker.update([box], time) for time in times][-1][0].tracker_id

    first = id_after(0.0)
    assert id_after(1.5) == first
    assert id_after(5.0) != first


def test_after_a_clock_that_was_set_back_targets_have_new_ids() -> None:
    prefixes, box = iter(("a-", "b-")), Box(100, 100, 20, 60, "person", 1.0)
    tracker = Tracker(lambda: next(prefixes))
    times = [START + timedelta(seconds=seconds) for seconds in (0.0, 0.1, -60.0, -59.9)]
    ids = [[it.tracker_id for it in tracker.update([box], time)] for time in times]
    assert ids == [[], ["a-0"], [], ["b-0"]]
