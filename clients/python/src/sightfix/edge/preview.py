"""A local page that shows the video with its boxes."""

from __future__ import annotations

import logging
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import cv2
import numpy as np

from sightfix.edge.values import Frame, Image, TrackedBox

LOG = logging.getLogger(__name__)

VIEWERS = 4
WIDTH_PX = 1280
QUALITY = 75
SILENCE_S = 30.0
HOSTS = ("127.0.0.1", "localhost")
BOUNDARY = "frame"
PAGE = b"""<!doctype html><html lang="en"><meta charset="utf-8"><title>sightfix-edge</title>
<style>body{margin:0;background:#111}img{display:block;max-width:100%;max-height:100vh;margin:auto}</style>
<img src="/video" alt="The video with its boxes"></html>"""


class Preview:
    """Serves `/` and `/video` (JPEG images, multipart) on 127.0.0.1. Frames are drawn only while somebody looks."""

    def __init__(self, port: int) -> None:
        self._changed = threading.Condition()
        self._jpeg = b""
        self._number = 0
        self._viewers = threading.BoundedSemaphore(VIEWERS)
        self._watching = 0
        self._server = PreviewServer(("127.0.0.1", port), self)
        self.address = f"http://127.0.0.1:{self._server.server_port}/"
        threading.Thread(target=self._server.serve_forever, name="preview", daemon=True).start()
        LOG.info("the preview is at %s", self.address)

    def take(self, frame: Frame, boxes: list[TrackedBox]) -> None:
        """Shows a frame."""
        if not self._watching:
            return
        _, encoded = cv2.imencode(".jpg", drawn(frame.image, boxes), [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
        with self._changed:
            self._jpeg, self._number = encoded.tobytes(), self._number + 1
            self._changed.notify_all()

    def close(self) -> None:
        """Ends the page."""
        self._server.shutdown()
        self._server.server_close()

    def enter(self) -> bool:
        """Admits a viewer, if there are not too many."""
        if not self._viewers.acquire(blocking=False):
            return False
        with self._changed:
            self._watching += 1
        return True

    def leave(self) -> None:
        """A viewer has left."""
        with self._changed:
            self._watching -= 1
        self._viewers.release()

    def next_jpeg(self, after: int) -> tuple[int, bytes]:
        """The latest drawn frame with its number, once it is later than a number."""
        with self._changed:
            self._changed.wait_for(lambda: self._number > after, timeout=SILENCE_S)
            return self._number, self._jpeg


class PreviewServer(ThreadingHTTPServer):
    """The server of one preview."""

    daemon_threads = True

    def __init__(self, address: tuple[str, int], preview: Preview) -> None:
        super().__init__(address, PreviewHandler)
        self.preview = preview


class PreviewHandler(BaseHTTPRequestHandler):
    """Answers a request of a browser."""

    server: PreviewServer
    timeout = SILENCE_S

    def do_GET(self) -> None:
        """The page, or the video."""
        if self.headers.get("host", "").partition(":")[0] not in HOSTS:
            # A page of another origin whose name was made to resolve to this address.
            self.send_error(403)
        elif self.path == "/":
            self._reply("text/html; charset=utf-8", PAGE)
        elif self.path == "/video":
            self._video()
        else:
            self.send_error(404)

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002, the name of the base class
        """Requests are not logged."""

    def _reply(self, kind: str, body: bytes) -> None:
        self.send_response(200)
        self.send_header("content-type", kind)
        self.send_header("content-length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def _video(self) -> None:
        preview = self.server.preview
        if not preview.enter():
            self.send_error(503, "too many viewers")
            return
        try:
            self.send_response(200)
            self.send_header("content-type", f"multipart/x-mixed-replace; boundary={BOUNDARY}")
            self.end_headers()
            number = 0
            while True:
                latest, jpeg = preview.next_jpeg(number)
                if latest == number:
                    return
                number = latest
                head = f"--{BOUNDARY}\r\ncontent-type: image/jpeg\r\ncontent-length: {len(jpeg)}\r\n\r\n"
                self.wfile.write(head.encode() + jpeg + b"\r\n")
        except OSError:
            return  # the viewer has left
        finally:
            preview.leave()


def drawn(image: Image, boxes: list[TrackedBox]) -> Image:
    """The image with boxes and their ids, at most `WIDTH_PX` wide."""
    scale = min(1.0, WIDTH_PX / image.shape[1])
    shown = image.copy() if scale == 1.0 else cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    for it in boxes:
        box = it.box
        left, top, right, bottom = (
            round(scale * side) for side in (box.left_px, box.top_px, box.right_px, box.bottom_px)
        )
        cv2.rectangle(shown, (left, top), (right, bottom), (40, 220, 40), 2)
        text = f"{it.tracker_id} {box.class_}"
        cv2.putText(shown, text, (left, max(top - 5, 12)), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (40, 220, 40), 1, cv2.LINE_AA)
    return np.asarray(shown, np.uint8)
