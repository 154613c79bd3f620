"""Fixes of a file."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from xml.etree.ElementTree import ParseError

from defusedxml import DefusedXmlException, ElementTree

LARGEST_FILE_BYTES = 64 * 2**20
UNNAMED = "walker"
"""The receiver of fixes that name none, and the target that carries it."""


class FixesError(Exception):
    """A file of fixes cannot be used."""


@dataclass(frozen=True, slots=True)
class TimedFix:
    """Where a receiver was, by its own clock."""

    time: datetime
    longitude_deg: float
    latitude_deg: float


@dataclass(frozen=True)
class Track:
    """A file with the fixes of one receiver in the order of their times."""

    path: Path
    receiver_id: str
    fixes: list[TimedFix]


def read_track(path: Path) -> Track:
    """The fixes of a GPX file, or of a CSV file as the page /walk gives it.

    Raises:
        FixesError: The file cannot be read, is too large or of another format, or has no fixes of one receiver.
    """
    try:
        if path.stat().st_size > LARGEST_FILE_BYTES:
            raise FixesError(f"{path} is larger than {LARGEST_FILE_BYTES} bytes")
        receivers, fixes = csv_fixes(path) if path.suffix.lower() == ".csv" else ({UNNAMED}, gpx_fixes(path))
    except (OSError, ParseError, DefusedXmlException, ValueError, KeyError) as error:
        raise FixesError(f"{path} is no GPX file, nor a CSV file of fixes: {error!r}") from error
    if not fixes:
        raise FixesError(f"{path} has no fixes with times; record a track, not a route or waypoints")
    if len(receivers) != 1:
        raise FixesError(f"{path} has fixes of several receivers ({', '.join(sorted(receivers))}); give those of one")
    return Track(path, receivers.pop(), sorted(fixes, key=lambda fix: fix.time))


def gpx_fixes(path: Path) -> list[TimedFix]:
    """The track points that have a time."""
    points = ElementTree.parse(path).getroot().findall(".//{*}trkpt")
    return [fix for point in points if (fix := fix_of(point)) is not None]


def csv_fixes(path: Path) -> tuple[set[str], list[TimedFix]]:
    """The receivers that are named, and the rows: `time`, `longitude`, `latitude`, and `receiver_id` if it is there."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    receivers = {row.get("receiver_id") or UNNAMED for row in rows}
    times = (datetime.fromisoformat(row["time"]) for row in rows)
    fixes = [
        TimedFix(time, float(row["longitude"]), float(row["latitude"])) for time, row in zip(times, rows, strict=True)
    ]
    if any(fix.time.tzinfo is None for fix in fixes):
        raise ValueError("a time has no UTC offset")
    return receivers, fixes


def fix_of(point: ElementTree.Element) -> TimedFix | None:
    """A track point as a fix, if it has a time; a time without an offset is UTC, as GPX says."""
    text = point.findtext("{*}time")
    if not text:
        return None
    time = datetime.fromisoformat(text.strip())
    if time.tzinfo is None:
        time = datetime.fromisoformat(f"{text.strip()}Z")
    return TimedFix(time, float(point.attrib["lon"]), float(point.attrib["lat"]))
