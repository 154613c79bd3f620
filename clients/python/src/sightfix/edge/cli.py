"""The command `sightfix-edge`."""

from __future__ import annotations

import argparse
import logging
import os
import secrets
import signal
import sys
import threading
import time as clocks
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from datetime import UTC, datetime
from itertools import chain
from pathlib import Path
from types import FrameType
from typing import TypeVar

import cv2

from sightfix import Client, SightfixError
from sightfix._settings import DEFAULT_SERVER
from sightfix.edge.fixes import FixesError, read_track
from sightfix.edge.latest import LatestFrames
from sightfix.edge.layouts import LAYOUTS
from sightfix.edge.learn import Collector, LearnError, learn
from sightfix.edge.motion import MotionDetector, MotionOptions
from sightfix.edge.onnx_detector import ModelError, ModelOptions, OnnxDetector
from sightfix.edge.outputs import Delivery, Output, Recorder, Stills, ensure_camera, wait_for_server
from sightfix.edge.pipeline import Pipeline
from sightfix.edge.preview import Preview
from sightfix.edge.sources import SourceError, SourceOptions, frames
from sightfix.edge.tracking import Tracker
from sightfix.edge.values import Detector, Frame

LOG = logging.getLogger("sightfix.edge")

AnyOutput = TypeVar("AnyOutput", bound=Output)

SOURCE_VARIABLE = "SIGHTFIX_EDGE_SOURCE"


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit status: 0, 1 after a failure, 2 for wrong arguments."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    is_learning = given[:1] == ["learn"]
    parser = learning_parser() if is_learning else running_parser()
    options = parser.parse_args(given[1:] if is_learning else given)
    logging.basicConfig(level=logging.WARNING, format="%(asctime)s %(levelname)s %(message)s")
    logging.getLogger("sightfix").setLevel(logging.INFO)
    cv2.setNumThreads(options.threads)
    try:
        return run_learn(options) if is_learning else run(options, parser)
    except (SightfixError, SourceError, ModelError, FixesError, LearnError, OSError) as error:
        LOG.error("%s", error)
        return 1


def running_parser() -> argparse.ArgumentParser:
    """Arguments of `sightfix-edge`."""
    parser = argparse.ArgumentParser(
        prog="sightfix-edge",
        description="Turns a video address into boxes with tracker ids and streams them to a sightfix server.",
        epilog="sightfix-edge learn --help: train a camera from a video and a GPX file.",
    )
    parser.add_argument(
        "--source",
        default=os.environ.get(SOURCE_VARIABLE),
        required=SOURCE_VARIABLE not in os.environ,
        help="rtsp://, http:// of a picture (.jpg, .png) or a stream, /dev/video0, or a file "
        f"(default: {SOURCE_VARIABLE}, which hides a password from the list of processes)",
    )
    parser.add_argument("--camera", help="id of the camera on the server; needed to stream")
    parser.add_argument("--create", action="store_true", help="create the camera if the server has none of that id")
    parser.add_argument("--store-samples", action="store_true", help="have boxes and fixes stored for training")
    parser.add_argument(
        "--delay-s", type=float, default=0.0, help="from exposure to arrival, where the source sends no times"
    )
    parser.add_argument("--timeout-s", type=positive, default=10.0, help="longest silence of the source")
    parser.add_argument("--still-interval-s", type=float, default=600.0, help="between stills for the server; 0: none")
    parser.add_argument("--preview", type=int, metavar="PORT", help="show the boxes on http://127.0.0.1:PORT/")
    parser.add_argument("--record", type=Path, metavar="FILE", help="write the boxes to a CSV file")
    parser.add_argument(
        "--benchmark", type=int, metavar="FRAMES", help="measure this number of frames by stage; nothing is sent"
    )
    add_common(parser)
    return parser


def learning_parser() -> argparse.ArgumentParser:
    """Arguments of `sightfix-edge learn`."""
    parser = argparse.ArgumentParser(
        prog="sightfix-edge learn", description="Trains a camera from a video and the GPX file of who walks in it."
    )
    parser.add_argument("--video", dest="source", required=True, help="file")
    parser.add_argument(
        "--fixes", type=Path, required=True, help="GPX file of the walker's receiver, or CSV file of the page /walk"
    )
    parser.add_argument("--camera", required=True, help="id of the camera; it is created if there is none")
    parser.add_argument("--clock-window-s", type=positive, default=120.0, help="the clocks differ by at most this")
    parser.add_argument("--record", type=Path, metavar="FILE", help="write the boxes to a CSV file")
    add_common(parser)
    return parser


def add_common(parser: argparse.ArgumentParser) -> None:
    """Arguments of both commands."""
    parser.add_argument("--server", default=DEFAULT_SERVER, help="address of the server (default: %(default)s)")
    parser.add_argument("--ca-file", type=Path, help="authority of the server's certificate (PEM)")
    parser.add_argument("--start", type=instant, help="RFC 3339 time of a file's first frame (default: what it says)")
    parser.add_argument("--max-fps", type=positive, help="frames per second at most (default: 10; 1 of pictures)")
    parser.add_argument("--threads", type=int, default=1, help="threads per stage (default: 1)")
    parser.add_argument(
        "--detector", default="motion", help="motion (default; needs no weights), or the file of an ONNX model"
    )
    parser.add_argument("--class", dest="class_", default="person", help="class of what moves, with --detector motion")
    parser.add_argument("--layout", choices=sorted(LAYOUTS), help="of the model (default: recognised)")
    parser.add_argument("--input-size", type=size, default=(640, 640), help="WIDTHxHEIGHT, if the model leaves it open")
    parser.add_argument("--classes", type=Path, help="names of the model's classes, one per line")
    parser.add_argument("--only", default="", help="classes that are wanted, separated by commas (default: all)")
    parser.add_argument("--min-score", type=float, default=0.4, help="least score of a box (default: 0.4)")


def positive(text: str) -> float:
    """A number above 0."""
    value = float(text)
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError("must be above 0")
    return value


def instant(text: str) -> datetime:
    """A time with a UTC offset."""
    time = datetime.fromisoformat(text)
    if time.tzinfo is None:
        raise argparse.ArgumentTypeError("needs a UTC offset, such as 2026-05-01T12:00:00Z")
    return time


def size(text: str) -> tuple[int, int]:
    """Width and height."""
    width, _, height = text.partition("x")
    return int(width), int(height)


def detector_of(options: argparse.Namespace) -> Detector:
    """The detector that was asked for."""
    if options.detector == "motion":
        return MotionDetector(MotionOptions(class_=options.class_))
    wanted = frozenset(name.strip() for name in options.only.split(",") if name.strip())
    detector = OnnxDetector(
        Path(options.detector),
        ModelOptions(
            layout=options.layout,
            input_size_px=options.input_size,
            class_names=options.classes,
            only_classes=wanted,
            min_score=options.min_score,
            threads=options.threads,
        ),
    )
    LOG.info("the model's layout is %s", detector.layout_name)
    return detector


def source_of(options: argparse.Namespace) -> SourceOptions:
    """The source that was asked for."""
    source = SourceOptions(address=options.source, start=options.start, decoding_threads=options.threads)
    if options.max_fps is not None:
        source = replace(source, max_frames_per_s=options.max_fps)
    elif source.is_picture:
        source = replace(source, max_frames_per_s=1.0)
    return replace(source, delay_s=options.delay_s, timeout_s=options.timeout_s) if source.is_live else source


def now() -> datetime:
    """The time of this machine."""
    return datetime.now(UTC)


def new_prefix() -> str:
    """Begins the ids of a tracker: those of another one are of other targets."""
    return f"{secrets.token_hex(3)}-"


def run(options: argparse.Namespace, parser: argparse.ArgumentParser) -> int:
    """Streams, records or shows the boxes of a source."""
    if options.benchmark:
        return run_benchmark(options)
    if options.camera is None and options.record is None and options.preview is None:
        parser.error("nothing to do: give --camera, --record, --preview or --benchmark")
    source, stopped = source_of(options), threading.Event()
    detector = detector_of(options)
    read = frames(source, now, stopped.wait)
    latest = LatestFrames(read) if source.is_live else None
    stop_on_signals(stopped, latest)
    remaining: Iterator[Frame] = until(stopped, latest if latest is not None else read)
    first = next(remaining, None)
    if first is None:
        return 0 if stopped.is_set() else 1
    with ExitStack() as stack:
        outputs = list(outputs_of(options, first, stopped, stack))
        pipeline = Pipeline(detector, Tracker(new_prefix), outputs)
        pipeline.run(chain([first], remaining))
    summarise(pipeline, outputs, latest)
    return 0


def stop_on_signals(stopped: threading.Event, latest: LatestFrames | None) -> None:
    """Ends the frames on SIGTERM and SIGINT, so that everything that was begun is ended in order."""

    def stop(number: int, frame: FrameType | None) -> None:
        stopped.set()
        if latest is not None:
            # Not here: the lock may be held by the code that the signal has interrupted.
            threading.Thread(target=latest.close, daemon=True).start()

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, stop)


def until(stopped: threading.Event, frames: Iterable[Frame]) -> Iterator[Frame]:
    """The frames that come before an event."""
    for frame in frames:
        if stopped.is_set():
            return
        yield frame


def outputs_of(
    options: argparse.Namespace, first: Frame, stopped: threading.Event, stack: ExitStack
) -> Iterator[Output]:
    """The requested outputs; the stack closes them. There is no stream if the event comes before the server answers."""
    if options.record is not None:
        yield closing(stack, Recorder(options.record))
    if options.preview is not None:
        yield closing(stack, Preview(options.preview))
    if options.camera is None:
        return
    client = stack.enter_context(Client(options.server, ca_file=options.ca_file))
    wait_for_server(client, stopped)
    if stopped.is_set():
        return
    LOG.info("streaming to %s as camera %s", options.server, options.camera)
    ensure_camera(client, options.camera, first.image, create=options.create)
    if options.still_interval_s > 0:
        yield closing(stack, Stills(client, options.camera, options.still_interval_s))
    yield closing(stack, Delivery(client, options.camera, store_samples=options.store_samples))


def closing(stack: ExitStack, output: AnyOutput) -> AnyOutput:
    """The output, which the stack closes."""
    stack.callback(output.close)
    return output


def summarise(pipeline: Pipeline, outputs: Sequence[Output], latest: LatestFrames | None) -> None:
    """Says what was done."""
    dropped = 0 if latest is None else latest.dropped
    LOG.info("%d frames, %d dropped, %d boxes", pipeline.frames, dropped, pipeline.boxes)
    for output in outputs:
        if isinstance(output, Delivery):
            refused = sum(output.refused.values())
            LOG.info(
                "%d boxes sent, %d answered, %d of them refused, %d reconnects",
                output.sent, output.answered, refused, output.reconnects,
            )  # fmt: skip


def run_benchmark(options: argparse.Namespace) -> int:
    """Prints what each stage takes per frame.

    Raises:
        SourceError: The source has no frames.
    """
    source = source_of(options)
    outputs: list[Output] = []
    pipeline = Pipeline(detector_of(options), Tracker(new_prefix), outputs)
    read = frames(source, now, clocks.sleep)
    measured = (frame for frame, _ in zip(read, range(options.benchmark), strict=False))
    pipeline.run(measured)
    if not pipeline.frames:
        raise SourceError(f"{source.shown} has no frames")
    print(f"{pipeline.frames} frames, {pipeline.boxes} boxes, {options.threads} thread(s) per stage")
    for stage in ("decode", "detect", "track", "all"):
        wall_ms, processor_ms = pipeline.times.per_frame_ms(stage, pipeline.frames)
        print(f"{stage:<7}{wall_ms:8.2f} ms per frame, {processor_ms:.2f} ms of the processor")
    print(f"{1000 / wall_ms:.0f} frames per second; at most {largest_memory_kib() / 1024:.0f} MiB")
    return 0


def largest_memory_kib() -> int:
    """The most memory that this process has had, of its own: `getrusage` counts that of the process that started it."""
    status = Path("/proc/self/status").read_text()
    return int(status.partition("VmHWM:")[2].split()[0])


def run_learn(options: argparse.Namespace) -> int:
    """Trains a camera from a video and fixes."""
    track = read_track(options.fixes)
    collected = Collector()
    outputs: list[Output] = [collected]
    with ExitStack() as stack:
        if options.record is not None:
            outputs.append(closing(stack, Recorder(options.record)))
        pipeline = Pipeline(detector_of(options), Tracker(new_prefix), outputs)
        source = source_of(options)
        read = frames(source, now, clocks.sleep)
        first = next(read, None)
        if first is None:
            raise SourceError(f"{source.shown} has no frames")
        client = stack.enter_context(Client(options.server, ca_file=options.ca_file))
        ensure_camera(client, options.camera, first.image, create=True)
        pipeline.run(chain([first], read))
        LOG.info("%d frames, %d boxes", pipeline.frames, pipeline.boxes)
        learnt = learn(client, options.camera, collected, track, clock_window_s=options.clock_window_s)
    for line in learnt.lines():
        print(line)
    return 0 if learnt.is_active else 1


if __name__ == "__main__":
    sys.exit(main())
