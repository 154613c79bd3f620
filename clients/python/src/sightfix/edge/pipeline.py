"""From frames to tracked boxes, with the time that each stage takes."""

from __future__ import annotations

import logging
import time as clocks
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

from sightfix.edge.outputs import Output
from sightfix.edge.tracking import Tracker
from sightfix.edge.values import Detector, Frame, TrackedBox

LOG = logging.getLogger(__name__)


@dataclass
class StageTimes:
    """Seconds by stage since the start: of the wall clock, and of the processor over all threads."""

    wall_s: dict[str, float] = field(default_factory=dict)
    processor_s: dict[str, float] = field(default_factory=dict)

    def per_frame_ms(self, stage: str, frames: int) -> tuple[float, float]:
        """Time per frame of a stage, or of `all`: of the wall clock, and of the processor."""
        wall_s, processor_s = (
            sum(times.values()) if stage == "all" else times.get(stage, 0.0)
            for times in (self.wall_s, self.processor_s)
        )
        return 1000 * wall_s / frames, 1000 * processor_s / frames

    @contextmanager
    def measure(self, stage: str) -> Iterator[None]:
        """Adds the time of the block to a stage."""
        wall_s, processor_s = clocks.perf_counter(), clocks.process_time()
        try:
            yield
        finally:
            self.wall_s[stage] = self.wall_s.get(stage, 0.0) + clocks.perf_counter() - wall_s
            self.processor_s[stage] = self.processor_s.get(stage, 0.0) + clocks.process_time() - processor_s


class Pipeline:
    """Detects and tracks, and hands the boxes to every output."""

    def __init__(self, detector: Detector, tracker: Tracker, outputs: Sequence[Output]) -> None:
        self._detector = detector
        self._tracker = tracker
        self._outputs = outputs
        self._warning: str | None = None
        self.times = StageTimes()
        self.frames = 0
        self.boxes = 0

    def run(self, frames: Iterable[Frame]) -> None:
        """Processes all frames."""
        remaining = iter(frames)
        while True:
            with self.times.measure("decode"):
                frame = next(remaining, None)
            if frame is None:
                return
            tracked = self.process(frame)
            with self.times.measure("output"):
                for output in self._outputs:
                    output.take(frame, tracked)

    def process(self, frame: Frame) -> list[TrackedBox]:
        """The tracked boxes of a frame."""
        with self.times.measure("detect"):
            boxes = self._detector.detect(frame.image)
        with self.times.measure("track"):
            tracked = self._tracker.update(boxes, frame.time)
        self._warn(self._detector.warning)
        self.frames += 1
        self.boxes += len(tracked)
        return tracked

    def _warn(self, warning: str | None) -> None:
        """Says once when the boxes are not to be relied on, and once when they are again."""
        if warning == self._warning:
            return
        if warning is None:
            LOG.info("boxes can be relied on again")
        else:
            LOG.warning("do not rely on these boxes: %s", warning)
        self._warning = warning
