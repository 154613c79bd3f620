"""Gives boxes of the same target the same id (OC-SORT of the library `trackers`)."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime

import numpy as np
import supervision as sv
from trackers import DIoU, OCSORTTracker

from sightfix.edge.values import Box, TrackedBox

FRAME_RATE = 30.0
"""A unit of the library: with times of frames, its buffer lasts `lost_track_buffer / FRAME_RATE` seconds."""
UNCONFIRMED = -1
LEAST_DISTANCE_IOU = -0.3
"""Overlap less the squared distance of the centres (DIoU): small boxes that no longer overlap are still near."""


class Tracker:
    """Ids of boxes over time, which last over occlusions.

    Args:
        new_prefix: Draws what begins the ids, so that those of two runs of the program differ, and those before and
            after a clock that was set back.
        longest_occlusion_s: After this time without a box a target gets a new id.
    """

    def __init__(self, new_prefix: Callable[[], str], *, longest_occlusion_s: float = 2.0) -> None:
        self._new_prefix = new_prefix
        self._longest_occlusion_s = longest_occlusion_s
        self._latest: datetime | None = None
        self._begin()

    def _begin(self) -> None:
        """Begins without targets."""
        self._prefix = self._new_prefix()
        self._tracker = OCSORTTracker(
            lost_track_buffer=round(self._longest_occlusion_s * FRAME_RATE),
            frame_rate=FRAME_RATE,
            minimum_consecutive_frames=2,
            minimum_iou_threshold=LEAST_DISTANCE_IOU,
            high_conf_det_threshold=0.0,
            iou=DIoU(),
        )

    def update(self, boxes: list[Box], time: datetime) -> list[TrackedBox]:
        """The boxes of a frame with their ids; without those that have been seen in fewer than two frames."""
        if self._latest is not None and time < self._latest:
            self._begin()
        self._latest = time
        sides = [(box.left_px, box.top_px, box.right_px, box.bottom_px) for box in boxes]
        detections = sv.Detections(
            xyxy=np.array(sides, dtype=np.float64).reshape(-1, 4),
            confidence=np.array([box.score for box in boxes], dtype=np.float64),
            data={"index": np.arange(len(boxes))},
        )
        tracked = self._tracker.update(detections, timestamp=time.timestamp())
        if len(tracked) == 0 or tracked.tracker_id is None:
            return []
        pairs = zip(tracked.data["index"], tracked.tracker_id, strict=True)
        return [TrackedBox(boxes[index], f"{self._prefix}{number}") for index, number in pairs if number != UNCONFIRMED]
