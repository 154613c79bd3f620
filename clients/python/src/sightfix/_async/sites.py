"""Sites: several cameras with one set of tracks."""

from collections.abc import AsyncIterator, Sequence
from typing import Unpack

from sightfix._async.transport import Transport
from sightfix._json import request_json
from sightfix._request import delete, get, path, with_json
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

    async def history(self, site_id: str, track_id: str) -> Sequence[WorldTrack]:
        """The positions of one target, oldest first."""
        return (await self._transport.json(get(path("sites", site_id, "tracks", track_id)), WorldTracks)).items
