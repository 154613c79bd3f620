"""Detects what moves in a fixed view, without weights: background subtraction (MOG2, Zivkovic 2004)."""

from collections import deque
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from sightfix.edge.values import Box, Image

Mask = npt.NDArray[np.uint8]
Grey = npt.NDArray[np.float32]

FOREGROUND = 255
"""Value of MOG2's mask; shadows have a lower one."""
BORDER_PX = 2.0
"""A side this close to the border lies on it."""
WARNING_FRAMES = 30
"""A warning is about this number of frames."""
VAR_THRESHOLD = 16.0
"""Squared Mahalanobis distance from which a pixel is foreground."""
SHADOW_THRESHOLD = 0.5
"""A pixel of the same colour is shadow if it has at least this share of the brightness."""
MIN_VARIANCE = 12.0
"""Least variance of a pixel of the background: noise that compression left out at times."""
JOINING = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 5))
"""Gaps of this size are closed."""
PART_WIDTH_SHARE = 0.3
"""Width of a part of a target, as a share of its widest part's; only a short part may be narrower."""
LEAST_AREA_PX2 = 24
"""Smaller regions are noise."""
SPECKLED_SHARE = 0.004
"""Share of the image in single pixels of foreground, from which it rains."""
CHANGED_SHARE = 0.3
"""Share of foreground from which the view has changed as a whole."""
LEARNING_INTERVAL = 5
"""Frames from one learning of the background to the next."""
THUMBNAIL_PX = (320, 180)
"""Width and height of the image from which shifts of the view are found."""
MOVED_SHARE = 0.0025
"""Shift of the view, as a share of its width, from which the camera has moved: 3 px of 1280."""
RESTING_FACTOR = 6
"""A box that stays where it is for this multiple of the history belongs to the background."""
MIN_REACH_PX = 16.0
"""Least width from which the reach of a box at rest is taken."""

CAMERA_MOVES = "the camera shakes or turns: fix it"
VIEW_CHANGES = "the view changes as a whole: the light changes, or something covers the camera"
SPECKLED = "hundreds of small spots move: rain, snow, leaves or noise; clean or move the camera, or use a model"
CROWDED = (
    "there is a crowd, whose boxes merge: use a model (--detector model.onnx), or record when fewer people are there"
)


@dataclass(frozen=True, kw_only=True)
class MotionOptions:
    """The criteria of a moving target."""

    class_: str = "person"
    """Class of all boxes: motion alone does not tell."""
    min_height_px: float = 16.0
    min_width_px: float = 5.0
    history_frames: int = 300
    """Frames after which what stands still belongs to the background; what moved before it stood, six times as many."""
    warm_up_frames: int = 10
    """Frames at the start from which the background is learnt."""
    max_width_px: int = 960
    """Wider images are reduced."""
    crowd_boxes: int = 12
    """From this number of boxes on, neighbours merge too often."""


@dataclass(slots=True)
class Resting:
    """A box, and for how many frames it has been near the place of an earlier one."""

    box: Box
    earlier: Box
    frames: int = 0


class MotionDetector:
    """Boxes of moving targets before a background that is learnt.

    What moved and then stands keeps its box: pixels within boxes do not enter the background, unless a box stays where
    it is for six times the history.
    """

    def __init__(self, options: MotionOptions | None = None) -> None:
        self._options = options or MotionOptions()
        self._signs: deque[str | None] = deque(maxlen=WARNING_FRAMES)
        self._thumbnail: Grey | None = None
        self._shift_share = 0.0
        """By how much of its width the view has moved lately."""
        self._begin()

    def _begin(self) -> None:
        """Begins with a background that is not known."""
        self._background = cv2.createBackgroundSubtractorMOG2(self._options.history_frames, VAR_THRESHOLD, True)
        self._background.setShadowThreshold(SHADOW_THRESHOLD)
        self._background.setVarMin(MIN_VARIANCE)
        self._frames = 0
        self._learnt: Image = np.empty((0, 0, 3), np.uint8)
        """The image from which the background was learnt last: within boxes it is older."""
        self._resting: list[Resting] = []

    @property
    def warning(self) -> str | None:
        """The fault of most of the latest frames."""
        signs = [sign for sign in self._signs if sign is not None]
        return max(set(signs), key=signs.count) if 2 * len(signs) > WARNING_FRAMES else None

    def detect(self, image: Image) -> list[Box]:
        """The boxes of an image; none while the background is being learnt, also after the whole view has changed."""
        reduction = max(1, -(-image.shape[1] // self._options.max_width_px))
        small = image if reduction == 1 else reduced(image, reduction)
        self._frames += 1
        if self._frames <= self._options.warm_up_frames:
            self._learnt = small
            self._background.apply(small, learningRate=1 / self._frames)
            if self._signs and self._signs[-1] == VIEW_CHANGES:
                self._signs.append(VIEW_CHANGES)
            return []
        mask = self._background.apply(small, learningRate=0)
        moving = np.where(mask == FOREGROUND, np.uint8(FOREGROUND), np.uint8(0))
        if np.count_nonzero(moving) > CHANGED_SHARE * moving.size:
            self._signs.append(VIEW_CHANGES)
            self._begin()
            return []
        clean = cv2.medianBlur(moving, 3)
        boxes = merged(regions_of(np.asarray(clean, np.uint8), self._options, reduction))
        specks = (np.count_nonzero(moving) - np.count_nonzero(clean)) / moving.size
        self._signs.append(self._sign(boxes, specks))
        self._learn(small, boxes, reduction)
        return [on_border(box, image.shape[1], image.shape[0]) for box in boxes if self._is_target(box)]

    def _is_target(self, box: Box) -> bool:
        return box.width_px >= self._options.min_width_px and box.height_px >= self._options.min_height_px

    def _sign(self, boxes: list[Box], speckled_share: float) -> str | None:
        """The fault of a frame."""
        if self._shift_share > MOVED_SHARE:
            return CAMERA_MOVES
        if speckled_share > SPECKLED_SHARE:
            return SPECKLED
        return CROWDED if len(boxes) >= self._options.crowd_boxes else None

    def _learn(self, small: Image, boxes: list[Box], reduction: int) -> None:
        """Takes what is in no box into the background; every few frames, since it takes as long as the detection."""
        self._resting = still_resting(self._resting, boxes)
        if self._frames % LEARNING_INTERVAL:
            return
        before, self._thumbnail = self._thumbnail, thumbnail(small)
        self._shift_share = 0.0 if before is None else shift_share(before, self._thumbnail)
        learnt = small.copy()
        limit = RESTING_FACTOR * self._options.history_frames
        for resting in self._resting:
            if resting.frames < limit:
                part = with_margin(resting.box, reduction)
                learnt[part] = self._learnt[part]
        self._learnt = learnt
        self._background.apply(learnt, learningRate=LEARNING_INTERVAL / self._options.history_frames)


def reduced(image: Image, reduction: int) -> Image:
    """The image with its sides divided by a whole number."""
    size = (image.shape[1] // reduction, image.shape[0] // reduction)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def thumbnail(image: Image) -> Grey:
    """A small grey image, from whose phase the shift of the view is found."""
    small = cv2.resize(image, THUMBNAIL_PX, interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.cvtColor(small, cv2.COLOR_BGR2GRAY), np.float32)


def shift_share(before: Grey, now: Grey) -> float:
    """By how much of its width the view has moved between two thumbnails (phase correlation)."""
    (right_px, down_px), _ = cv2.phaseCorrelate(before, now, cv2.createHanningWindow(THUMBNAIL_PX, cv2.CV_32F))
    return float(np.hypot(right_px, down_px)) / THUMBNAIL_PX[0]


def regions_of(moving: Mask, options: MotionOptions, reduction: int) -> list[Box]:
    """Boxes of connected foreground that may be a part of a target."""
    joined = cv2.morphologyEx(moving, cv2.MORPH_CLOSE, JOINING)
    count, _, statistics, _ = cv2.connectedComponentsWithStats(joined)
    regions = []
    for left, top, width, height, area in statistics[1:count].tolist():
        if area * reduction**2 >= LEAST_AREA_PX2:
            left_px, top_px, width_px, height_px = (float(reduction * side) for side in (left, top, width, height))
            regions.append(Box(left_px, top_px, width_px, height_px, class_=options.class_, score=1.0))
    return regions


def merged(boxes: list[Box]) -> list[Box]:
    """Joins boxes that lie one above the other with a small gap: head, trunk and legs of one target."""
    remaining = sorted(boxes, key=lambda box: -box.width_px * box.height_px)
    joined: list[Box] = []
    while remaining:
        box = remaining.pop(0)
        near = next((other for other in remaining if is_part(box, other)), None)
        while near is not None:
            remaining.remove(near)
            box = union(box, near)
            near = next((other for other in remaining if is_part(box, other)), None)
        joined.append(box)
    return joined


def is_part(box: Box, other: Box) -> bool:
    """True if a smaller box belongs to a box: nearly below or above it, or overlapping it."""
    overlap_px = min(box.right_px, other.right_px) - max(box.left_px, other.left_px)
    gap_px = max(box.top_px, other.top_px) - min(box.bottom_px, other.bottom_px)
    narrow, wide = sorted((box, other), key=lambda it: it.width_px)
    tall_px = max(box.height_px, other.height_px)
    if overlap_px <= 0.4 * narrow.width_px or gap_px >= 0.2 * tall_px:
        return False
    # A person beside a vehicle is narrow and tall.
    return gap_px <= 0 or narrow.width_px >= PART_WIDTH_SHARE * wide.width_px or narrow.height_px < wide.height_px / 2


def union(one: Box, other: Box) -> Box:
    """The box around two boxes."""
    left, top = min(one.left_px, other.left_px), min(one.top_px, other.top_px)
    right, bottom = max(one.right_px, other.right_px), max(one.bottom_px, other.bottom_px)
    return Box(left, top, right - left, bottom - top, class_=one.class_, score=max(one.score, other.score))


def on_border(box: Box, width_px: int, height_px: int) -> Box:
    """The box with sides that nearly lie on the border moved onto it, by which the server knows that it is cut."""
    left = 0.0 if box.left_px <= BORDER_PX else box.left_px
    top = 0.0 if box.top_px <= BORDER_PX else box.top_px
    right = width_px if box.right_px >= width_px - BORDER_PX else box.right_px
    bottom = height_px if box.bottom_px >= height_px - BORDER_PX else box.bottom_px
    return replace(box, left_px=left, top_px=top, width_px=right - left, height_px=bottom - top)


def still_resting(before: list[Resting], boxes: list[Box]) -> list[Resting]:
    """For how long each box has been where it is."""
    now = []
    for box in boxes:
        same = next((it for it in before if is_at_rest(it.earlier, box)), None)
        now.append(Resting(box, box) if same is None else Resting(box, same.earlier, same.frames + 1))
    return now


def is_at_rest(before: Box, box: Box) -> bool:
    """True if the foot point has moved by less than a quarter of the width."""
    middles_px = (it.left_px + it.width_px / 2 for it in (before, box))
    reach_px = 0.25 * max(before.width_px, MIN_REACH_PX)
    return abs(next(middles_px) - next(middles_px)) < reach_px and abs(before.bottom_px - box.bottom_px) < reach_px


def with_margin(box: Box, reduction: int) -> tuple[slice, slice]:
    """The rows and columns of a box and its surroundings in the reduced image."""
    margin_px = 4.0 + 0.15 * box.height_px
    left, top = (max(0, int((side - margin_px) / reduction)) for side in (box.left_px, box.top_px))
    right, bottom = (int((side + margin_px) / reduction) + 1 for side in (box.right_px, box.bottom_px))
    return slice(top, bottom), slice(left, right)
