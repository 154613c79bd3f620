"""Server-sent events of a camera."""

from dataclasses import dataclass
from typing import Any

from sightfix._json import from_json
from sightfix.models import CameraMoved, TrackUpdate


@dataclass(frozen=True)
class LostEvents:
    """Events that were lost because this client read too slowly."""

    count: int | None
    """How many; None if the server does not know."""


CameraEvent = TrackUpdate | CameraMoved | LostEvents


class ServerSentEventParser:
    """Builds events from lines (HTML standard, section 9.2.6)."""

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
            return None
        event = (self._name, "\n".join(self._lines)) if self._lines else None
        self._name, self._lines = "", []
        return event


def camera_event(name: str, value: Any) -> CameraEvent | None:
    """An event from its name and JSON values; None for a name that this version does not know."""
    match name:
        case "track":
            return from_json(TrackUpdate, value)
        case "camera_moved":
            return from_json(CameraMoved, value)
        case "lost":
            return LostEvents(value)
        case _:
            return None
