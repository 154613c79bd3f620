"""Tracks of targets."""

import json
from collections.abc import AsyncGenerator, Iterable, Sequence
from dataclasses import replace

from sightfix._async.transport import Transport
from sightfix._events import CameraEvent, ServerSentEventParser, camera_event
from sightfix._json import to_json
from sightfix._request import Request, get, path, with_json
from sightfix.models import (
    Durability,
    FollowedObservation,
    FollowedObservations,
    Observation,
    TrackFeature,
    TrackFeatures,
)

SILENCE_S = 60.0


class Tracks:
    """Filtered positions of targets over time."""

    def __init__(self, transport: Transport) -> None:
        self._transport = transport

    async def list(self, camera_id: str) -> Sequence[TrackFeature]:
        """The latest positions of all tracked targets."""
        return (await self._transport.json(get(path("cameras", camera_id, "tracks")), TrackFeatures)).features

    async def history(self, camera_id: str, target_id: str) -> Sequence[TrackFeature]:
        """The positions of one target, oldest first."""
        request = get(path("cameras", camera_id, "tracks", target_id))
        return (await self._transport.json(request, TrackFeatures)).features

    async def follow(self, camera_id: str, observations: Iterable[Observation]) -> Sequence[FollowedObservation]:
        """Tracks the targets of observations; for clients that do not stream."""
        body = {"observations": [to_json(observation) for observation in observations]}
        request = with_json("POST", path("cameras", camera_id, "tracks"), body)
        return (await self._transport.json(request, FollowedObservations)).items

    async def follow_and_store(
        self, camera_id: str, observations: Iterable[Observation], *, durability: Durability = "synced"
    ) -> FollowedObservations:
        """Tracks the targets of observations, pairs boxes with fixes and stores the pairs as samples.

        Returns when it is decided what becomes of each observation, some seconds later.
        """
        body = {"observations": [to_json(observation) for observation in observations]}
        request = replace(
            with_json("POST", path("cameras", camera_id, "tracks"), body),
            query={"store_samples": True, "durability": durability},
        )
        return await self._transport.json(request, FollowedObservations)

    async def watch(self, camera_id: str) -> AsyncGenerator[CameraEvent, None]:
        """The events of a camera from now on: measured targets, a moved camera, lost events.

        Ends when the camera is deleted or the server shuts down.
        """
        request = Request(
            method="GET",
            path=path("cameras", camera_id, "events"),
            headers={"accept": "text/event-stream"},
            is_idempotent=True,
        )
        parser = ServerSentEventParser()
        async with self._transport.open(request, read_timeout_s=SILENCE_S) as response:
            async for line in response.aiter_lines():
                message = parser.push(line)
                event = camera_event(message[0], json.loads(message[1])) if message else None
                if event is not None:
                    yield event
