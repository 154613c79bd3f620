"""A client of the REST interface that records what it does."""

import http.client
import itertools
import json
import time
from collections.abc import Callable
from typing import Any
from urllib.parse import urlsplit

from .record import Operation, Recorder

#: Redirections to the owner of a camera that are followed.
MOST_REDIRECTS = 4

Keep = Callable[[Any, dict[str, str]], Any]


def whole(answer: Any, _headers: dict[str, str]) -> Any:
    """Keeps an answer as it is."""
    return answer


def nothing(_answer: Any, _headers: dict[str, str]) -> Any:
    """Keeps nothing of an answer but its status."""
    return None


def exchange(
    method: str, url: str, body: bytes | None, headers: dict[str, str], timeout_s: float
) -> tuple[int, dict[str, str], bytes]:
    """Sends one request on a connection of its own.

    Raises:
        OSError: The connection broke or timed out.
        http.client.HTTPException: The answer is not HTTP.
    """
    parts = urlsplit(url)
    connection = http.client.HTTPConnection(parts.hostname or "", parts.port, timeout=timeout_s)
    try:
        path = parts.path + (f"?{parts.query}" if parts.query else "")
        connection.request(method, path, body, headers)
        response = connection.getresponse()
        content = response.read()
        return response.status, {name.lower(): value for name, value in response.getheaders()}, content
    finally:
        connection.close()


def decoded(content: bytes) -> Any:
    """The JSON of an answer; nothing where it is something else."""
    try:
        return json.loads(content)
    except ValueError:
        return None


class Api:
    """Sends requests to one address and records them."""

    def __init__(self, base: str, key: str, recorder: Recorder, timeout_s: float = 4.0) -> None:
        self.base = base
        self.key = key
        self.recorder = recorder
        self.timeout_s = timeout_s
        self._numbers = itertools.count(1)

    def send(
        self,
        action: str,
        subject: str,
        method: str,
        path: str,
        body: Any = None,
        *,
        arguments: dict[str, Any] | None = None,
        headers: dict[str, str] | None = None,
        keep: Keep = nothing,
        follow: bool = True,
        base: str | None = None,
        key: str | None = None,
    ) -> Operation:
        """Sends a request, follows redirections, and records it with what `keep` keeps of the answer."""
        request_id = f"{self.recorder.client}.{next(self._numbers)}"
        sent = {"authorization": f"Bearer {key or self.key}", "x-request-id": request_id} | (headers or {})
        content = body if isinstance(body, bytes) or body is None else json.dumps(body).encode()
        if content is not None:
            sent.setdefault("content-type", "application/json")
        call_ns = time.monotonic_ns()
        status, answer = self._exchange(method, (base or self.base) + path, content, sent, keep, follow)
        return self.recorder.add(
            Operation(
                self.recorder.client, action, subject, arguments or {}, call_ns, time.monotonic_ns(), status, answer,
                request_id,
            )
        )  # fmt: skip

    def _exchange(
        self, method: str, url: str, body: bytes | None, headers: dict[str, str], keep: Keep, follow: bool
    ) -> tuple[int | None, Any]:
        for _ in range(MOST_REDIRECTS):
            try:
                status, received, content = exchange(method, url, body, headers, self.timeout_s)
            except (OSError, http.client.HTTPException):
                return None, None
            if status not in (307, 308) or not follow:
                break
            url = received["location"]
        answer = decoded(content)
        if 200 <= status < 300:
            return status, keep(answer, received)
        return status, {"type": (answer or {}).get("type"), "detail": (answer or {}).get("detail")}
