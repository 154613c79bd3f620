"""Model versions."""

from collections.abc import AsyncIterator
from pathlib import Path
from typing import Literal

from sightfix._async.transport import Transport
from sightfix._request import Request, delete, get, path, with_json
from sightfix.models import ModelVersion


class Models:
    """Immutable versions of a camera's model."""

    def __init__(self, transport: Transport) -> None:
        self._transport = transport

    def list(self, camera_id: str, *, page_size: int | None = None) -> AsyncIterator[ModelVersion]:
        """The versions of a camera."""
        return self._transport.items(path("cameras", camera_id, "models"), ModelVersion, limit=page_size)

    async def get(self, camera_id: str, number: int) -> ModelVersion:
        """One version."""
        return await self._transport.json(get(path("cameras", camera_id, "models", number)), ModelVersion)

    async def active(self, camera_id: str) -> ModelVersion:
        """The version that answers.

        Raises:
            ConflictError: There is none.
        """
        return await self._transport.json(get(path("cameras", camera_id, "active-model")), ModelVersion)

    async def activate(self, camera_id: str, number: int) -> ModelVersion:
        """Makes a version the active one."""
        request = with_json("PUT", path("cameras", camera_id, "active-model"), {"number": number}, is_idempotent=True)
        return await self._transport.json(request, ModelVersion)

    async def roll_back(self, camera_id: str) -> ModelVersion:
        """Activates the version that was active before."""
        request = Request(method="POST", path=path("cameras", camera_id, "active-model", "roll-back"))
        return await self._transport.json(request, ModelVersion)

    async def download(
        self, camera_id: str, number: int, *, file_format: Literal["safetensors", "onnx"] = "safetensors"
    ) -> bytes:
        """The file of a version: safetensors for `import_file` here or on another server, ONNX for other runtimes."""
        request = get(path("cameras", camera_id, "models", number, "file"), format=file_format)
        return (await self._transport.send(request)).content

    async def import_file(self, camera_id: str, model: bytes | Path) -> ModelVersion:
        """Stores a downloaded file as a new version, which does not become active by itself."""
        request = Request(
            method="POST",
            path=path("cameras", camera_id, "models"),
            headers={"content-type": "application/vnd.safetensors"},
            body=model,
        )
        return await self._transport.json(request, ModelVersion)

    async def delete(self, camera_id: str, number: int) -> None:
        """Deletes a version that is not active."""
        await self._transport.send(delete(path("cameras", camera_id, "models", number)))
