"""Frames and boxes."""

from dataclasses import dataclass
from datetime import datetime
from typing import Protocol

import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.uint8]
"""Shape (height, width, 3): blue, green, red."""


@dataclass(frozen=True, slots=True)
class Frame:
    """An image and the instant of its exposure."""

    image: Image
    time: datetime


@dataclass(frozen=True, slots=True)
class Box:
    """A detection, in pixels of the frame."""

    left_px: float
    top_px: float
    width_px: float
    height_px: float
    class_: str
    score: float
    """0 to 1."""

    @property
    def right_px(self) -> float:
        """The right side."""
        return self.left_px + self.width_px

    @property
    def bottom_px(self) -> float:
        """The lower side."""
        return self.top_px + self.height_px


@dataclass(frozen=True, slots=True)
class TrackedBox:
    """A box with the id that the tracker gave it."""

    box: Box
    tracker_id: str


class Detector(Protocol):
    """Finds boxes in images of one view."""

    def detect(self, image: Image) -> list[Box]:
        """The boxes of an image. Images come in the order of their times."""

    @property
    def warning(self) -> str | None:
        """Why the boxes of the latest images are not to be relied on, if so."""
