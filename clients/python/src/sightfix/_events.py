"""Server-sent events of cameras, sites and places."""

from dataclasses import dataclass
from typing import Any

from sightfix._json import from_json
from sightfix.models import (
    CameraMoved,
    LostSiteEventCount,
    PlaceEvent,
    SeenBox,
    TrackChange,
    TrackUpdate,
    WorldTrackFeature,
)


@dataclass(frozen=True)
class LostEvents:
    """Events that were lost because this client read too slowly."""

    count: int | None
    """How many; None if the server does not know."""


@dataclass(frozen=True)
class SiteEvent:
    """An event of a site."""

    id: str
    """Its id; a watch can resume after it."""
    name: str
    """`track`, `track_started`, `handed_over`, `identified`, `merged`, `track_ended` or `lost`."""
    body: WorldTrackFeature | TrackChange | LostSiteEventCount
    """A position (`track`), lost events (`lost`), or a change of tracks."""


@dataclass(frozen=True)
class PlaceEventMessage:
    """An event of a place, as it is read from the stream."""

    id: str
    """The id to resume after; that of the event itself is `event.id`."""
    event: PlaceEvent
    """The event."""


CameraEvent = TrackUpdate | SeenBox | CameraMoved | LostEvents


class ServerSentEventParser:
    """Builds events from lines (HTML standard, section 9.2.6)."""

    last_event_id = ""
    """Id of the latest event that had one."""

    def __init__(self) -> None:
        self._name = ""
        self._lines: list[str] = []

    def push(self, line: str) -> tuple[str, str] | None:
        """Takes a line without its end; returns name and text of an event that it completes."""
        if line:
            field, _, value = line.partition(":")
            value = value.removeprefix(" ")
            if field == "event":
                self._name = value
            elif field == "data":
                self._lines.append(value)
            elif field == "id":
                self.last_event_id = value
            return None
        event = (self._name, "\n".join(self._lines)) if self._lines else None
        self._name, self._lines = "", []
        return event


def site_event(id_: str, name: str, value: Any) -> SiteEvent | None:
    """An event of a site from its name and JSON values; None for a name that this version does not know."""
    match name:
        case "track":
            return SiteEvent(id_, name, from_json(WorldTrackFeature, value))
        case "lost":
            return SiteEvent(id_, name, from_json(LostSiteEventCount, value))
        case "track_started" | "handed_over" | "identified" | "merged" | "track_ended":
            return SiteEvent(id_, name, from_json(TrackChange, value))
        case _:
            return None


def camera_event(name: str, value: Any) -> CameraEvent | None:
    """An event from its name and JSON values; None for a name that this version does not know."""
    match name:
        case "track":
            return from_json(TrackUpdate, value)
        case "box":
            return from_json(SeenBox, value)
        case "camera_moved":
            return from_json(CameraMoved, value)
        case "lost":
            return LostEvents(value)
        case _:
            return None
