"""Videos of the simulated square and site, with truth: walkers with limbs, vehicles, shadows, ground, noise, H.264.

Boxes of `sightfix simulate` say where each target stands and how large it appears, once a second; between two of
them the target moves on a straight line. What is drawn is the truth: a box is the extent of the drawn silhouette.
"""

from __future__ import annotations

import csv
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import numpy.typing as npt

from tests.conftest import BINARY

Image = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.float32]

WIDTH_PX, HEIGHT_PX = 1280, 720
NOISE_SIGMA = 2.5
SHADOW_FACTOR = 0.6
VEHICLE_WIDTH = 2.8
"""Width of a vehicle as `vehicle` draws it, in heights."""
STANDING_PX = 3.0
"""Who moves by less in a second stands."""


@dataclass(frozen=True)
class TrueBox:
    """A target as drawn: left, top, right and bottom of the silhouette, px."""

    target_id: str
    sides_px: tuple[float, float, float, float]


@dataclass
class Video:
    """A rendered video and what it shows."""

    path: Path
    start: datetime
    times: list[datetime] = field(default_factory=list)
    boxes: list[list[TrueBox]] = field(default_factory=list)
    """By frame, as `times`."""


@dataclass(frozen=True)
class Row:
    """A row of the simulation: foot point, width and height in the image, the phone's fix, the true position."""

    time: datetime
    target_id: str
    foot_px: tuple[float, float]
    width_px: float
    height_px: float
    fix_deg: tuple[float, float]
    truth_deg: tuple[float, float]


def simulated_rows(folder: Path, *options: str, seed: int, samples: int) -> list[Row]:
    """Rows of `sightfix simulate square` with exact boxes."""
    file = folder / f"rows-{seed}-{samples}.csv"
    command = [str(BINARY), "simulate", "square", "--out", str(file), "--samples", str(samples), "--seed", str(seed)]
    subprocess.run([*command, "--box-noise-px", "0", "--quiet", *options], check=True)
    with file.open(newline="") as opened:
        return [to_row(row) for row in csv.DictReader(opened)]


def simulated_site(folder: Path, *, seed: int, duration_s: int) -> dict[str, list[Row]]:
    """Rows of `sightfix simulate site` by camera, of walkers and vehicles that the border of the view does not cut."""
    command = [str(BINARY), "simulate", "site", "--out", str(folder), "--seed", str(seed), "--cameras", "2"]
    scene = ["--walkers", "4", "--vehicles", "2", "--receivers", "1", "--frame-interval-s", "1", "--box-noise-px", "0"]
    subprocess.run([*command, *scene, "--duration-s", str(duration_s), "--quiet"], check=True)

    def rows_of(name: str) -> list[dict[str, str]]:
        with (folder / f"{name}.csv").open(newline="") as file:
            return list(csv.DictReader(file))

    targets = {(it["camera"], it["target_id"]): it["person"] for it in rows_of("identity")}
    truths = {(it["time"], it["person"]): it for it in rows_of("truth")}
    # The receiver `phone-3` is that of `person-3` or `vehicle-3`.
    fixes = {(it["time"], it["receiver_id"].rpartition("-")[2]): it for it in rows_of("fixes")}

    def row_of(camera: str, box: dict[str, str]) -> Row:
        target_id = targets[camera, box["target_id"]]
        truth, fix = truths[box["time"], target_id], fixes[box["time"], target_id.rpartition("-")[2]]
        place = {f"truth_{name}": truth[name] for name in ("longitude", "latitude")}
        return to_row(fix | place | box | {"target_id": target_id})

    def is_whole(row: Row) -> bool:
        return row.width_px / 2 < row.foot_px[0] < WIDTH_PX - row.width_px / 2

    return {
        camera: [row for box in rows_of(f"detections_{camera}") if is_whole(row := row_of(camera, box))]
        for camera in ("c1", "c2")
    }


def to_row(row: dict[str, str]) -> Row:
    """A row of the CSV file."""
    left, top, width, height = (float(row[name]) for name in ("left", "top", "width", "height"))
    return Row(
        time=datetime.fromisoformat(row["time"]),
        target_id=row["target_id"],
        foot_px=(left + width / 2, top + height),
        width_px=width,
        height_px=height,
        fix_deg=(float(row["longitude"]), float(row["latitude"])),
        truth_deg=(float(row["truth_longitude"]), float(row["truth_latitude"])),
    )


def write_gpx(rows: list[Row], path: Path, *, clock_offset_s: float = 0.0) -> None:
    """The fixes as a phone's GPX file, whose clock shows that much more than the camera's."""
    points = "".join(
        f'<trkpt lat="{row.fix_deg[1]}" lon="{row.fix_deg[0]}"><time>'
        f"{(row.time + timedelta(seconds=clock_offset_s)).astimezone(UTC).isoformat().replace('+00:00', 'Z')}"
        "</time></trkpt>"
        for row in rows
    )
    path.write_text(
        '<?xml version="1.0"?><gpx version="1.1" creator="phone" xmlns="http://www.topografix.com/GPX/1/1">'
        f"<trk><trkseg>{points}</trkseg></trk></gpx>"
    )


@dataclass(frozen=True)
class Pose:
    """Where a target stands in the image, how large it appears, and how far a walker's limbs are out, -1 to 1."""

    foot_px: tuple[float, float]
    width_px: float
    height_px: float
    swing: float


class Walker:
    """The looks and the way of one target."""

    def __init__(self, rows: list[Row], random: np.random.Generator) -> None:
        self.target_id = rows[0].target_id
        self._rows = {row.time: row for row in rows}
        self._is_vehicle = self.target_id.startswith("vehicle")
        self._phase = random.uniform(0, 2 * np.pi)
        self._colours = [tuple(int(c) for c in random.integers(20, 236, 3)) for _ in range(3)]

    def at(self, time: datetime) -> Pose | None:
        """Where and how the target is; None while it is out of view."""
        whole = time.replace(microsecond=0)
        first, second = self._rows.get(whole), self._rows.get(whole + timedelta(seconds=1))
        if first is None or second is None:
            return None
        share = (time - whole).total_seconds()
        (x, y), (next_x, next_y) = first.foot_px, second.foot_px
        is_walking = np.hypot(next_x - x, next_y - y) > STANDING_PX
        # 1.8 steps a second.
        swing = np.sin(self._phase + 2 * np.pi * 0.9 * (time.timestamp() % 3600.0)) if is_walking else 0.3
        width_px = first.width_px + share * (second.width_px - first.width_px)
        height_px = first.height_px + share * (second.height_px - first.height_px)
        return Pose((x + share * (next_x - x), y + share * (next_y - y)), width_px, height_px, float(swing))

    def silhouette(self, pose: Pose) -> tuple[Image, Mask, tuple[float, float]]:
        """Colours and coverage of a patch, and the foot's place in it, px."""
        height_px = pose.height_px
        # A vehicle that turns appears shorter.
        unit_px = pose.width_px / VEHICLE_WIDTH if self._is_vehicle else height_px
        height = int(np.ceil(height_px)) + 8
        width = int(np.ceil(pose.width_px if self._is_vehicle else height_px)) + 8
        foot = (width / 2, height - 4.0)
        colour = np.zeros((height, width, 3), np.uint8)
        mask = np.zeros((height, width), np.uint8)
        for part_colour, points, thickness in vehicle() if self._is_vehicle else limbs(pose.swing):
            pixels = np.array([[foot[0] + x * unit_px, foot[1] - y * height_px] for x, y in points]) * 16
            line_px = max(1, round(thickness * height_px))
            for canvas, value in ((colour, self._colours[part_colour]), (mask, (255,))):
                cv2.polylines(canvas, [np.round(pixels).astype(np.int32)], False, value, line_px, cv2.LINE_AA, 4)
        # Ends of lines are round and reach beyond the foot: cut there.
        mask[int(np.ceil(foot[1])) :] = 0
        return colour, (mask / 255).astype(np.float32), foot


def limbs(swing: float) -> Iterator[tuple[int, list[tuple[float, float]], float]]:
    """Colour number, points (right, up; in body heights) and thickness of the parts of a body."""
    for side in (-1.0, 1.0):
        yield 0, [(0.0, 0.5), (side * 0.06 * swing, 0.26), (side * 0.12 * swing, 0.03)], 0.075
        yield 2, [(0.0, 0.78), (-side * 0.08 * swing, 0.6), (-side * 0.13 * swing, 0.46)], 0.05
    yield 1, [(0.0, 0.8), (0.0, 0.52)], 0.17
    yield 2, [(0.0, 0.935), (0.0, 0.92)], 0.13


def vehicle() -> Iterator[tuple[int, list[tuple[float, float]], float]]:
    """The same of a car from its side: wheels, body, cabin."""
    for side in (-1.0, 1.0):
        yield 0, [(side * 0.75, 0.17), (side * 0.75, 0.16)], 0.33
    yield 1, [(-1.2, 0.42), (1.2, 0.42)], 0.4
    yield 2, [(-0.55, 0.8), (0.35, 0.8)], 0.36


def textured_ground(random: np.random.Generator) -> Image:
    """Ground with stains at several scales, joints of slabs, and a wall at the top."""
    ground = np.full((HEIGHT_PX, WIDTH_PX, 3), (118, 124, 128), np.float32)
    for cells, strength in ((12, 14.0), (60, 9.0), (320, 7.0)):
        # Mostly brightness, some colour.
        brightness = random.normal(0, strength, (cells * 9 // 16 + 1, cells, 1))
        stains = brightness + random.normal(0, 0.25 * strength, (*brightness.shape[:2], 3))
        ground += cv2.resize(stains.astype(np.float32), (WIDTH_PX, HEIGHT_PX), interpolation=cv2.INTER_CUBIC)
    horizon = 120
    for row in (1.0 / np.linspace(1 / 600, 1 / 12, 30)).astype(int):
        cv2.line(ground, (0, horizon + int(row)), (WIDTH_PX, horizon + int(row)), (96.0, 100.0, 102.0), 1)
    for column in range(-2000, 3400, 160):
        cv2.line(ground, (640, horizon), (column, HEIGHT_PX), (96.0, 100.0, 102.0), 1)
    ground[:horizon] = ground[:horizon] * 0.6 + np.array((60, 50, 40))
    return np.clip(ground, 0, 255).astype(np.uint8)


def paint(image: Image, walker: Walker, time: datetime) -> TrueBox | None:
    """Draws a walker and its shadow into an image."""
    pose = walker.at(time)
    if pose is None:
        return None
    foot_x, foot_y = pose.foot_px
    colour, mask, (patch_x, patch_y) = walker.silhouette(pose)
    cast_shadow(image, mask, (foot_x, foot_y), (patch_x, patch_y))
    left, top = round(foot_x - patch_x), round(foot_y - patch_y)
    rows = slice(max(top, 0), min(top + mask.shape[0], image.shape[0]))
    columns = slice(max(left, 0), min(left + mask.shape[1], image.shape[1]))
    if rows.start >= rows.stop or columns.start >= columns.stop:
        return None
    inside = (slice(rows.start - top, rows.stop - top), slice(columns.start - left, columns.stop - left))
    visible = mask[inside]
    below = image[rows, columns]
    image[rows, columns] = (below + visible[..., None] * (colour[inside].astype(np.float32) - below)).astype(np.uint8)
    covered_rows, covered_columns = np.nonzero(visible > 0.5)
    if covered_rows.size == 0:
        return None
    across, down = columns.start + covered_columns, rows.start + covered_rows
    sides_px = (float(across.min()), float(down.min()), float(across.max()) + 1, float(down.max()) + 1)
    return TrueBox(walker.target_id, sides_px)


def cast_shadow(image: Image, mask: Mask, foot: tuple[float, float], patch_foot: tuple[float, float]) -> None:
    """Darkens the ground where the silhouette, laid down and to the right, covers it."""
    height, width = mask.shape
    # Up in the patch becomes right and slightly up on the ground.
    shear, flatten = 0.7, 0.28
    shift = np.array(
        [[1, -shear, shear * patch_foot[1]], [0, flatten, (1 - flatten) * patch_foot[1]]], dtype=np.float32
    )
    shadow = cv2.GaussianBlur(cv2.warpAffine(mask, shift, (width + height, height)), (5, 5), 0)
    left, top = round(foot[0] - patch_foot[0]), round(foot[1] - patch_foot[1])
    columns = slice(max(left, 0), min(left + width + height, image.shape[1]))
    rows = slice(max(top, 0), min(top + height, image.shape[0]))
    if rows.start >= rows.stop or columns.start >= columns.stop:
        return
    part = shadow[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left]
    below = image[rows, columns]
    image[rows, columns] = (below * (1 - (1 - SHADOW_FACTOR) * part[..., None])).astype(np.uint8)


class Renderer:
    """Draws the frames of a scene."""

    def __init__(self, rows: list[Row], seed: int) -> None:
        random = np.random.default_rng(seed)
        self._random = random
        self._ground = textured_ground(random)
        names = sorted({row.target_id for row in rows})
        self._walkers = [Walker([row for row in rows if row.target_id == name], random) for name in names]
        noise = random.normal(0, NOISE_SIGMA, (HEIGHT_PX, 2 * WIDTH_PX, 3))
        self._noise = noise.round().astype(np.int16)

    def frame(self, time: datetime) -> tuple[Image, list[TrueBox]]:
        """The image at an instant, and the walkers in it, the farthest first."""
        image = self._ground.copy()
        placed = [(pose.foot_px[1], it) for it in self._walkers if (pose := it.at(time)) is not None]
        boxes = [paint(image, walker, time) for _, walker in sorted(placed, key=lambda pair: pair[0])]
        first = int(self._random.integers(WIDTH_PX))
        gain = 1 + 0.01 * np.sin(time.timestamp() % 3600 / 11)
        bright = cv2.convertScaleAbs(image, alpha=gain)
        noisy = cv2.add(bright, self._noise[:, first : first + WIDTH_PX], dtype=cv2.CV_8U)
        return np.asarray(noisy, np.uint8), [box for box in boxes if box is not None]


class VideoFile:
    """An H.264 file that is being written. Times of frames are whole milliseconds."""

    def __init__(self, path: Path, size_px: tuple[int, int] = (WIDTH_PX, HEIGHT_PX)) -> None:
        self._container = av.open(str(path), "w")
        stream: Any = self._container.add_stream("libx264", rate=Fraction(1000))
        stream.width, stream.height = size_px
        stream.pix_fmt = "yuv420p"
        stream.codec_context.time_base = Fraction(1, 1000)
        stream.options = {"preset": "ultrafast", "crf": "23", "threads": "1", "g": "50"}
        self._stream = stream

    def write(self, image: Image, since_start: timedelta) -> None:
        """Appends a frame."""
        frame = av.VideoFrame.from_ndarray(image, format="bgr24")
        frame.pts = round(since_start.total_seconds() * 1000)
        frame.time_base = Fraction(1, 1000)
        for packet in self._stream.encode(frame):
            self._container.mux(packet)

    def close(self) -> None:
        """Writes what is left."""
        for packet in self._stream.encode():
            self._container.mux(packet)
        self._container.close()


def render(rows: list[Row], path: Path, *, seed: int, frames_per_s: int = 10, lead_in_s: int = 3) -> Video:
    """Writes a video of the rows. It begins with an empty view, of which there is only one frame a second."""
    start = min(row.time for row in rows) - timedelta(seconds=lead_in_s)
    end = max(row.time for row in rows)
    seconds = {row.time for row in rows}
    video, file, renderer = Video(path, start), VideoFile(path), Renderer(rows, seed)
    for number in range(int((end - start).total_seconds() * frames_per_s)):
        time = start + timedelta(seconds=number / frames_per_s)
        if time.replace(microsecond=0) not in seconds and number % frames_per_s and number > lead_in_s * frames_per_s:
            continue
        image, boxes = renderer.frame(time)
        file.write(image, time - start)
        video.times.append(time)
        video.boxes.append(boxes)
    file.close()
    return video
