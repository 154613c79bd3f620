"""Places: areas and lines on the ground, their events and statistics."""

import json
from collections.abc import AsyncGenerator, AsyncIterator
from datetime import datetime
from typing import Any, Literal, Unpack

from sightfix._async.tracks import SILENCE_S
from sightfix._async.transport import Transport
from sightfix._events import PlaceEventMessage, ServerSentEventParser
from sightfix._json import from_json, request_json
from sightfix._request import Request, delete, get, path, with_json
from sightfix.models import Place, PlaceChange, PlaceDraft, PlaceEvent, PlaceEventPage, Statistics


class Places:
    """Places, what happens there, and how often."""

    def __init__(self, transport: Transport) -> None:
        self._transport = transport

    async def create(self, **draft: Unpack[PlaceDraft]) -> Place:
        """Stores a new place of a site or of a camera; its geometry is one of GeoJSON."""
        return await self._transport.json(with_json("POST", path("places"), request_json(draft)), Place)

    async def get(self, place_id: str) -> Place:
        """One place."""
        return await self._transport.json(get(path("places", place_id)), Place)

    def list(
        self, *, site: str | None = None, camera: str | None = None, page_size: int | None = None
    ) -> AsyncIterator[Place]:
        """All places by id, or those of a site or of a camera."""
        return self._transport.items(path("places"), Place, limit=page_size, site=site, camera=camera)

    async def update(self, place_id: str, *, revision: int | None = None, **change: Unpack[PlaceChange]) -> Place:
        """Changes the given fields of a place; the arguments are as in `Cameras.update`.

        Raises:
            RevisionMismatchError: The place has another revision.
        """
        headers = {"if-match": "*" if revision is None else f'"{revision}"'}
        request = with_json("PATCH", path("places", place_id), request_json(change), headers=headers)
        return await self._transport.json(request, Place)

    async def delete(self, place_id: str) -> None:
        """Deletes a place with its events and counts."""
        await self._transport.send(delete(path("places", place_id)))

    async def statistics(
        self,
        place_id: str,
        *,
        from_: datetime | None = None,
        until: datetime | None = None,
        interval: Literal["minute", "hour"] = "minute",
        class_: str | None = None,
    ) -> Statistics:
        """Counts, occupancy, dwell times and speeds of a place, by minutes or hours."""
        url = path("places", place_id, "statistics")
        request = get(url, from_=from_, until=until, interval=interval, class_=class_)
        return await self._transport.json(request, Statistics)

    async def events(
        self,
        *,
        site: str | None = None,
        camera: str | None = None,
        place: str | None = None,
        kind: str | None = None,
        after: str | None = None,
    ) -> AsyncGenerator[PlaceEvent, None]:
        """The stored events, oldest first, or those after an id of `watch`; ends with the latest one."""
        has_more = True
        while has_more:
            request = get(path("place-events"), site=site, camera=camera, place=place, kind=kind, after=after)
            page = await self._transport.json(request, PlaceEventPage)
            for event in page.items:
                yield event
            has_more, after = page.has_more, page.last_event_id

    async def watch(
        self,
        *,
        site: str | None = None,
        camera: str | None = None,
        place: str | None = None,
        kind: str | None = None,
        resume_after: str | None = None,
    ) -> AsyncGenerator[PlaceEventMessage, None]:
        """Events from now on, or after the one of an id that was read before; ends when the server shuts down."""
        asked = get(path("place-events", "stream"), site=site, camera=camera, place=place, kind=kind)
        headers = {"accept": "text/event-stream"}
        if resume_after is not None:
            headers["last-event-id"] = resume_after
        request = Request(method="GET", path=asked.path, query=asked.query, headers=headers, is_idempotent=True)
        parser = ServerSentEventParser()
        async with self._transport.open(request, read_timeout_s=SILENCE_S) as response:
            async for line in response.aiter_lines():
                message = parser.push(line)
                if message is not None and message[0] == "place_event":
                    value: Any = json.loads(message[1])
                    yield PlaceEventMessage(parser.last_event_id, from_json(PlaceEvent, value))
