"""Trains a camera from a video and the fixes of who walks in it."""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import groupby
from pathlib import Path

from sightfix import Client, InvalidRequestError
from sightfix.edge.clock_offset import ClockOffset, estimate_offset, shifted
from sightfix.edge.fixes import Track
from sightfix.edge.outputs import Recorder
from sightfix.edge.values import Frame, TrackedBox
from sightfix.models import ModelVersion, PairedSamples, TrainingRun

LOG = logging.getLogger(__name__)

TimedBox = tuple[datetime, TrackedBox]

ALONE_SHARE = 0.98
"""Share of the frames with boxes that have a single one; from it on, one walker is taken to be in the video."""
LARGEST_MATCH_WINDOW_S = 30.0
"""Largest window of the server's search for whose boxes are whose, where several people are in view."""
WALK_AGAIN = (
    "walk again: stop for some 15 s at two places, turn at corners, and cross the view near and far from the camera"
)


class LearnError(Exception):
    """The camera could not be trained from this recording; the message says what to record instead."""


@dataclass(frozen=True)
class Learnt:
    """The results of a recording."""

    paired: PairedSamples
    run: TrainingRun
    model: ModelVersion | None
    is_active: bool
    """True if the new version answers now."""

    def lines(self) -> list[str]:
        """The outcome, the accuracy, and what would improve it, for people."""
        lines = [f"{self.paired.accepted} pairs of box and fix"]
        lines += self.paired.warnings
        held_out = None if self.model is None else self.model.metadata.held_out
        if held_out is not None:
            own_m = (2 * held_out.e_regression_m2) ** 0.5
            lines.append(
                f"accuracy: held-out fixes are {held_out.mean_to_fix_m:.2f} m from the positions in the mean; "
                f"{own_m:.2f} m (root mean square) of it is the camera's own error, the rest the receiver's"
            )
        lines.append(self.run.outcome or "")
        advice = self.run.report.advice if self.run.report is not None else []
        return [*lines, *(f"to improve it: {it}" for it in advice)]


class Collector:
    """Keeps the boxes of a video."""

    def __init__(self) -> None:
        self.boxes: list[TimedBox] = []
        self.image_size_px = (0, 0)

    def take(self, frame: Frame, boxes: list[TrackedBox]) -> None:
        """Keeps the boxes of a frame."""
        self.image_size_px = (frame.image.shape[1], frame.image.shape[0])
        self.boxes += ((frame.time, box) for box in boxes)

    def close(self) -> None:
        """Nothing is left to do."""


def learn(client: Client, camera_id: str, collected: Collector, track: Track, *, clock_window_s: float) -> Learnt:
    """Pairs the boxes of a video with fixes, and trains the camera.

    Args:
        client: The server.
        camera_id: The camera, which exists.
        collected: The boxes of the whole video.
        track: Fixes of the receiver that one of them carries.
        clock_window_s: The clocks of video and receiver differ by at most this.

    Raises:
        LearnError: The recording does not show who carries the receiver, or how far the clocks are off.
        SightfixError: The server refuses, cannot be reached, or cannot train the camera.
    """
    if not collected.boxes:
        raise LearnError("nobody was found in the video: check it with --preview, or use --detector model.onnx")
    if shows_one_walker(collected.boxes):
        paired = pair_walker(client, camera_id, collected, track, clock_window_s)
    else:
        paired = match_walkers(client, camera_id, collected.boxes, track, clock_window_s)
    run = client.training_runs.wait(client.training_runs.start(camera_id))
    model = None if run.model_version is None else client.models.get(camera_id, run.model_version)
    is_active = model is not None and client.models.active(camera_id).number == model.number
    return Learnt(paired, run, model, is_active)


def shows_one_walker(boxes: Sequence[TimedBox]) -> bool:
    """True if hardly any frame has two boxes."""
    counts = [len(list(group)) for _, group in groupby(boxes, key=lambda it: it[0])]
    return counts.count(1) >= ALONE_SHARE * len(counts)


def pair_walker(
    client: Client, camera_id: str, collected: Collector, track: Track, clock_window_s: float
) -> PairedSamples:
    """Pairs the boxes of the only walker with the fixes, by the receiver's clock.

    Raises:
        LearnError: The offset between the clocks is not to be found.
    """
    offset = estimate_offset(collected.boxes, track.fixes, collected.image_size_px, clock_window_s)
    if offset is None:
        raise LearnError(f"boxes and fixes do not overlap for a minute within {clock_window_s:.0f} s; check --start")
    LOG.info("%s", offset_text(offset))
    if not offset.is_sure:
        raise LearnError(f"the offset between the clocks is not sure: {offset_text(offset)}; {WALK_AGAIN}")
    boxes = ((shifted(time, offset), TrackedBox(it.box, track.receiver_id)) for time, it in collected.boxes)
    with tempfile.TemporaryDirectory() as folder:
        detections = record(boxes, Path(folder))
        return client.samples.pair_files(camera_id, detections, track.path, receiver_id=track.receiver_id)


def offset_text(offset: ClockOffset) -> str:
    """The estimate in words."""
    return (
        f"the video's clock is {offset.offset_s:+.2f} s from the receiver's, "
        f"standard deviation {offset.sigma_s:.2f} s; "
        f"the boxes explain {100 * offset.explained:.0f} % of the movement, "
        f"and the next best offset is {min(offset.margin, 700.0):.1f} nats less likely"
    )


def match_walkers(
    client: Client, camera_id: str, boxes: Iterable[TimedBox], track: Track, clock_window_s: float
) -> PairedSamples:
    """Lets the server find out which boxes show the carriers of the receivers, and how far their clocks are off.

    Raises:
        LearnError: Nobody can tell.
    """
    with tempfile.TemporaryDirectory() as folder:
        detections = record(boxes, Path(folder))
        try:
            paired = client.samples.pair_files(
                camera_id,
                detections,
                track.path,
                receiver_id=track.receiver_id,
                match=True,
                clock_window_s=min(clock_window_s, LARGEST_MATCH_WINDOW_S),
                estimate_offset=True,
            )
        except InvalidRequestError as error:
            raise LearnError(
                f"several people are in the video, and it is not sure who has the receiver: {error}"
            ) from error
    for estimate in paired.clock_offsets or []:
        if estimate.clock_offset_s is not None:
            LOG.info(
                "the video's clock is %+.2f s from that of %s, standard deviation %.2f s",
                estimate.clock_offset_s, estimate.receiver_id, estimate.sigma_s or 0.0,
            )  # fmt: skip
    return paired


def record(boxes: Iterable[TimedBox], folder: Path) -> Path:
    """The boxes as a file for pairing."""
    file = folder / "detections.csv"
    with Recorder(file) as recorder:
        for time, box in boxes:
            recorder.write(time, box)
    return file
