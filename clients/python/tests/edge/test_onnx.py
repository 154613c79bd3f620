"""Networks of every layout, made by hand: each finds the bright rectangle in its input, so its answers are exact."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from sightfix.edge.letterbox import Letterbox
from sightfix.edge.onnx_detector import ModelError, ModelOptions, OnnxDetector
from sightfix.edge.values import Image

SIZE = 640
CELLS = (SIZE // 8) ** 2 + (SIZE // 16) ** 2 + (SIZE // 32) ** 2
CLASSES = 3
WANTED = 1
"""Number of the class that the networks give."""
QUERIES = 300
LOGIT = 4.0
NAMES = {0: "bicycle", 1: "person", 2: "car"}


class Graph:
    """Nodes of a network of opset 17."""

    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.constants: list[Any] = []

    def constant(self, values: Any, kind: type = np.float32) -> str:
        """A tensor."""
        name = f"c{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.asarray(values, kind), name))
        return name

    def add(self, operator: str, *inputs: str, **attributes: Any) -> str:
        """The output of a new node."""
        name = f"n{len(self.nodes)}"
        self.nodes.append(helper.make_node(operator, list(inputs), [name], **attributes))
        return name

    def cast(self, value: str, kind: int = TensorProto.FLOAT) -> str:
        """The value as another type."""
        return self.add("Cast", value, to=kind)

    def sides(self, image: str, threshold: float, *, is_last: bool = False) -> list[str]:
        """Left, top, right and bottom of what is brighter in every channel, each of shape (1, 1)."""
        darkest = self.add("ReduceMin", self.cast(image), axes=[3 if is_last else 1], keepdims=0)
        mask = self.cast(self.add("Greater", darkest, self.constant(threshold)))
        across, down = (self.add("ReduceMax", mask, axes=[axis], keepdims=0) for axis in (1, 2))
        left, top = (self.cast(self.add("ArgMax", it, axis=1, keepdims=1)) for it in (across, down))
        last = (self.cast(self.add("ArgMax", it, axis=1, keepdims=1, select_last_index=1)) for it in (across, down))
        right, bottom = (self.add("Add", it, self.constant(1.0)) for it in last)
        return [left, top, right, bottom]

    def centred(self, sides: list[str]) -> list[str]:
        """Centre, width and height."""
        left, top, right, bottom = sides
        half = self.constant(0.5)
        return [
            self.add("Mul", self.add("Add", left, right), half),
            self.add("Mul", self.add("Add", top, bottom), half),
            self.add("Sub", right, left),
            self.add("Sub", bottom, top),
        ]

    def scaled(self, values: list[str], factor: float) -> list[str]:
        """Values times a factor."""
        return [self.add("Mul", it, self.constant(factor)) for it in values]

    def table(self, row: list[str], rows: int, *, columns_first: bool = False, filler: float = 0.0) -> str:
        """A row of values (1, 1) among equal rows of filler: (1, rows, columns), or (1, columns, rows)."""
        line = self.add("Concat", *row, axis=1)
        first = self.add("Unsqueeze", line, self.constant([2 if columns_first else 1], np.int64))
        shape = (1, len(row), rows - 1) if columns_first else (1, rows - 1, len(row))
        return self.add("Concat", first, self.constant(np.full(shape, filler)), axis=2 if columns_first else 1)

    def numbers(self, *values: float) -> list[str]:
        """Constants of shape (1, 1)."""
        return [self.constant([[value]]) for value in values]

    def named(self, value: str, name: str) -> str:
        """The value under the name of an output."""
        self.nodes.append(helper.make_node("Identity", [value], [name]))
        return name

    def save(
        self,
        path: Path,
        outputs: dict[str, list[int | str]],
        *,
        input_shape: list[int | str] | None = None,
        input_type: int = TensorProto.FLOAT,
        has_sizes: bool = False,
        kinds: dict[str, int] | None = None,
    ) -> Path:
        """Writes the network."""
        inputs = [helper.make_tensor_value_info("images", input_type, input_shape or [1, 3, SIZE, SIZE])]
        if has_sizes:
            inputs.append(helper.make_tensor_value_info("orig_target_sizes", TensorProto.INT64, [1, 2]))
        described = [
            helper.make_tensor_value_info(name, (kinds or {}).get(name, TensorProto.FLOAT), shape)
            for name, shape in outputs.items()
        ]
        graph = helper.make_graph(self.nodes, "rectangle", inputs, described, self.constants)
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
        model.metadata_props.add(key="names", value=str(NAMES))
        onnx.checker.check_model(model)
        onnx.save(model, str(path))
        return path


SCORES = (0.1, 0.9, 0.2)
LOGITS = (-LOGIT, LOGIT, -LOGIT)


def yolov8(path: Path) -> Path:
    graph = Graph()
    row = graph.centred(graph.sides("images", 0.9)) + graph.numbers(*SCORES)
    graph.named(graph.table(row, CELLS, columns_first=True), "output0")
    return graph.save(path, {"output0": [1, 4 + CLASSES, CELLS]})


def yolov5(path: Path) -> Path:
    graph = Graph()
    row = graph.centred(graph.sides("images", 0.9)) + graph.numbers(0.95, *SCORES)
    graph.named(graph.table(row, 3 * CELLS), "output0")
    return graph.save(path, {"output0": [1, 3 * CELLS, 5 + CLASSES]})


def yolox(path: Path) -> Path:
    """The first cell of the finest grid, at column 0 and row 0, has the answer."""
    graph = Graph()
    x, y, width, height = graph.scaled(graph.centred(graph.sides("images", 230.0)), 1 / 8)
    row = [x, y, graph.add("Log", width), graph.add("Log", height), *graph.numbers(0.95, *SCORES)]
    graph.named(graph.table(row, CELLS), "output")
    return graph.save(path, {"output": [1, CELLS, 5 + CLASSES]})


def yolov10(path: Path) -> Path:
    graph = Graph()
    row = graph.sides("images", 0.9) + graph.numbers(0.9, WANTED)
    graph.named(graph.table(row, QUERIES), "output0")
    return graph.save(path, {"output0": [1, QUERIES, 6]})


def rt_detr(path: Path) -> Path:
    """Its own exporter scales boxes by the size that it is given."""
    graph = Graph()
    sizes = graph.cast("orig_target_sizes")
    factors = graph.add("Div", graph.add("Concat", sizes, sizes, axis=1), graph.constant(float(SIZE)))
    line = graph.add("Mul", graph.add("Concat", *graph.sides("images", 0.9), axis=1), factors)
    boxes = graph.add("Unsqueeze", line, graph.constant([1], np.int64))
    graph.named(graph.add("Concat", boxes, graph.constant(np.zeros((1, QUERIES - 1, 4))), axis=1), "boxes")
    graph.named(graph.constant([[WANTED, *[0] * (QUERIES - 1)]], np.int64), "labels")
    graph.named(graph.constant([[0.9, *[0.0] * (QUERIES - 1)]]), "scores")
    outputs: dict[str, list[int | str]] = {"labels": [1, QUERIES], "boxes": [1, QUERIES, 4], "scores": [1, QUERIES]}
    return graph.save(path, outputs, has_sizes=True, kinds={"labels": TensorProto.INT64})


def queries(boxes: str, logits: str, threshold: float) -> Callable[[Path], Path]:
    def build(path: Path) -> Path:
        graph = Graph()
        sides = graph.scaled(graph.centred(graph.sides("images", threshold)), 1 / SIZE)
        graph.named(graph.table(sides, QUERIES), boxes)
        graph.named(graph.table(graph.numbers(*LOGITS), QUERIES, filler=-LOGIT), logits)
        return graph.save(path, {boxes: [1, QUERIES, 4], logits: [1, QUERIES, CLASSES]})

    return build


def ssd(path: Path) -> Path:
    """As torchvision exports it: without a batch, with as many rows as there are boxes."""
    graph = Graph()
    graph.named(graph.add("Concat", *graph.sides("images", 0.9), axis=1), "boxes")
    graph.named(graph.constant([WANTED], np.int64), "labels")
    graph.named(graph.constant([0.9]), "scores")
    outputs: dict[str, list[int | str]] = {"boxes": ["n", 4], "scores": ["n"], "labels": ["n"]}
    return graph.save(path, outputs, kinds={"labels": TensorProto.INT64})


def ssd_tensorflow(path: Path) -> Path:
    """Bytes with the channels last, of any size; top before left; only the first detection counts."""
    graph = Graph()
    left, top, right, bottom = graph.scaled(graph.sides("images", 230.0, is_last=True), 1 / SIZE)
    graph.named(graph.table([top, left, bottom, right], 10, filler=0.3), "detection_boxes")
    graph.named(graph.constant([[WANTED] * 10]), "detection_classes")
    graph.named(graph.constant([[0.9] * 10]), "detection_scores")
    graph.named(graph.constant([1.0]), "num_detections")
    outputs: dict[str, list[int | str]] = {
        "detection_boxes": [1, 10, 4],
        "detection_classes": [1, 10],
        "detection_scores": [1, 10],
        "num_detections": [1],
    }
    return graph.save(path, outputs, input_shape=[1, "h", "w", 3], input_type=TensorProto.UINT8)


IMAGENET_THRESHOLD = (0.95 - 0.406) / 0.225
BUILDERS: dict[str, Callable[[Path], Path]] = {
    "yolox": yolox,
    "yolov5": yolov5,
    "yolov8": yolov8,
    "yolov10": yolov10,
    "rt-detr": rt_detr,
    "rt-detr-transformers": queries("pred_boxes", "logits", 0.9),
    "rf-detr": queries("dets", "labels", IMAGENET_THRESHOLD - 0.3),
    "ssd": ssd,
    "ssd-tensorflow": ssd_tensorflow,
}


def picture(width: int, height: int, sides: tuple[int, int, int, int]) -> Image:
    """A dark image with a white rectangle."""
    image = np.full((height, width, 3), 30, np.uint8)
    left, top, right, bottom = sides
    image[top:bottom, left:right] = 255
    return image


@pytest.mark.parametrize("layout", BUILDERS)
def test_every_layout_is_recognised_and_decoded_to_the_pixel(tmp_path: Path, layout: str) -> None:
    detector = OnnxDetector(BUILDERS[layout](tmp_path / "model.onnx"))
    assert detector.layout_name == layout
    # Scaled by whole numbers, so that no pixel of the input is a mixture.
    (box,) = detector.detect(picture(1280, 1280, (400, 500, 480, 780)))
    assert (box.left_px, box.top_px, box.right_px, box.bottom_px) == pytest.approx((400, 500, 480, 780), abs=0.01)
    assert box.class_ == "person"
    assert box.score == pytest.approx(0.9, abs=0.1)


@pytest.mark.parametrize("layout", BUILDERS)
@pytest.mark.parametrize("size_px", [(1280, 720), (641, 479), (360, 1000), (1919, 1079)])
def test_boxes_come_back_through_any_letterbox(tmp_path: Path, layout: str, size_px: tuple[int, int]) -> None:
    width, height = size_px
    sides = (width // 4, height // 3, width // 2, 2 * height // 3)
    detector = OnnxDetector(BUILDERS[layout](tmp_path / "model.onnx"))
    (box,) = detector.detect(picture(width, height, sides))
    # A side of the rectangle may fall into a pixel of the input.
    letterbox = Letterbox(width, height, SIZE, SIZE, fit="stretch" if "detr" in layout or "ssd" in layout else "centre")
    pixel = max(width / letterbox.scaled_px[0], height / letterbox.scaled_px[1])
    found = np.array((box.left_px, box.top_px, box.right_px, box.bottom_px))
    assert np.abs(found - sides).max() <= 0.75 * pixel + 0.01


@pytest.mark.parametrize("fit", ["centre", "corner", "stretch"])
def test_the_image_lies_where_boxes_are_taken_from(fit: Any) -> None:
    box = Letterbox(1001, 333, 640, 480, fit=fit)
    white = np.full((333, 1001, 3), 255, np.uint8)
    rows, columns = np.nonzero(box.apply(white)[..., 0] == 255)
    inside = np.array([(columns.min(), rows.min(), columns.max() + 1, rows.max() + 1)])
    assert box.to_image(inside)[0] == pytest.approx((0, 0, 1001, 333))
    assert box.to_image(np.array([(-50, -50, 900, 900)]))[0] == pytest.approx((0, 0, 1001, 333)), "cut at the border"


def test_names_and_selection(tmp_path: Path) -> None:
    model, image = yolov8(tmp_path / "model.onnx"), picture(640, 640, (100, 100, 200, 300))
    names = tmp_path / "names.txt"
    names.write_text("Fahrrad\nMensch\n")
    (box,) = OnnxDetector(model, ModelOptions(class_names=names)).detect(image)
    assert box.class_ == "Mensch"
    assert OnnxDetector(model, ModelOptions(only_classes=frozenset({"car"}))).detect(image) == []
    assert OnnxDetector(model, ModelOptions(min_score=0.95)).detect(image) == []


def test_a_duplicate_is_dropped(tmp_path: Path) -> None:
    graph = Graph()
    sides = graph.centred(graph.sides("images", 0.9))
    first = graph.table(sides + graph.numbers(*SCORES), CELLS - 1, columns_first=True)
    again = graph.table(sides + graph.numbers(0.0, 0.7, 0.0), 2, columns_first=True)
    one = graph.add("Slice", again, *(graph.constant([it], np.int64) for it in (0, 1, 2)))
    graph.named(graph.add("Concat", first, one, axis=2), "output0")
    model = graph.save(tmp_path / "model.onnx", {"output0": [1, 4 + CLASSES, CELLS]})
    image = picture(640, 640, (100, 100, 200, 300))
    assert [round(box.score, 2) for box in OnnxDetector(model).detect(image)] == [0.9]
    assert len(OnnxDetector(model, ModelOptions(max_overlap=1.0)).detect(image)) == 2


def test_a_graph_of_no_known_layout_is_refused_with_what_to_do(tmp_path: Path) -> None:
    graph = Graph()
    graph.named(graph.constant(np.zeros((1, 10, 7))), "answers")
    model = graph.save(tmp_path / "model.onnx", {"answers": [1, 10, 7]})
    with pytest.raises(ModelError, match=r"answers \[1, 10, 7\].*--layout"):
        OnnxDetector(model)
    broken = tmp_path / "broken.onnx"
    broken.write_bytes(b"no model")
    with pytest.raises(ModelError, match="broken"):
        OnnxDetector(broken)
