"""Live streams that resume after a broken connection."""

from __future__ import annotations

from collections import deque
from collections.abc import AsyncGenerator, AsyncIterable, AsyncIterator, Iterable
from dataclasses import dataclass
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import grpc
import grpc.aio

from sightfix._errors import ProblemError, SightfixError, StreamClosedError
from sightfix._items import LiveItem
from sightfix._request import RetryPolicy
from sightfix._resend_buffer import ResendBuffer
from sightfix._runtime.asynchronous import Condition, Task, iterate, wait_at_most
from sightfix._settings import Settings
from sightfix._stream_messages import (
    Acknowledgement,
    Answer,
    closed_early,
    durability_value,
    stream_failure,
    to_message,
)
from sightfix.models import Durability, Observation, Sample
from sightfix.v1 import fusion_service_pb2 as messages
from sightfix.v1 import values_pb2 as values
from sightfix.v1.fusion_service_pb2_grpc import FusionServiceStub

if TYPE_CHECKING:
    from sightfix.v1.fusion_service_pb2_grpc import FusionServiceAsyncStub

StreamInput = LiveItem | Observation | Sample

CHANNEL_OPTIONS = [
    ("grpc.keepalive_time_ms", 10_000),
    ("grpc.keepalive_timeout_ms", 10_000),
    ("grpc.initial_reconnect_backoff_ms", 100),
    ("grpc.min_reconnect_backoff_ms", 100),
    ("grpc.max_reconnect_backoff_ms", 1_000),
]


@dataclass(frozen=True, kw_only=True)
class StreamOptions:
    """The purpose and the buffers of a stream."""

    camera_id: str
    client_name: str
    store_samples: bool
    durability: Durability
    in_flight: int
    buffer_items: int
    retry: RetryPolicy
    """Applies once the stream was open; before that, the one of the client."""
    keeps_all_answers: bool
    """True if `send` waits while answers are not read; else the oldest ones are dropped."""


def open_channel(settings: Settings, server: str) -> grpc.aio.Channel:
    """A connection to an address, made when it is first needed and again after it broke."""
    scheme, _, address = server.partition("://")
    if scheme == "http":
        return grpc.aio.insecure_channel(address, options=CHANNEL_OPTIONS)
    authority, certificate, key = (
        path.read_bytes() if path else None for path in (settings.ca_file, settings.certificate_file, settings.key_file)
    )
    credentials = grpc.ssl_channel_credentials(authority, key, certificate)
    default_port = "" if ":" in address.rpartition("]")[2] else ":443"
    return grpc.aio.secure_channel(address + default_port, credentials, options=CHANNEL_OPTIONS)


class Stream:
    """A live stream of one camera: items go in by `send`, answers come out by iteration.

    After a broken connection or a restart of the server it reconnects with exponential back-off and sends again
    whatever was not acknowledged (not answered, if samples are not stored); sending an item twice is harmless.
    Where the server has several nodes, it goes on at the one that has the camera, and returns to the given address when
    that one cannot be reached. Leaving the `with` block waits until everything is acknowledged. Answers are messages of
    `sightfix.v1`.
    """

    def __init__(self, settings: Settings, options: StreamOptions) -> None:
        self._settings = settings
        self._options = options
        self._buffer: ResendBuffer[messages.StreamItem] = ResendBuffer(must_acknowledge=options.store_samples)
        # Guards everything below, and is notified of every change of it.
        self._changed = Condition()
        self._answers: deque[Answer] = deque()
        self._failure: SightfixError | None = None
        self._is_open = False
        self._is_closing = False
        self._is_finished = False
        self._reconnect_requested = False
        self._stream_number = 0
        self._lost_on_stream = 0
        self._failures = 0
        self._runner: Task | None = None
        self._call: Any = None
        self.reconnects = 0
        """How often the stream was opened again."""
        self.dropped_answers = 0
        """Answers that were dropped here because nobody read them."""
        self.acknowledgement: Acknowledgement | None = None
        """The latest acknowledgement; its counts are those since the last reconnect."""
        self.camera_moved: values.CameraMoved | None = None
        """Set when the server finds that the camera's pose has changed."""

    async def __aenter__(self) -> Self:
        self._runner = Task(self._run)
        try:
            async with self._changed:
                await self._changed.wait_for(lambda: self._is_open or self._is_finished)
        except BaseException:
            await self.abort()
            raise
        if self._failure is not None:
            raise self._failure
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            await self.close()
        else:
            await self.abort()

    def __aiter__(self) -> AsyncIterator[Answer]:
        return self

    async def __anext__(self) -> Answer:
        """The next answer; ends after `close` or `finish` when all items are done.

        Raises:
            ProblemError: The server refused the stream, or could not be reached again.
        """
        async with self._changed:
            await self._changed.wait_for(lambda: bool(self._answers) or self._is_finished)
            if self._answers:
                answer = self._answers.popleft()
                self._changed.notify_all()
                return answer
            if self._failure is not None:
                raise self._failure
        raise StopAsyncIteration

    @property
    def acknowledged_seq(self) -> int:
        """Every item up to this seq is stored, or can no longer become a sample."""
        return self._buffer.acknowledged_seq

    @property
    def lost_answers(self) -> int:
        """Answers that the server dropped because this client read too slowly."""
        return self._buffer.lost_answers

    async def send(self, item: StreamInput) -> int:
        """Takes an item and returns its seq; waits while the buffer is full.

        Raises:
            ValueError: The item's time has no UTC offset.
            StreamClosedError: The stream was closed.
            ProblemError: The server refused the stream, or could not be reached again.
        """
        message = to_message(item)
        async with self._changed:
            await self._changed.wait_for(lambda: self._is_finished or self._is_closing or self._has_room())
            if self._failure is not None:
                raise self._failure
            if self._is_finished or self._is_closing:
                raise StreamClosedError("the stream is closed")
            seq = self._buffer.push(message)
            self._changed.notify_all()
            return seq

    async def answers_to(
        self, items: Iterable[StreamInput] | AsyncIterable[StreamInput]
    ) -> AsyncGenerator[Answer, None]:
        """Opens the stream, sends the items and yields the answers, until all are done."""
        failures: list[Exception] = []

        async def feed() -> None:
            try:
                async for item in iterate(items):
                    await self.send(item)
            except SightfixError:
                return  # the stream has ended; the iteration over the answers raises why
            except Exception as error:
                failures.append(error)
            finally:
                await self.finish()

        async with self:
            feeder = Task(feed)
            try:
                async for answer in self:
                    yield answer
            finally:
                feeder.cancel()
        if failures:
            raise failures[0]

    async def finish(self) -> None:
        """Takes no more items; the answers to come can still be read."""
        async with self._changed:
            self._is_closing = True
            self._changed.notify_all()

    async def close(self) -> None:
        """Waits until all items are done.

        Raises:
            ProblemError: They cannot be: the server refused the stream, or could not be reached again.
        """
        await self.finish()
        if self._runner is not None:
            await self._runner.join()
        if self._failure is not None:
            raise self._failure

    async def abort(self) -> None:
        """Ends the stream at once, whatever is not done."""
        async with self._changed:
            self._end(None)
            call = self._call
        if call is not None:
            call.cancel()
        if self._runner is not None:
            await self._runner.join()

    def _has_room(self) -> bool:
        unread = len(self._answers) if self._options.keeps_all_answers else 0
        return len(self._buffer) + unread < self._options.buffer_items

    def _end(self, failure: SightfixError | None) -> None:
        if not self._is_finished:
            self._is_finished, self._failure = True, failure
        self._changed.notify_all()

    async def _run(self) -> None:
        """Opens streams until all items are done or no attempt is left."""
        channels: dict[str, grpc.aio.Channel] = {}
        server = self._settings.server
        try:
            while not self._is_finished:
                if server not in channels:
                    channels[server] = open_channel(self._settings, server)
                ended = await self._run_stream(FusionServiceStub(channels[server]))
                await self._continue_after(ended)
                server = self._settings.node_of(ended)
        except Exception as error:
            async with self._changed:
                failure = SightfixError(f"the stream failed: {error!r}")
                failure.__cause__ = error
                self._end(failure)
        finally:
            for channel in channels.values():
                await channel.close()

    async def _continue_after(self, failure: ProblemError | None) -> None:
        """Decides after the end of a stream whether another one is to be opened, and waits until then."""
        async with self._changed:
            self._buffer.rewind()
            if failure is None and self._is_closing and len(self._buffer) == 0:
                self._end(None)
            if self._is_finished:
                return
            self.reconnects += 1
            if self._reconnect_requested:
                return
            self._failures += 1
            retry = self._options.retry if self._is_open else self._settings.retry
            if self._failures >= retry.attempts:
                self._end(failure or closed_early())
                return
            delay_s = retry.delay_s(self._failures)
            await wait_at_most(self._changed, lambda: self._is_finished, delay_s)
            # A silent stream is closed by the server: the next one is opened when there is something to send.
            await self._changed.wait_for(
                lambda: not self._is_open or self._is_finished or self._is_closing or len(self._buffer) > 0
            )

    async def _run_stream(self, stub: FusionServiceAsyncStub) -> ProblemError | None:
        """Runs one stream to its end; returns the error of one that may go well when it is opened again."""
        async with self._changed:
            self._reconnect_requested = False
            self._lost_on_stream = 0
            number = self._stream_number
            # A balancer may choose the node by the camera.
            metadata = (*self._settings.headers().items(), ("sightfix-camera", self._options.camera_id))
            call = self._call = stub.Stream(self._requests(number), metadata=metadata)
        failure = None
        try:
            async for response in call:
                async with self._changed:
                    self._receive(response)
                    self._changed.notify_all()
        except grpc.RpcError as error:
            ended = stream_failure(error)
            if not ended.is_retryable:
                async with self._changed:
                    self._end(ended.error)
            failure = ended.error
        finally:
            async with self._changed:
                self._stream_number += 1
                self._changed.notify_all()
        return failure

    async def _requests(self, number: int) -> AsyncIterator[messages.StreamRequest]:
        """The messages of the stream of that number, until there is nothing more to send on it."""
        yield self._opening()
        while True:
            async with self._changed:
                await self._changed.wait_for(lambda: self._may_send() or self._must_half_close(number))
                if self._must_half_close(number):
                    return
                seq, item = self._buffer.take_next()
            request = messages.StreamRequest(item=item)
            request.item.seq = seq
            yield request

    def _opening(self) -> messages.StreamRequest:
        options = self._options
        opening = messages.StreamOpening(
            camera_id=options.camera_id,
            client_name=options.client_name,
            resume_after_seq=self._buffer.resume_after_seq,
            store_samples=options.store_samples,
            durability=durability_value(options.durability),
        )
        return messages.StreamRequest(opening=opening)

    def _may_send(self) -> bool:
        return self._buffer.has_next() and self._buffer.awaited < self._options.in_flight

    def _must_half_close(self, number: int) -> bool:
        is_over = self._is_finished or self._reconnect_requested or number != self._stream_number
        return is_over or (self._is_closing and not self._buffer.has_next())

    def _receive(self, response: messages.StreamResponse) -> None:
        match response.WhichOneof("kind"):
            case "opened":
                self._is_open = True
            case "answer":
                self._receive_answer(response.answer)
            case "acknowledgement":
                self.acknowledgement = response.acknowledgement
                if self._buffer.acknowledge(response.acknowledgement.seq):
                    self._failures = 0
            case "camera_moved":
                self.camera_moved = response.camera_moved
            case "reconnect":
                self._reconnect_requested = True

    def _receive_answer(self, answer: Answer) -> None:
        lost = answer.lost_answers - self._lost_on_stream
        if lost > 0:
            self._lost_on_stream = answer.lost_answers
            self._buffer.drop_answers(lost, answer.seq)
        if not self._buffer.answer(answer.seq):
            return
        self._failures = 0
        self._answers.append(answer)
        if not self._options.keeps_all_answers and len(self._answers) > self._options.buffer_items:
            self._answers.popleft()
            self.dropped_answers += 1
