"""Frames of video files, cameras and pictures, with the instants of their exposure."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import PurePosixPath
from typing import Any
from urllib.parse import urlsplit

import av
import cv2
import httpx
import numpy as np

from sightfix._request import RetryPolicy
from sightfix.edge.values import Frame

LOG = logging.getLogger(__name__)

Sleep = Callable[[float], bool | None]
"""Waits for a number of seconds; returns True if there is nothing more to wait for."""
SOURCE_RETRY = RetryPolicy(attempts=2**31, initial_delay_s=0.5, max_delay_s=30.0)
PICTURE_ENDINGS = (".jpg", ".jpeg", ".png")
LARGEST_PICTURE_BYTES = 32 * 2**20
LARGEST_CLOCK_DIFFERENCE_S = 10.0
"""A sender's clock that is farther from this machine's is wrong; a clock that goes back by more was set."""
EPOCH = datetime.fromtimestamp(0, UTC)
EARLIEST_FRAME_SHARE = 0.9
"""Frames that come up to a tenth of the interval early are taken."""


class SourceError(Exception):
    """The source cannot be used as it was given."""


@dataclass(frozen=True, kw_only=True)
class SourceOptions:
    """Where frames come from, and how their times are known."""

    address: str
    """rtsp://, http:// of a picture (.jpg, .png) or a stream, /dev/video*, or a file."""
    start: datetime | None = None
    """Instant of a file's first frame; by default what the file says of its creation."""
    delay_s: float = 0.0
    """From exposure to arrival, of a source that does not tell the time itself."""
    max_frames_per_s: float = 10.0
    timeout_s: float = 10.0
    """Longest silence of the source."""
    decoding_threads: int = 1
    retry: RetryPolicy = field(default=SOURCE_RETRY)

    @property
    def shown(self) -> str:
        """The address without user and password."""
        parts = urlsplit(self.address)
        return parts._replace(netloc=parts.netloc.rpartition("@")[2]).geturl()

    @property
    def is_live(self) -> bool:
        """True if frames come in real time, from a source that may come back after it has ended."""
        return self.address.startswith("/dev/") or "://" in self.address

    @property
    def is_picture(self) -> bool:
        """True if the address is that of a picture, which is requested again and again."""
        parts = urlsplit(self.address)
        return parts.scheme in ("http", "https") and PurePosixPath(parts.path).suffix.lower() in PICTURE_ENDINGS


def frames(options: SourceOptions, clock: Callable[[], datetime], sleep: Sleep) -> Iterator[Frame]:
    """The frames of a source at most `max_frames_per_s`, as `thinned`. A live source is opened again for ever.

    Raises:
        SourceError: A file cannot be read, or says nothing of its time.
    """

    def opened() -> Iterator[Frame]:
        return picture_frames(options, clock, sleep) if options.is_picture else video_frames(options, clock)

    if options.is_live:
        return thinned(reopened(opened, options.retry, sleep), options.max_frames_per_s)
    return thinned(opened(), options.max_frames_per_s)


def reopened(opened: Callable[[], Iterator[Frame]], retry: RetryPolicy, sleep: Sleep) -> Iterator[Frame]:
    """The frames of a source that is opened again whenever it ends, with back-off."""
    failures = 0
    while True:
        reason = "it has ended"
        try:
            for frame in opened():
                failures = 0
                yield frame
        except (SourceError, httpx.HTTPError) as error:
            reason = str(error)
        failures += 1
        delay_s = retry.delay_s(failures)
        LOG.warning("the source gives no frames (%s); trying again in %.1f s", reason, delay_s)
        if sleep(delay_s):
            return


def thinned(frames: Iterable[Frame], max_frames_per_s: float) -> Iterator[Frame]:
    """Frames with increasing times, with a limit per second; times go back only after a clock that was set."""
    interval_s = EARLIEST_FRAME_SHARE / max_frames_per_s
    latest: datetime | None = None
    for frame in frames:
        step_s = interval_s if latest is None else (frame.time - latest).total_seconds()
        if step_s < -LARGEST_CLOCK_DIFFERENCE_S:
            LOG.warning("the clock was set back: times of frames go on %.0f s earlier", -step_s)
        elif step_s < interval_s:
            continue
        latest = frame.time
        yield frame


def video_frames(options: SourceOptions, clock: Callable[[], datetime]) -> Iterator[Frame]:
    """The frames of a stream, a device or a file, until it ends.

    Raises:
        SourceError: It cannot be read.
    """
    try:
        with av.open(
            options.address,
            format="v4l2" if options.address.startswith("/dev/") else None,
            options={"rtsp_transport": "tcp"} if options.address.startswith("rtsp") else {},
            timeout=options.timeout_s if options.is_live else None,
        ) as container:
            if not container.streams.video:
                raise SourceError(f"{options.shown} has no video")
            stream = container.streams.video[0]
            stream.codec_context.thread_count = options.decoding_threads
            times = FrameTimes(options, clock, container, stream)
            for packet in container.demux(stream):
                times.note(packet)
                for frame in packet.decode():
                    yield Frame(np.asarray(frame.to_ndarray(format="bgr24"), np.uint8), times.of(frame))
    except (av.FFmpegError, OSError) as error:
        raise SourceError(f"{options.shown}: {error.strerror}") from error


class FrameTimes:
    """When the frames of a stream were exposed.

    A file has the time of its beginning. RTSP has the sender's clock from its first RTCP sender report on, which FFmpeg
    hands on with each packet (producer reference time), unless that clock is wrong. Everything else has the arrival
    less the stated delay.
    """

    def __init__(self, options: SourceOptions, clock: Callable[[], datetime], container: Any, stream: Any) -> None:
        self._options = options
        self._clock = clock
        self._time_base = stream.time_base
        self._zero: datetime | None = None
        """The instant at which presentation times begin, if it is known."""
        self._is_believed: bool | None = None
        """True if the latest report of the sender was believed; None before the first."""
        if not options.is_live:
            start = options.start or creation_time(container)
            if start is None:
                raise SourceError(f"{options.shown} does not say when it was recorded; give --start")
            self._zero = start - self._since_zero(stream.start_time or 0)

    def _since_zero(self, pts: int) -> timedelta:
        return timedelta(seconds=float(pts * self._time_base))

    def note(self, packet: Any) -> None:
        """Reads the sender's clock from a packet, if it tells it."""
        if not self._options.is_live or packet.pts is None or not packet.has_sidedata("prft"):
            return
        reference = bytes(packet.get_sidedata("prft"))
        wall_clock_us = int.from_bytes(reference[:8], "little", signed=True)
        time = EPOCH + timedelta(microseconds=wall_clock_us)
        difference_s = (time - self._clock()).total_seconds()
        is_believed = abs(difference_s) <= LARGEST_CLOCK_DIFFERENCE_S
        self._zero = time - self._since_zero(packet.pts) if is_believed else None
        if is_believed != self._is_believed:
            self._is_believed = is_believed
            if is_believed:
                LOG.info("times of frames are the sender's, by its RTCP reports")
            else:
                LOG.warning("the sender's clock is %+.0f s from this one's and is not used: set it", difference_s)

    def of(self, frame: Any) -> datetime:
        """The instant of a decoded frame."""
        if self._zero is not None and frame.pts is not None:
            return self._zero + self._since_zero(frame.pts)
        return self._clock() - timedelta(seconds=self._options.delay_s)


def creation_time(container: Any) -> datetime | None:
    """The time of creation that a file states, if it has an offset."""
    text = container.metadata.get("creation_time")
    try:
        time = datetime.fromisoformat(text) if text else None
    except ValueError:
        return None
    return time if time is not None and time.tzinfo is not None else None


def picture_frames(options: SourceOptions, clock: Callable[[], datetime], sleep: Sleep) -> Iterator[Frame]:
    """Pictures that are requested one after the other.

    Raises:
        SourceError: What comes is no picture, or is too large.
        httpx.HTTPError: No picture comes.
    """
    interval_s = 1 / options.max_frames_per_s
    with httpx.Client(timeout=options.timeout_s, follow_redirects=True) as client:
        while True:
            requested = clock()
            content = read_at_most(client, options, LARGEST_PICTURE_BYTES)
            arrived = clock()
            image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
            if image is None:
                raise SourceError(f"{options.shown} is no picture")
            yield Frame(np.asarray(image, np.uint8), arrived - timedelta(seconds=options.delay_s))
            remaining_s = interval_s - (clock() - requested).total_seconds()
            # The clock may have been set meanwhile, in either direction.
            sleep(min(max(0.0, remaining_s), interval_s))


def read_at_most(client: httpx.Client, options: SourceOptions, limit_bytes: int) -> bytes:
    """The body at the source's address.

    Raises:
        SourceError: It is larger.
    """
    parts: list[bytes] = []
    with client.stream("GET", options.address) as response:
        if not response.is_success:
            raise SourceError(f"{options.shown}: HTTP {response.status_code}")
        for part in response.iter_bytes():
            parts.append(part)
            if sum(map(len, parts)) > limit_bytes:
                raise SourceError(f"{options.shown} is larger than {limit_bytes} bytes")
    return b"".join(parts)
