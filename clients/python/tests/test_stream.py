"""Live streams over gRPC."""

import asyncio
import threading
from collections.abc import AsyncIterator, Iterator
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import pandas as pd
import pytest

from sightfix import (
    AsyncClient,
    Client,
    ImageSize,
    LiveItem,
    NotFoundError,
    RetryPolicy,
    StreamClosedError,
    UnauthenticatedError,
    UnavailableError,
    live_items,
)
from tests.conftest import ServerProcess, admin_key


@pytest.fixture
def items(recording: tuple[Path, Path]) -> list[LiveItem]:
    return list(live_items(pd.read_csv(recording[0])))


@pytest.fixture
def square(client: Client) -> Client:
    client.cameras.create(id="square", image_size=ImageSize(width_px=1280, height_px=720))
    return client


def test_items_are_answered_in_their_order(trained: ServerProcess, items: list[LiveItem]) -> None:
    with Client(trained.url) as client:
        answers = list(client.stream_items("square", items, in_flight=16, buffer_items=32))
    assert [answer.seq for answer in answers] == list(range(1, 241))
    assert all(answer.HasField("fused") and answer.HasField("track") for answer in answers)


def test_a_box_with_only_a_tracker_number_has_a_track_of_its_own(trained: ServerProcess, items: list[LiveItem]) -> None:
    anonymous = replace(items[0], target_id=None, tracker_id="17", fix=None)
    with Client(trained.url) as client:
        (answer,) = client.stream_items("square", [anonymous])
    assert answer.track.target_id == "tracker:17"
    assert not answer.HasField("receiver_match")


def test_everything_acknowledged_is_stored_once_though_the_server_is_killed(
    server: ServerProcess, square: Client, items: list[LiveItem]
) -> None:
    with square.stream("square", store_samples=True, in_flight=16, buffer_items=32) as stream:
        for number, item in enumerate(items):
            if number in (80, 160):
                assert stream.acknowledged_seq >= number - 32
                server.kill()
                server.start()
            stream.send(item)
    assert stream.reconnects >= 2
    assert stream.acknowledged_seq == len(items)
    stored = list(square.samples.list("square"))
    assert [(it.time, it.target_id, it.bounding_box) for it in stored] == [
        (it.time, it.target_id, it.bounding_box) for it in items
    ]


def test_the_asynchronous_stream_resumes_too(server: ServerProcess, square: Client, items: list[LiveItem]) -> None:
    async def source() -> AsyncIterator[LiveItem]:
        for number, item in enumerate(items):
            if number == 120:
                await asyncio.to_thread(server.kill)
                await asyncio.to_thread(server.start)
            yield item

    async def scenario() -> list[int]:
        async with AsyncClient(server.url) as client:
            return [it.seq async for it in client.stream_items("square", source(), store_samples=True, buffer_items=32)]

    assert sorted(asyncio.run(scenario())) == list(range(1, 241))
    assert square.samples.count("square").count == 240


def test_a_restart_in_order_loses_no_answer(server: ServerProcess, square: Client, items: list[LiveItem]) -> None:
    restarted = threading.Event()

    def restart() -> None:
        server.stop()
        server.start()
        restarted.set()

    with square.stream("square", keeps_all_answers=True) as stream:
        for item in items[:10]:
            stream.send(item)
        seqs = [next(stream).seq for _ in range(10)]
        threading.Thread(target=restart).start()
        assert restarted.wait(30)
        for item in items[10:20]:
            stream.send(item)
        seqs += [next(stream).seq for _ in range(10)]
    assert seqs == list(range(1, 21))
    assert stream.reconnects >= 1


def test_a_bad_item_is_answered_with_its_error(square: Client, items: list[LiveItem]) -> None:
    box = items[0].bounding_box
    assert box is not None
    bad = replace(items[1], bounding_box=replace(box, width_px=-1.0))
    first, second, third = square.stream_items("square", [items[0], bad, items[2]])
    assert (first.HasField("error"), third.HasField("error")) == (False, False)
    assert (second.error.reason, second.error.field) == ("invalid-argument", "bounding_box.width_px")
    with square.stream("square") as stream, pytest.raises(ValueError, match="UTC offset"):
        stream.send(LiveItem(time=datetime(2026, 1, 1)))


def test_a_refused_stream_raises_the_problem(square: Client, items: list[LiveItem]) -> None:
    with pytest.raises(NotFoundError) as not_found, square.stream("yard"):
        pass
    assert not_found.value.kind == "camera-not-found"
    stream = square.stream("square")
    with pytest.raises(NotFoundError, match="deleted"), stream:
        square.cameras.delete("square")
    with pytest.raises(NotFoundError):
        stream.send(items[0])


def test_a_closed_stream_takes_no_items(square: Client, items: list[LiveItem]) -> None:
    with square.stream("square") as stream:
        assert stream.send(items[0]) == 1
    with pytest.raises(StreamClosedError):
        stream.send(items[1])


def test_a_stream_presents_its_key(tmp_path: Path) -> None:
    secret = admin_key()
    server = ServerProcess(tmp_path, environment={"SIGHTFIX_ADMIN_KEY": secret})
    server.start()
    try:
        with Client(server.url, api_key=secret) as admin:
            admin.cameras.create(id="yard")
            with admin.stream("yard"):
                pass
        with pytest.raises(UnauthenticatedError), Client(server.url) as stranger, stranger.stream("yard"):
            pass
    finally:
        server.stop()


def test_a_server_that_is_not_there_is_reported() -> None:
    retry = RetryPolicy(attempts=2, initial_delay_s=0.01)
    with (
        pytest.raises(UnavailableError),
        Client("http://127.0.0.1:1", retry=retry) as client,
        client.stream("yard"),
    ):
        pass


def test_an_error_of_the_source_is_raised_after_the_answers(square: Client, items: list[LiveItem]) -> None:
    def source() -> Iterator[LiveItem]:
        yield items[0]
        raise OSError("the camera is gone")

    answers = square.stream_items("square", source())
    assert next(answers).seq == 1
    with pytest.raises(OSError, match="camera is gone"):
        next(answers)


def test_a_reader_that_stops_ends_the_stream(square: Client, items: list[LiveItem]) -> None:
    answers = square.stream_items("square", items, buffer_items=8)
    assert next(answers).seq == 1
    answers.close()

    async def scenario() -> None:
        async with AsyncClient(square._settings.server) as client:
            stream = client.stream_items("square", items, buffer_items=8)
            assert (await anext(stream)).seq == 1
            await stream.aclose()

    asyncio.run(scenario())


def test_answers_that_nobody_reads_are_dropped_and_counted(square: Client, items: list[LiveItem]) -> None:
    with square.stream("square", buffer_items=10) as stream:
        for item in items[:40]:
            stream.send(item)
    assert stream.dropped_answers == 30
    assert [answer.seq for answer in stream] == list(range(31, 41))
