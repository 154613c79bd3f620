"""API keys and the audit log."""

from collections.abc import AsyncIterator
from typing import Unpack

from sightfix._async.transport import Transport
from sightfix._json import request_json
from sightfix._request import delete, get, path, with_json
from sightfix.models import AuditEntry, CreatedKey, Key, KeyDraft


class Keys:
    """API keys, for administrators."""

    def __init__(self, transport: Transport) -> None:
        self._transport = transport

    async def create(self, **draft: Unpack[KeyDraft]) -> CreatedKey:
        """Creates a key. Its `secret` is told only now."""
        return await self._transport.json(with_json("POST", path("keys"), request_json(draft)), CreatedKey)

    async def get(self, key_id: str) -> Key:
        """One key, without its secret."""
        return await self._transport.json(get(path("keys", key_id)), Key)

    def list(self, *, page_size: int | None = None) -> AsyncIterator[Key]:
        """All keys, without their secrets."""
        return self._transport.items(path("keys"), Key, limit=page_size)

    async def revoke(self, key_id: str) -> None:
        """Revokes a key: what it is used for ends at once."""
        await self._transport.send(delete(path("keys", key_id)))

    def audit_entries(self, *, camera_id: str | None = None, page_size: int | None = None) -> AsyncIterator[AuditEntry]:
        """Who changed what and when, newest first."""
        return self._transport.items(path("audit"), AuditEntry, camera=camera_id, limit=page_size)
