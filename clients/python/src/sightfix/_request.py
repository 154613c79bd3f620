"""Requests and the rules by which they are sent again, independent of how they are sent."""

import email.utils
import random
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from urllib.parse import quote

import httpx

from sightfix._errors import ProblemError, from_response
from sightfix._json import dump, format_time, json_key

Parameter = str | int | float | bool | datetime | None


@dataclass(frozen=True, kw_only=True)
class Request:
    """A request of the REST interface."""

    method: str
    path: str
    query: Mapping[str, Parameter] = field(default_factory=dict)
    headers: Mapping[str, str] = field(default_factory=dict)
    body: bytes | Path | None = None
    """Bytes, or a file, which is read in parts."""
    files: Mapping[str, Path] = field(default_factory=dict)
    """Files of a multipart body by the names of their parts."""
    is_idempotent: bool = False
    """True if sending it twice has the effect of sending it once."""


def path(*segments: str | int) -> str:
    """A path of quoted segments under `/v1`."""
    return "/".join(["/v1", *(quote(str(segment), safe="") for segment in segments)])


def idempotency(key: str | None) -> dict[str, str]:
    """The header of a request that may be sent again, if it has a key."""
    return {} if key is None else {"idempotency-key": key}


def get(path: str, **query: Parameter) -> Request:
    """Reads a resource."""
    return Request(method="GET", path=path, query=query, is_idempotent=True)


def delete(path: str, **query: Parameter) -> Request:
    """Deletes a resource."""
    return Request(method="DELETE", path=path, query=query, is_idempotent=True)


def with_json(
    method: str,
    path: str,
    body: Any,
    *,
    headers: Mapping[str, str] | None = None,
    is_idempotent: bool = False,
) -> Request:
    """Sends JSON values."""
    return Request(
        method=method,
        path=path,
        headers={"content-type": "application/json", **(headers or {})},
        body=dump(body),
        is_idempotent=is_idempotent,
    )


def redirection(response: httpx.Response) -> str | None:
    """The same request at the node of the server that answers it, never without the encryption that it had."""
    location = response.headers.get("location")
    if response.status_code != httpx.codes.TEMPORARY_REDIRECT or location is None:
        return None
    is_plain = response.request.url.scheme == "http"
    return location if is_plain or location.startswith("https:") else None


def query_parameters(query: Mapping[str, Parameter]) -> dict[str, str]:
    """Parameters as text, without those that are None. A trailing underscore of a name is dropped."""
    texts = {}
    for name, value in query.items():
        if isinstance(value, bool):
            texts[json_key(name)] = "true" if value else "false"
        elif isinstance(value, datetime):
            texts[json_key(name)] = format_time(value)
        elif value is not None:
            texts[json_key(name)] = str(value)
    return texts


@dataclass(frozen=True, kw_only=True)
class RetryPolicy:
    """When and how often a request is sent again.

    A request is sent again if it cannot have had an effect (no connection, or 429 or 503 because of
    overload), and an idempotent one also after a broken connection or at a server that shuts down.
    """

    attempts: int = 6
    """Attempts in total; 1 sends nothing twice."""
    initial_delay_s: float = 0.2
    """Upper limit of the delay after the first failure; it doubles with each one."""
    max_delay_s: float = 10.0
    """Upper limit of every delay, also of those that the server asks for."""
    draw: Callable[[], float] = random.random
    """Uniform numbers in [0, 1)."""

    def delay_s(self, failures: int, retry_after_s: float | None = None) -> float:
        """The delay after a number of failures in succession: exponential with jitter, or what the server asks for."""
        doubled = min(self.initial_delay_s * 2.0 ** min(failures - 1, 16), self.max_delay_s)
        jittered = doubled * (0.5 + 0.5 * self.draw())
        return jittered if retry_after_s is None else min(max(retry_after_s, jittered), self.max_delay_s)


def problem_of(response: httpx.Response) -> ProblemError:
    """The exception of a response that is not a success, whose body is read."""
    body = None
    if "json" in response.headers.get("content-type", ""):
        try:
            body = response.json()
        except ValueError:
            body = None
    is_object = isinstance(body, dict)
    return from_response(response.status_code, response.reason_phrase, body if is_object else None)


def may_send_again(request: Request, status: int, problem: ProblemError) -> bool:
    """True if a refused request may be sent again."""
    refused = ("overloaded", "camera-between-nodes", "camera-on-other-node")
    refused_before_work = problem.kind in refused or status == httpx.codes.TOO_MANY_REQUESTS
    retryable = (
        httpx.codes.TOO_MANY_REQUESTS,
        httpx.codes.BAD_GATEWAY,
        httpx.codes.SERVICE_UNAVAILABLE,
        httpx.codes.GATEWAY_TIMEOUT,
    )
    return refused_before_work or (request.is_idempotent and status in retryable)


def was_not_sent(error: httpx.TransportError) -> bool:
    """True if a request failed before any of it was sent."""
    return isinstance(error, httpx.ConnectError | httpx.ConnectTimeout | httpx.PoolTimeout)


def retry_after_s(response: httpx.Response, now: datetime | None = None) -> float | None:
    """The pause that the header `Retry-After` asks for, in seconds or as an HTTP date."""
    text = response.headers.get("retry-after")
    if text is None:
        return None
    if text.isdigit():
        return float(text)
    try:
        date = email.utils.parsedate_to_datetime(text)
    except ValueError:
        return None
    return max((date - (now or datetime.now(UTC))).total_seconds(), 0.0)


def in_chunks(rows: Iterable[Any], size: int) -> Iterable[list[Any]]:
    """Lists of at most `size` rows."""
    chunk = []
    for row in rows:
        chunk.append(row)
        if len(chunk) == size:
            yield chunk
            chunk = []
    if chunk:
        yield chunk
