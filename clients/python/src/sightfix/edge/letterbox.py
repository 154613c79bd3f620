"""Fits images into the input of a network, and boxes back into the image.

Coordinates are those of edges: the left side of the first pixel is 0, the right side of the last one is the width.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
import numpy.typing as npt

from sightfix.edge.values import Image

Boxes = npt.NDArray[np.float64]
"""Shape (n, 4): left, top, right, bottom in px."""

Fit = Literal["centre", "corner", "stretch"]
"""Where the image goes: into the middle with equal margins, into the upper left corner, or over the whole input."""

GREY = 114


@dataclass(frozen=True)
class Letterbox:
    """How an image of one size lies in a network's input."""

    image_width_px: int
    image_height_px: int
    width_px: int
    """Width of the network's input."""
    height_px: int
    fit: Fit

    @property
    def scaled_px(self) -> tuple[int, int]:
        """Width and height of the image in the input."""
        if self.fit == "stretch":
            return self.width_px, self.height_px
        ratio = min(self.width_px / self.image_width_px, self.height_px / self.image_height_px)
        return max(1, round(self.image_width_px * ratio)), max(1, round(self.image_height_px * ratio))

    @property
    def offset_px(self) -> tuple[int, int]:
        """Left and upper margin; the smaller half where a margin is odd."""
        if self.fit != "centre":
            return 0, 0
        width, height = self.scaled_px
        return (self.width_px - width) // 2, (self.height_px - height) // 2

    def apply(self, image: Image) -> Image:
        """The image in the input, with grey margins."""
        (width, height), (left, top) = self.scaled_px, self.offset_px
        scaled = cv2.resize(image, (width, height), interpolation=cv2.INTER_LINEAR)
        boxed = np.full((self.height_px, self.width_px, 3), GREY, np.uint8)
        boxed[top : top + height, left : left + width] = scaled
        return boxed

    def to_image(self, boxes: npt.NDArray[Any]) -> Boxes:
        """Boxes in the input, of shape (n, 4), as boxes in the image, cut at its border."""
        (width, height), (left, top) = self.scaled_px, self.offset_px
        scale = np.array((self.image_width_px / width, self.image_height_px / height) * 2)
        moved = (np.asarray(boxes, np.float64) - np.array((left, top, left, top))) * scale
        limits = np.array((self.image_width_px, self.image_height_px) * 2)
        return np.asarray(np.clip(moved, 0, limits), np.float64)
