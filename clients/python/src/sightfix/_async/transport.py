"""Sends requests, and sends them again where that is safe."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any, TypeVar

import httpx

from sightfix._errors import ConnectionFailedError, ProblemError, SightfixError
from sightfix._json import from_json
from sightfix._request import (
    Request,
    get,
    may_send_again,
    problem_of,
    query_parameters,
    redirection,
    retry_after_s,
    was_not_sent,
)
from sightfix._runtime.asynchronous import file_parts, sleep
from sightfix._settings import Settings

T = TypeVar("T")


class Transport:
    """The connections of a client."""

    def __init__(self, settings: Settings, transport: httpx.AsyncBaseTransport | None) -> None:
        self._retry = settings.retry
        self._http = httpx.AsyncClient(
            base_url=settings.server,
            headers=settings.headers(),
            timeout=settings.timeout_s,
            verify=settings.tls_context() if settings.server.startswith("https:") else True,
            transport=transport,
        )

    async def close(self) -> None:
        """Closes all connections."""
        await self._http.aclose()

    async def send(self, request: Request) -> httpx.Response:
        """The response to a request, with its body.

        Raises:
            ProblemError: The server refused it, or failed.
            ConnectionFailedError: No response came.
        """
        async with self.open(request) as response:
            await response.aread()
            return response

    async def json(self, request: Request, kind: type[T]) -> T:
        """The response to a request as a type of `sightfix.models`. Raises as `send`."""
        return from_json(kind, (await self.send(request)).json())

    async def items(self, path: str, kind: type[T], **query: Any) -> AsyncIterator[T]:
        """The items of all pages of a list; each page is requested when it is needed. Raises as `send`."""
        cursor = None
        while True:
            page = (await self.send(get(path, **query, cursor=cursor))).json()
            for item in page["items"]:
                yield from_json(kind, item)
            cursor = page.get("next_cursor")
            if cursor is None:
                return

    @asynccontextmanager
    async def open(self, request: Request, *, read_timeout_s: float | None = None) -> AsyncIterator[httpx.Response]:
        """The response to a request, whose body can be read in parts. Raises as `send`."""
        failures = 0
        node: str | None = None
        while True:
            wait_s: float | None = None
            try:
                response = await self._http.send(self._build(request, read_timeout_s, node), stream=True)
            except httpx.TransportError as error:
                failure: SightfixError = ConnectionFailedError(f"{request.method} {request.path}: {error!r}")
                failure.__cause__ = error
                is_retryable = request.is_idempotent or was_not_sent(error)
            else:
                if response.is_success:
                    break
                problem = await read_problem(response)
                is_first, node = node is None, redirection(response)
                if is_first and node is not None:
                    continue
                failure, wait_s = problem, retry_after_s(response)
                is_retryable = may_send_again(request, response.status_code, problem)
            failures += 1
            if not is_retryable or failures >= self._retry.attempts:
                raise failure
            node = None
            await sleep(self._retry.delay_s(failures, wait_s))
        try:
            yield response
        finally:
            await response.aclose()

    def _build(self, request: Request, read_timeout_s: float | None, node: str | None) -> httpx.Request:
        """The request as it is sent, or the same to the location that the server named."""
        body = request.body
        content = body if isinstance(body, bytes) or body is None else file_parts(body)
        files = {part: (file.name, file.read_bytes()) for part, file in request.files.items()}
        built = self._http.build_request(
            request.method,
            node or request.path,
            params=None if node else query_parameters(request.query),
            headers=dict(request.headers),
            content=content,
            files=files or None,
        )
        if read_timeout_s is not None:
            built.extensions["timeout"]["read"] = read_timeout_s
        return built


async def read_problem(response: httpx.Response) -> ProblemError:
    """The exception of a refused request."""
    try:
        await response.aread()
    finally:
        await response.aclose()
    return problem_of(response)
