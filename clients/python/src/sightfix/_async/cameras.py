"""Cameras."""

from collections.abc import AsyncIterator, Iterable
from typing import Unpack

from sightfix._async.transport import Transport
from sightfix._json import request_json, to_json
from sightfix._request import Request, delete, get, path, with_json
from sightfix.models import Camera, CameraChange, CameraDraft, CameraStatus, Estimate, Fix, Learning

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"


class Cameras:
    """Profiles of cameras."""

    def __init__(self, transport: Transport) -> None:
        self._transport = transport

    async def create(self, **draft: Unpack[CameraDraft]) -> Camera:
        """Stores a new camera."""
        return await self._transport.json(with_json("POST", path("cameras"), request_json(draft)), Camera)

    async def get(self, camera_id: str) -> Camera:
        """One camera."""
        return await self._transport.json(get(path("cameras", camera_id)), Camera)

    def list(self, *, page_size: int | None = None) -> AsyncIterator[Camera]:
        """All cameras by id."""
        return self._transport.items(path("cameras"), Camera, limit=page_size)

    def statuses(self, *, page_size: int | None = None) -> AsyncIterator[CameraStatus]:
        """All cameras with their latest run, model and activity."""
        return self._transport.items(path("camera-statuses"), CameraStatus, limit=page_size)

    async def update(self, camera_id: str, *, revision: int | None = None, **change: Unpack[CameraChange]) -> Camera:
        """Changes the given fields of a profile; None resets a field.

        Args:
            camera_id: The camera.
            revision: The revision on which the change is based; without it, the change applies to any.
            change: New values.

        Raises:
            RevisionMismatchError: The camera has another revision.
        """
        headers = {"if-match": "*" if revision is None else f'"{revision}"'}
        request = with_json("PATCH", path("cameras", camera_id), request_json(change), headers=headers)
        return await self._transport.json(request, Camera)

    async def delete(self, camera_id: str) -> None:
        """Deletes a camera with its samples, runs and models."""
        await self._transport.send(delete(path("cameras", camera_id)))

    async def learning(self, camera_id: str) -> Learning:
        """The recording that a camera without a model learns from, and what is missing in it."""
        return await self._transport.json(get(path("cameras", camera_id, "learning")), Learning)

    async def picture(self, camera_id: str) -> bytes | None:
        """The picture of what a camera sees, a JPEG or PNG; None if nobody has set one."""
        response = await self._transport.send(get(path("cameras", camera_id, "picture")))
        return response.content or None

    async def set_picture(self, camera_id: str, picture: bytes) -> None:
        """Sets the picture of what a camera sees: a JPEG or PNG of at most 2 MiB, as the server is configured."""
        media_type = "image/png" if picture.startswith(PNG_SIGNATURE) else "image/jpeg"
        request = Request(
            method="PUT",
            path=path("cameras", camera_id, "picture"),
            headers={"content-type": media_type},
            body=picture,
            is_idempotent=True,
        )
        await self._transport.send(request)

    async def delete_picture(self, camera_id: str) -> None:
        """Removes the picture of what a camera sees."""
        await self._transport.send(delete(path("cameras", camera_id, "picture")))

    async def estimate_gnss_error(self, camera_id: str, fixes: Iterable[Fix]) -> Estimate:
        """Estimates a receiver's error from at least ten fixes at one fixed point. Nothing is stored."""
        body = {"fixes": [to_json(fix) for fix in fixes]}
        request = with_json("POST", path("cameras", camera_id, "gnss-error"), body, is_idempotent=True)
        return await self._transport.json(request, Estimate)
