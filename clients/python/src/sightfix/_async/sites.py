"""Sites: several cameras with one set of tracks."""

import json
from collections.abc import AsyncGenerator, AsyncIterator, Sequence
from typing import Unpack

from sightfix._async.tracks import SILENCE_S
from sightfix._async.transport import Transport
from sightfix._events import ServerSentEventParser, SiteEvent, site_event
from sightfix._json import request_json
from sightfix._request import Request, delete, get, path, with_json
from sightfix.models import Site, SiteChange, SiteDraft, WorldTrack, WorldTracks


class Sites:
    """Sites and the tracks of targets over all of their cameras."""

    def __init__(self, transport: Transport) -> None:
        self._transport = transport

    async def create(self, **draft: Unpack[SiteDraft]) -> Site:
        """Stores a new site. Cameras name it in their profiles."""
        return await self._transport.json(with_json("POST", path("sites"), request_json(draft)), Site)

    async def get(self, site_id: str) -> Site:
        """One site."""
        return await self._transport.json(get(path("sites", site_id)), Site)

    def list(self, *, page_size: int | None = None) -> AsyncIterator[Site]:
        """All sites by id."""
        return self._transport.items(path("sites"), Site, limit=page_size)

    async def update(self, site_id: str, *, revision: int | None = None, **change: Unpack[SiteChange]) -> Site:
        """Changes the given fields of a site; the arguments are as in `Cameras.update`.

        Raises:
            RevisionMismatchError: The site has another revision.
        """
        headers = {"if-match": "*" if revision is None else f'"{revision}"'}
        request = with_json("PATCH", path("sites", site_id), request_json(change), headers=headers)
        return await self._transport.json(request, Site)

    async def delete(self, site_id: str) -> None:
        """Deletes a site; its cameras stay."""
        await self._transport.send(delete(path("sites", site_id)))

    async def tracks(self, site_id: str) -> Sequence[WorldTrack]:
        """The latest positions of all targets that are tracked over the cameras of a site."""
        return (await self._transport.json(get(path("sites", site_id, "tracks")), WorldTracks)).items

    async def watch(self, site_id: str, *, resume_after: str | None = None) -> AsyncGenerator[SiteEvent, None]:
        """The events of a site from now on, or after the event of an id that was read before.

        Ends when the site is deleted or the server shuts down.
        """
        headers = {"accept": "text/event-stream"}
        if resume_after is not None:
            headers["last-event-id"] = resume_after
        request = Request(method="GET", path=path("sites", site_id, "events"), headers=headers, is_idempotent=True)
        parser = ServerSentEventParser()
        async with self._transport.open(request, read_timeout_s=SILENCE_S) as response:
            async for line in response.aiter_lines():
                message = parser.push(line)
                event = site_event(parser.last_event_id, message[0], json.loads(message[1])) if message else None
                if event is not None:
                    yield event

    async def history(self, site_id: str, track_id: str) -> Sequence[WorldTrack]:
        """The positions of one target, oldest first."""
        return (await self._transport.json(get(path("sites", site_id, "tracks", track_id)), WorldTracks)).items
