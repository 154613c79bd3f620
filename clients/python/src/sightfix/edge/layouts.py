"""How detection networks write their answers, by family. Arrays have a batch of one.

Sources: the exporters of YOLOX, Ultralytics, RT-DETR (its own and that of Transformers), RF-DETR, torchvision and
TensorFlow's object detection API.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from sightfix.edge.letterbox import Fit

Array = npt.NDArray[Any]
Shape = Sequence[int | str | None]
Normalisation = Literal["bytes", "unit", "imagenet"]
"""Values of the input: 0 to 255, 0 to 1, or 0 to 1 less the mean over the standard deviation of ImageNet."""

STRIDES = (8, 16, 32)


@dataclass(frozen=True)
class Candidates:
    """Boxes in px of the input: left, top, right, bottom, shape (n, 4), with a class and a score each."""

    boxes: Array
    classes: Array
    scores: Array


@dataclass(frozen=True)
class Layout:
    """One family's input and output."""

    fit: Fit
    normalisation: Normalisation
    is_rgb: bool
    decode: Callable[[dict[str, Array], tuple[int, int]], Candidates]
    """From outputs by name, and width and height of the input in px."""
    has_duplicates: bool = True
    """True if non-maximum suppression is still to be done."""


def corners(centred: Array) -> Array:
    """Centre, width and height as left, top, right, bottom; shape (n, 4)."""
    centre, half = centred[:, :2], centred[:, 2:4] / 2
    return np.concatenate((centre - half, centre + half), axis=1)


def best_class(boxes: Array, scores: Array) -> Candidates:
    """Each box with its most probable class; scores of shape (n, classes)."""
    classes = scores.argmax(axis=1)
    return Candidates(boxes, classes, scores[np.arange(len(scores)), classes])


def sigmoid(values: Array) -> Array:
    """The logistic function."""
    return np.asarray(1 / (1 + np.exp(-np.clip(values, -60, 60))))


def only(outputs: dict[str, Array]) -> Array:
    """The first output without its batch."""
    first: Array = next(iter(outputs.values()))[0]
    return first


def yolov8(outputs: dict[str, Array], size_px: tuple[int, int]) -> Candidates:
    """(1, 4 + classes, n): centre, width, height in px, scores."""
    rows = only(outputs).T
    return best_class(corners(rows), rows[:, 4:])


def yolov5(outputs: dict[str, Array], size_px: tuple[int, int]) -> Candidates:
    """(1, n, 5 + classes): centre, width, height in px, objectness, scores."""
    rows = only(outputs)
    return best_class(corners(rows), rows[:, 5:] * rows[:, 4:5])


def yolox(outputs: dict[str, Array], size_px: tuple[int, int]) -> Candidates:
    """(1, cells, 5 + classes): centre within the cell and logarithm of the size, both in cells; objectness, scores."""
    rows = only(outputs)
    cells, strides = grid(size_px)
    centred = np.concatenate(((rows[:, :2] + cells) * strides, np.exp(rows[:, 2:4]) * strides), axis=1)
    return best_class(corners(centred), rows[:, 5:] * rows[:, 4:5])


def grid(size_px: tuple[int, int]) -> tuple[Array, Array]:
    """Column and row of each cell, shape (cells, 2), and its side in px, shape (cells, 1)."""
    cells, strides = [], []
    for stride in STRIDES:
        columns, rows = np.meshgrid(np.arange(size_px[0] // stride), np.arange(size_px[1] // stride))
        cells.append(np.stack((columns.ravel(), rows.ravel()), axis=1))
        strides.append(np.full((columns.size, 1), stride))
    return np.concatenate(cells), np.concatenate(strides)


def end_to_end(outputs: dict[str, Array], size_px: tuple[int, int]) -> Candidates:
    """(1, n, 6): left, top, right, bottom in px, score, class."""
    rows = only(outputs)
    return Candidates(rows[:, :4], rows[:, 5].astype(int), rows[:, 4])


def queries(boxes: str, logits: str) -> Callable[[dict[str, Array], tuple[int, int]], Candidates]:
    """The decoder of two outputs: boxes (1, n, 4) as centre, width, height from 0 to 1, and logits (1, n, classes)."""

    def decode(outputs: dict[str, Array], size_px: tuple[int, int]) -> Candidates:
        scaled = corners(outputs[boxes][0]) * np.array(size_px * 2)
        return best_class(scaled, sigmoid(outputs[logits][0]))

    return decode


def labelled(outputs: dict[str, Array], size_px: tuple[int, int]) -> Candidates:
    """`boxes` (n, 4) as left, top, right, bottom in px, `labels` (n) and `scores` (n), with or without a batch."""
    boxes, labels, scores = (outputs[name] for name in ("boxes", "labels", "scores"))
    return Candidates(boxes.reshape(-1, 4), labels.ravel().astype(int), scores.ravel())


def tensorflow(outputs: dict[str, Array], size_px: tuple[int, int]) -> Candidates:
    """`detection_boxes` (1, n, 4) as top, left, bottom, right from 0 to 1; the first `num_detections` count."""
    count = int(outputs["num_detections"].ravel()[0])
    boxes = outputs["detection_boxes"][0, :count][:, (1, 0, 3, 2)] * np.array(size_px * 2)
    classes = outputs["detection_classes"][0, :count].astype(int)
    return Candidates(boxes, classes, outputs["detection_scores"][0, :count])


LAYOUTS: dict[str, Layout] = {
    "yolox": Layout("corner", "bytes", is_rgb=False, decode=yolox),
    "yolov5": Layout("centre", "unit", is_rgb=True, decode=yolov5),
    "yolov8": Layout("centre", "unit", is_rgb=True, decode=yolov8),
    "yolov10": Layout("centre", "unit", is_rgb=True, decode=end_to_end, has_duplicates=False),
    "rt-detr": Layout("stretch", "unit", is_rgb=True, decode=labelled, has_duplicates=False),
    "rt-detr-transformers": Layout(
        "stretch", "unit", is_rgb=True, decode=queries("pred_boxes", "logits"), has_duplicates=False
    ),
    "rf-detr": Layout("stretch", "imagenet", is_rgb=True, decode=queries("dets", "labels"), has_duplicates=False),
    "ssd": Layout("stretch", "unit", is_rgb=True, decode=labelled, has_duplicates=False),
    "ssd-tensorflow": Layout("stretch", "bytes", is_rgb=True, decode=tensorflow, has_duplicates=False),
}


def recognised(inputs: Sequence[str], outputs: dict[str, Shape], size_px: tuple[int, int]) -> str | None:
    """The name of the layout of a graph, by the names of its inputs and the names and shapes of its outputs."""
    names = set(outputs)
    by_names = {
        "rf-detr": {"dets", "labels"},
        "rt-detr-transformers": {"logits", "pred_boxes"},
        "ssd-tensorflow": {"detection_boxes", "detection_classes", "detection_scores", "num_detections"},
    }
    for layout, needed in by_names.items():
        if needed <= names:
            return layout
    if {"boxes", "labels", "scores"} <= names:
        return "rt-detr" if "orig_target_sizes" in inputs else "ssd"
    return by_shape(next(iter(outputs.values())), size_px) if len(outputs) == 1 else None


def by_shape(shape: Shape, size_px: tuple[int, int]) -> str | None:
    """The layout of a single output of three dimensions."""
    if len(shape) != len(("batch", "rows", "columns")):
        return None
    cells = sum((size_px[0] // stride) * (size_px[1] // stride) for stride in STRIDES)
    _, rows, columns = shape
    match (rows, columns):
        case (_, 6) if rows not in (cells, 3 * cells):
            return "yolov10"
        case (_, number) if number == cells:
            return "yolov8"
        case (number, _) if number == cells:
            return "yolox"
        case (number, _) if number == 3 * cells:
            return "yolov5"
    return None
