"""The client of a server."""

from __future__ import annotations

import os
import socket
from collections.abc import AsyncGenerator, AsyncIterable, Iterable
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Self

import httpx

from sightfix._async.cameras import Cameras
from sightfix._async.evaluations import Evaluations
from sightfix._async.fusions import Fusions
from sightfix._async.history import History
from sightfix._async.keys import Keys
from sightfix._async.models import Models
from sightfix._async.places import Places
from sightfix._async.samples import Samples
from sightfix._async.sites import Sites
from sightfix._async.tracks import Tracks
from sightfix._async.training_runs import SiteTrainingRuns, TrainingRuns
from sightfix._async.transport import Transport
from sightfix._items import LiveItem
from sightfix._request import RetryPolicy, get, path
from sightfix._settings import DEFAULT_SERVER, settings
from sightfix.models import Durability, Observation, Sample, Server

if TYPE_CHECKING:
    from sightfix._async.stream import Stream
    from sightfix._stream_messages import Answer

STREAM_RETRY = RetryPolicy(attempts=60, initial_delay_s=0.1, max_delay_s=5.0)


class AsyncClient:
    """A client of a sightfix server.

    All methods raise `ProblemError` if the server refuses, and `ConnectionFailedError` if it cannot be reached.

    Args:
        server: Address of the server; https:// for TLS.
        api_key: API key; by default that of the environment variable `SIGHTFIX_API_KEY`.
        ca_file: Authority of the server's certificate (PEM), if it is none of the system's.
        certificate_files: Certificate of this client and its private key (PEM), if the server asks for one.
        timeout_s: Limit of connecting and of every silence within a response.
        retry: When and how often a request is sent again.
        transport: Replaces the network connection, for tests.
    """

    def __init__(
        self,
        server: str = DEFAULT_SERVER,
        *,
        api_key: str | None = None,
        ca_file: str | Path | None = None,
        certificate_files: tuple[str | Path, str | Path] | None = None,
        timeout_s: float = 60.0,
        retry: RetryPolicy | None = None,
        transport: httpx.AsyncBaseTransport | None = None,
    ) -> None:
        self._settings = settings(
            server,
            api_key=api_key,
            ca_file=ca_file,
            certificate_files=certificate_files,
            timeout_s=timeout_s,
            retry=retry,
        )
        self._transport = Transport(self._settings, transport)
        self.cameras = Cameras(self._transport)
        self.samples = Samples(self._transport)
        self.training_runs = TrainingRuns(self._transport)
        self.models = Models(self._transport)
        self.fusions = Fusions(self._transport)
        self.tracks = Tracks(self._transport)
        self.evaluations = Evaluations(self._transport)
        self.sites = Sites(self._transport)
        self.places = Places(self._transport)
        self.site_training_runs = SiteTrainingRuns(self._transport)
        self.history = History(self._transport)
        self.keys = Keys(self._transport)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    async def close(self) -> None:
        """Closes all connections."""
        await self._transport.close()

    async def server(self) -> Server:
        """Version and limits of the server."""
        return await self._transport.json(get(path("server")), Server)

    def stream(
        self,
        camera_id: str,
        *,
        client_name: str | None = None,
        store_samples: bool = False,
        durability: Durability = "synced",
        in_flight: int = 64,
        buffer_items: int = 4096,
        retry: RetryPolicy = STREAM_RETRY,
        keeps_all_answers: bool = False,
    ) -> Stream:
        """A live stream, to be used in a `with` block. Needs the extra `stream`.

        Args:
            camera_id: The camera.
            client_name: Name of this client, which the server limits; by default host name and process id.
            store_samples: Whether boxes and fixes are paired and stored as samples.
            durability: When stored samples are acknowledged.
            in_flight: Items that wait for their answer at a time.
            buffer_items: Items that are not done at a time; beyond it `send` waits.
            retry: When and how often an open stream reconnects in succession.
            keeps_all_answers: Whether `send` also waits while that many answers are not read; else the oldest ones
                are dropped and counted in `dropped_answers`.
        """
        try:
            from sightfix._async.stream import Stream, StreamOptions  # noqa: PLC0415, an optional dependency
        except ImportError as error:
            raise ImportError("streams need `pip install sightfix[stream]`") from error
        options = StreamOptions(
            camera_id=camera_id,
            client_name=client_name or f"{socket.gethostname()[:100]}-{os.getpid()}",
            store_samples=store_samples,
            durability=durability,
            in_flight=in_flight,
            buffer_items=buffer_items,
            retry=retry,
            keeps_all_answers=keeps_all_answers,
        )
        return Stream(self._settings, options)

    async def stream_items(
        self,
        camera_id: str,
        items: Iterable[LiveItem | Observation | Sample] | AsyncIterable[LiveItem | Observation | Sample],
        *,
        client_name: str | None = None,
        store_samples: bool = False,
        durability: Durability = "synced",
        in_flight: int = 64,
        buffer_items: int = 4096,
        retry: RetryPolicy = STREAM_RETRY,
    ) -> AsyncGenerator[Answer, None]:
        """Streams items and yields the answer of each, until all are answered, and acknowledged if they are stored.

        Needs the extra `stream`. The arguments are those of `stream`. Items are taken from the iterable as the server
        takes them.
        """
        stream = self.stream(
            camera_id,
            client_name=client_name,
            store_samples=store_samples,
            durability=durability,
            in_flight=in_flight,
            buffer_items=buffer_items,
            retry=retry,
            keeps_all_answers=True,
        )
        async for answer in stream.answers_to(items):
            yield answer
