"""Requests and streams that meet a node of the server which does not have the camera's live state."""

from datetime import UTC, datetime
from typing import Any

import grpc
import httpx
import pytest
from google.rpc import error_details_pb2, status_pb2

from sightfix import Client, Observation, RetryPolicy, UnavailableError
from sightfix._settings import settings
from sightfix._stream_messages import stream_failure

QUICK = RetryPolicy(attempts=3, initial_delay_s=0.001, max_delay_s=0.01)
OBSERVATION = Observation(time=datetime(2026, 1, 1, tzinfo=UTC))
OTHER = "http://node-2:8080/v1/cameras/yard/tracks?store_samples=true&durability=synced"


class Nodes(httpx.BaseTransport):
    """The first node redirects; the second one answers, unless it is gone."""

    def __init__(self, *, location: str = OTHER, is_gone: bool = False) -> None:
        self.location = location
        self.is_gone = is_gone
        self.requests: list[tuple[str, str | None, bytes]] = []

    def handle_request(self, request: httpx.Request) -> httpx.Response:  # noqa: D102, as its base class
        self.requests.append((str(request.url), request.headers.get("authorization"), request.read()))
        if request.url.host == "node-2":
            if self.is_gone:
                raise httpx.ConnectError("refused")
            return httpx.Response(200, json={"items": []})
        body = {"type": "urn:sightfix:problem:camera-on-other-node", "title": "", "status": 307, "detail": ""}
        return httpx.Response(307, json=body, headers={"location": self.location})


def test_a_request_goes_to_the_node_that_answers_it() -> None:
    nodes = Nodes()
    with Client("http://node-1:8080", api_key="sf_key", retry=QUICK, transport=nodes) as client:
        client.tracks.follow_and_store("yard", [OBSERVATION])
    first, second = nodes.requests
    assert (first[0], second[0]) == (OTHER.replace("node-2", "node-1"), OTHER)
    assert first[1:] == second[1:]
    assert second[1] == "Bearer sf_key"


def test_a_node_that_is_gone_is_left_after_some_attempts() -> None:
    nodes = Nodes(is_gone=True)
    with (
        Client("http://node-1:8080", retry=QUICK, transport=nodes) as client,
        pytest.raises(Exception, match="refused"),
    ):
        client.tracks.follow_and_store("yard", [OBSERVATION])
    assert [httpx.URL(url).host for url, *_ in nodes.requests] == ["node-1", "node-2"] * QUICK.attempts


def test_a_redirection_never_costs_the_encryption() -> None:
    nodes = Nodes()
    with (
        Client("https://node-1:8443", retry=QUICK, transport=nodes) as client,
        pytest.raises(UnavailableError),
    ):
        client.tracks.follow_and_store("yard", [OBSERVATION])
    assert all(url.startswith("https://node-1") for url, *_ in nodes.requests)


class OwnerNamed(grpc.RpcError):
    """The end of a stream that met another node."""

    def code(self) -> grpc.StatusCode:  # noqa: D102
        return grpc.StatusCode.UNAVAILABLE

    def details(self) -> str:  # noqa: D102
        return "camera yard is live on the node at http://node-2:8080"

    def trailing_metadata(self) -> Any:  # noqa: D102
        status = status_pb2.Status(code=14)
        info = error_details_pb2.ErrorInfo(reason="camera-on-other-node", metadata={"owner": "http://node-2:8080"})
        status.details.add().Pack(info)
        return (("grpc-status-details-bin", status.SerializeToString()),)


def test_a_stream_goes_on_at_the_node_that_the_server_names() -> None:
    failure = stream_failure(OwnerNamed())
    assert failure.is_retryable
    for server, next_server in (
        ("http://node-1:8080", "http://node-2:8080"),
        ("https://node-1:8443", "https://node-1:8443"),
    ):
        used = settings(server, api_key=None, ca_file=None, certificate_files=None, timeout_s=1, retry=None)
        assert used.node_of(failure.error) == next_server
        assert used.node_of(None) == server
