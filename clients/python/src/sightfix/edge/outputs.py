"""The outputs of the boxes: they are streamed to a server, recorded, and drawn for a preview."""

from __future__ import annotations

import csv
import logging
import threading
import time as clocks
from datetime import datetime
from pathlib import Path
from types import TracebackType
from typing import Protocol, Self

import cv2
import numpy as np

from sightfix import (
    BoundingBox,
    Client,
    ConnectionFailedError,
    ImageSize,
    LiveItem,
    NotFoundError,
    RetryPolicy,
    SightfixError,
    UnavailableError,
)
from sightfix._sync.stream import Stream
from sightfix.edge.values import Box, Frame, Image, TrackedBox

LOG = logging.getLogger(__name__)

SERVER_RETRY = RetryPolicy(attempts=2**31, initial_delay_s=0.5, max_delay_s=30.0)
BUFFERED_BOXES = 4096
LONGEST_SILENCE_S = 10.0
"""Longest silence of the server at the end of a stream; then its answers are no longer waited for."""
LARGEST_STILL_BYTES = 2 * 2**20
STILL_QUALITIES = (90, 75, 50, 25)


class Output(Protocol):
    """Takes the boxes of one frame after the other."""

    def take(self, frame: Frame, boxes: list[TrackedBox]) -> None:
        """Takes the boxes of a frame."""

    def close(self) -> None:
        """Ends what `take` has begun."""


def live_item(box: TrackedBox, frame: Frame) -> LiveItem:
    """A box as an item of a live stream."""
    return LiveItem(
        time=frame.time,
        tracker_id=box.tracker_id,
        bounding_box=bounding_box(box.box),
        class_=box.box.class_,
        score=box.box.score,
    )


def bounding_box(box: Box) -> BoundingBox:
    """A box as the interface of the server has it."""
    return BoundingBox(left_px=box.left_px, top_px=box.top_px, width_px=box.width_px, height_px=box.height_px)


def wait_for_server(client: Client, stopped: threading.Event) -> None:
    """Waits until the server can be reached, or until the event."""
    failures = 0
    while not stopped.is_set():
        try:
            client.server()
        except (ConnectionFailedError, UnavailableError) as error:
            failures += 1
            delay_s = SERVER_RETRY.delay_s(failures)
            LOG.warning("the server cannot be reached (%s); trying again in %.1f s", error, delay_s)
            stopped.wait(delay_s)
        else:
            return


def ensure_camera(client: Client, camera_id: str, image: Image, *, create: bool) -> None:
    """Checks that the server has the camera with the size of this image; creates it if that is wanted.

    Raises:
        SightfixError: It does not exist, and is not to be created; or the server refuses.
    """
    size = ImageSize(width_px=image.shape[1], height_px=image.shape[0])
    try:
        stored = client.cameras.get(camera_id).image_size
    except NotFoundError as error:
        if not create:
            raise SightfixError(f"the server has no camera {camera_id}: give --create, or create it there") from error
        client.cameras.create(id=camera_id, image_size=size)
        LOG.info("created the camera %s of %d x %d px", camera_id, size.width_px, size.height_px)
        return
    if stored is not None and stored != size:
        LOG.warning(
            "the camera %s is stored with %d x %d px, the source has %d x %d px: positions will be wrong",
            camera_id, stored.width_px, stored.height_px, size.width_px, size.height_px,
        )  # fmt: skip


class Delivery:
    """Streams boxes to a server and reads the answers, over restarts of the server.

    While the server is away boxes are buffered. When the buffer is full `take` waits, and so frames are dropped.
    """

    def __init__(self, client: Client, camera_id: str, *, store_samples: bool = False) -> None:
        self._stream: Stream = client.stream(
            camera_id, store_samples=store_samples, buffer_items=BUFFERED_BOXES, retry=SERVER_RETRY
        )
        self._stream.__enter__()
        self.sent = 0
        """Boxes so far."""
        self.answered = 0
        self.refused: dict[str, int] = {}
        """Boxes that the server refused, by reason."""
        self._noted_reconnects = 0
        self._reader = threading.Thread(target=self._read_answers, name="answers", daemon=True)
        self._reader.start()

    def take(self, frame: Frame, boxes: list[TrackedBox]) -> None:
        """Sends the boxes of a frame.

        Raises:
            ProblemError: The server refuses the stream.
        """
        for box in boxes:
            self._stream.send(live_item(box, frame))
            self.sent += 1
        if self.reconnects > self._noted_reconnects:
            self._noted_reconnects = self.reconnects
            LOG.warning("the stream to the server broke; boxes are kept and sent again")

    def close(self) -> None:
        """Waits until all boxes are answered, as long as answers come.

        Raises:
            ProblemError: The server refuses the stream.
        """
        self._stream.finish()
        answered = -1
        while self._reader.is_alive() and answered < self.answered:
            answered = self.answered
            self._reader.join(timeout=LONGEST_SILENCE_S)
        if self._reader.is_alive():
            LOG.warning("%d boxes are not answered; the server may not have them", self.sent - self.answered)
            self._stream.abort()
        else:
            self._stream.close()

    @property
    def reconnects(self) -> int:
        """How often the stream was opened again."""
        return self._stream.reconnects

    def _read_answers(self) -> None:
        try:
            for answer in self._stream:
                self.answered += 1
                if answer.HasField("error"):
                    self._note(answer.error.reason, answer.error.message)
        except SightfixError as error:
            LOG.debug("the stream has ended: %s", error)  # `take` or `close` raises it

    def _note(self, reason: str, message: str) -> None:
        if reason not in self.refused:
            LOG.warning("the server refuses boxes: %s", message)
        self.refused[reason] = self.refused.get(reason, 0) + 1


class Recorder:
    """Writes boxes to a CSV file that `sightfix pair` and `samples/pairings` read."""

    COLUMNS = ("time", "target_id", "left", "top", "width", "height", "class", "score")

    def __init__(self, path: Path) -> None:
        self._file = path.open("w", newline="")
        self._writer = csv.writer(self._file)
        self._writer.writerow(self.COLUMNS)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def take(self, frame: Frame, boxes: list[TrackedBox]) -> None:
        """Appends the boxes of a frame."""
        for box in boxes:
            self.write(frame.time, box)
        self._file.flush()

    def write(self, time: datetime, box: TrackedBox) -> None:
        """Appends a box."""
        it = box.box
        sides = (round(side, 2) for side in (it.left_px, it.top_px, it.width_px, it.height_px))
        self._writer.writerow((time.isoformat(), box.tracker_id, *sides, it.class_, round(it.score, 4)))

    def close(self) -> None:
        """Writes what is left."""
        self._file.close()


class Stills:
    """Sends a picture of the view to the server now and then."""

    def __init__(self, client: Client, camera_id: str, interval_s: float) -> None:
        self._client = client
        self._camera_id = camera_id
        self._interval_s = interval_s
        self._next_s = 0.0
        self._thread: threading.Thread | None = None

    def take(self, frame: Frame, boxes: list[TrackedBox]) -> None:
        """Sends the frame if it is time for one; does not wait for the server."""
        now_s = clocks.monotonic()
        is_sending = self._thread is not None and self._thread.is_alive()
        if is_sending or now_s < self._next_s:
            return
        self._next_s = now_s + self._interval_s
        self._thread = threading.Thread(target=self._send, args=(frame.image,), name="still", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Waits for a picture that is on its way."""
        if self._thread is not None:
            self._thread.join(timeout=5)

    def _send(self, image: Image) -> None:
        try:
            self._client.cameras.set_picture(self._camera_id, jpeg_within(image, LARGEST_STILL_BYTES))
        except SightfixError as error:
            LOG.warning("a picture could not be sent: %s", error)


def jpeg_within(image: Image, limit_bytes: int) -> bytes:
    """The image as JPEG of at most that size: of less quality, then of half the sides."""
    while True:
        for quality in STILL_QUALITIES:
            _, encoded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
            if encoded.size <= limit_bytes:
                return encoded.tobytes()
        image = np.asarray(cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.uint8)
