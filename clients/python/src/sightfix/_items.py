"""Items of a live stream."""

from dataclasses import dataclass
from datetime import datetime

from sightfix.models import BoundingBox, Fix


@dataclass(frozen=True, kw_only=True, slots=True)
class LiveItem:
    """A box, a fix, or both, of one target at one instant."""

    time: datetime
    """Time of the measurement by the device's clock, with a UTC offset."""
    target_id: str | None = None
    """The target. Without it there is a fused position but no track."""
    receiver_id: str | None = None
    """Which receiver measured the fix; instead of `target_id` for a fix alone."""
    tracker_id: str | None = None
    """Number that the camera's tracker gave a box whose target is not known; instead of `target_id`. The answer's
    `receiver_match` says which receiver the target carries, as soon as that is sure."""
    bounding_box: BoundingBox | None = None
    """The box that the detector gives."""
    fix: Fix | None = None
    """The fix of the receiver."""
    class_: str | None = None
    """The detector's class."""
    score: float | None = None
    """The detector's confidence, 0 to 1."""
