"""Fixes of a GPX file."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from xml.etree.ElementTree import ParseError

from defusedxml import DefusedXmlException, ElementTree

LARGEST_FILE_BYTES = 64 * 2**20


class FixesError(Exception):
    """A file of fixes cannot be used."""


@dataclass(frozen=True, slots=True)
class TimedFix:
    """Where a receiver was, by its own clock."""

    time: datetime
    longitude_deg: float
    latitude_deg: float


@dataclass(frozen=True)
class GpxTrack:
    """A file with its fixes in the order of their times."""

    path: Path
    fixes: list[TimedFix]


def read_gpx(path: Path) -> GpxTrack:
    """The track points that have a time.

    Raises:
        FixesError: The file cannot be read, is too large or no GPX, or has no track points with times.
    """
    try:
        if path.stat().st_size > LARGEST_FILE_BYTES:
            raise FixesError(f"{path} is larger than {LARGEST_FILE_BYTES} bytes")
        root = ElementTree.parse(path).getroot()
        fixes = [fix for point in root.findall(".//{*}trkpt") if (fix := fix_of(point)) is not None]
    except (OSError, ParseError, DefusedXmlException, ValueError, KeyError) as error:
        raise FixesError(f"{path} is no GPX file: {error}") from error
    if not fixes:
        raise FixesError(f"{path} has no track points with times; record a track, not a route or waypoints")
    return GpxTrack(path, sorted(fixes, key=lambda fix: fix.time))


def fix_of(point: ElementTree.Element) -> TimedFix | None:
    """A track point as a fix, if it has a time; a time without an offset is UTC, as GPX says."""
    text = point.findtext("{*}time")
    if not text:
        return None
    time = datetime.fromisoformat(text.strip())
    if time.tzinfo is None:
        time = datetime.fromisoformat(f"{text.strip()}Z")
    return TimedFix(time, float(point.attrib["lon"]), float(point.attrib["lat"]))
