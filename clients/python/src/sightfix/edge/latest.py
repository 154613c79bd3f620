"""Hands on the latest frame of a live source, and drops those that come while the one before is being processed."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator

from sightfix.edge.values import Frame

LOG = logging.getLogger(__name__)

REPORT_FRAMES = 500
"""Dropped frames are reported once in this number of frames."""


class LatestFrames:
    """Reads a source on a thread of its own; iteration gives the latest frame that was not given before."""

    def __init__(self, source: Iterator[Frame]) -> None:
        self._source = source
        self._changed = threading.Condition()
        self._latest: Frame | None = None
        self._error: Exception | None = None
        self._has_ended = False
        self.read = 0
        """Frames of the source so far."""
        self.dropped = 0
        """Those of them that were replaced by a later one before they could be given."""
        threading.Thread(target=self._run, name="frames", daemon=True).start()

    def __iter__(self) -> Iterator[Frame]:
        return self

    def __next__(self) -> Frame:
        with self._changed:
            self._changed.wait_for(lambda: self._latest is not None or self._has_ended)
            frame, self._latest = self._latest, None
            if frame is not None:
                return frame
            if self._error is not None:
                raise self._error
        raise StopIteration

    def close(self) -> None:
        """Ends the iteration."""
        with self._changed:
            self._has_ended = True
            self._latest = None
            self._changed.notify_all()

    def _run(self) -> None:
        reported = 0
        try:
            for frame in self._source:
                with self._changed:
                    if self._has_ended:
                        return
                    self.read += 1
                    self.dropped += self._latest is not None
                    self._latest = frame
                    self._changed.notify_all()
                if self.read % REPORT_FRAMES == 0 and self.dropped > reported:
                    LOG.warning("dropped %d of the last %d frames", self.dropped - reported, REPORT_FRAMES)
                    reported = self.dropped
        except Exception as error:
            self._error = error
        finally:
            with self._changed:
                self._has_ended = True
                self._changed.notify_all()
