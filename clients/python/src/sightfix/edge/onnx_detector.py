"""Detects with a network of the user's own, in onnxruntime."""

from __future__ import annotations

import ast
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnxruntime

from sightfix.edge.layouts import LAYOUTS, Array, Candidates, Layout, Normalisation, recognised
from sightfix.edge.letterbox import Letterbox
from sightfix.edge.values import Box, Image

IMAGENET_MEAN = np.array((0.485, 0.456, 0.406), np.float32)
IMAGENET_DEVIATION = np.array((0.229, 0.224, 0.225), np.float32)
CHANNELS = 3
WITHOUT_USE = ("AzureExecutionProvider",)


class ModelError(Exception):
    """A model cannot be used as it was given."""


@dataclass(frozen=True, kw_only=True)
class ModelOptions:
    """Facts that the graph does not contain, and the selection of its boxes."""

    layout: str | None = None
    """A name of `LAYOUTS`; by default recognised."""
    input_size_px: tuple[int, int] = (640, 640)
    """Width and height, for a graph that leaves them open."""
    class_names: Path | None = None
    """A name per line; by default those of the graph's metadata."""
    only_classes: frozenset[str] = frozenset()
    """Classes that are wanted; none means all."""
    min_score: float = 0.4
    max_overlap: float = 0.6
    """If two boxes of one class have a larger IoU, the one with the lower score is dropped."""
    threads: int = 1


class OnnxDetector:
    """Boxes of a network.

    Raises:
        ModelError: The graph cannot be read, or its layout is not recognised.
    """

    warning: str | None = None

    def __init__(self, model: Path, options: ModelOptions | None = None) -> None:
        self._options = options or ModelOptions()
        self._session = open_session(model, self._options.threads)
        image, *others = self._session.get_inputs()
        self._input: Any = image
        self._size_input = others[0].name if others else None
        self._is_channels_last = image.shape[-1] == CHANNELS
        self._size_px = input_size_px(image.shape, self._options.input_size_px, is_last=self._is_channels_last)
        self.layout_name = self._recognised_layout(model)
        self._layout: Layout = LAYOUTS[self.layout_name]
        self._names = class_names(self._session, self._options.class_names)

    def detect(self, image: Image) -> list[Box]:
        """The boxes of an image."""
        box = Letterbox(image.shape[1], image.shape[0], *self._size_px, fit=self._layout.fit)
        inputs = {self._input.name: self._tensor(box.apply(image))}
        if self._size_input is not None:
            # The network scales its boxes by this: to the input, like those of all others.
            inputs[self._size_input] = np.array([self._size_px], np.int64)
        names = [output.name for output in self._session.get_outputs()]
        outputs = dict(zip(names, self._session.run(None, inputs), strict=True))
        return self._boxes(self._layout.decode(outputs, self._size_px), box)

    def _recognised_layout(self, model: Path) -> str:
        outputs = {output.name: output.shape for output in self._session.get_outputs()}
        inputs = [it.name for it in self._session.get_inputs()]
        name = self._options.layout or recognised(inputs, outputs, self._size_px)
        if name not in LAYOUTS:
            shapes = ", ".join(f"{output} {shape}" for output, shape in outputs.items())
            known = ", ".join(LAYOUTS)
            raise ModelError(f"{model}: the outputs {shapes} are of no known layout; name one by --layout: {known}")
        return name

    def _tensor(self, boxed: Image) -> Array:
        """The network's input: (1, 3, height, width), or (1, height, width, 3)."""
        ordered = boxed[..., ::-1] if self._layout.is_rgb else boxed
        kind = {"tensor(uint8)": np.uint8, "tensor(float16)": np.float16}.get(self._input.type, np.float32)
        values = ordered if kind == np.uint8 else normalised(ordered, self._layout.normalisation).astype(kind)
        placed = values if self._is_channels_last else values.transpose(2, 0, 1)
        return np.ascontiguousarray(placed[None])

    def _boxes(self, candidates: Candidates, letterbox: Letterbox) -> list[Box]:
        sure = candidates.scores >= self._options.min_score
        boxes = letterbox.to_image(candidates.boxes[sure])
        classes, scores = candidates.classes[sure], candidates.scores[sure]
        found = [
            Box(left, top, right - left, bottom - top, self._name(int(class_)), min(float(score), 1.0))
            for (left, top, right, bottom), class_, score in zip(boxes.tolist(), classes, scores, strict=True)
            if right > left and bottom > top
        ]
        kept = without_duplicates(found, self._options.max_overlap) if self._layout.has_duplicates else found
        wanted = self._options.only_classes
        return [box for box in kept if not wanted or box.class_ in wanted]

    def _name(self, class_: int) -> str:
        return self._names.get(class_, f"class-{class_}")


def open_session(model: Path, threads: int) -> Any:
    """The graph in onnxruntime, on the best of what providers there are."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    providers = [it for it in onnxruntime.get_available_providers() if it not in WITHOUT_USE]
    try:
        return onnxruntime.InferenceSession(str(model), options, providers=providers)
    except Exception as error:  # the exceptions of onnxruntime have no common class
        raise ModelError(f"{model}: {error}") from error


def input_size_px(shape: list[Any], default_px: tuple[int, int], *, is_last: bool) -> tuple[int, int]:
    """Width and height of the input; the default where the graph leaves them open."""
    height, width = shape[1:3] if is_last else shape[2:4]
    return (width, height) if isinstance(width, int) and isinstance(height, int) else default_px


def normalised(image: Image, normalisation: Normalisation) -> Array:
    """Values as the network expects them; shape (height, width, 3)."""
    values = image.astype(np.float32)
    if normalisation == "bytes":
        return values
    values /= np.float32(255)
    return (values - IMAGENET_MEAN) / IMAGENET_DEVIATION if normalisation == "imagenet" else values


def without_duplicates(boxes: list[Box], max_overlap: float) -> list[Box]:
    """Non-maximum suppression within each class."""
    numbers = {name: number for number, name in enumerate(sorted({box.class_ for box in boxes}))}
    sides = [(box.left_px, box.top_px, box.width_px, box.height_px) for box in boxes]
    scores, classes = [box.score for box in boxes], [numbers[box.class_] for box in boxes]
    if not boxes:
        return []
    kept = cv2.dnn.NMSBoxesBatched(sides, scores, classes, 0.0, max_overlap)
    return [boxes[index] for index in np.asarray(kept).ravel()]


def class_names(session: Any, file: Path | None) -> dict[int, str]:
    """Names by number: of a file with one per line, or of the metadata `names` (a dictionary or a list).

    Raises:
        ModelError: The file cannot be read.
    """
    if file is not None:
        try:
            lines = file.read_text(encoding="utf-8").splitlines()
        except (OSError, UnicodeDecodeError) as error:
            raise ModelError(f"{file}: {error}") from error
        return {number: line.strip() for number, line in enumerate(lines) if line.strip()}
    text = session.get_modelmeta().custom_metadata_map.get("names", "")
    try:
        names = ast.literal_eval(text)
    except (ValueError, SyntaxError):
        return {}
    pairs = names.items() if isinstance(names, dict) else enumerate(names)
    return {int(number): str(name) for number, name in pairs}
