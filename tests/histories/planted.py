"""Violations on purpose: a proxy between clients and servers that breaks one promise, for the checks to find.

Each check is tried by one plant at least; a check that finds nothing of its plant is blind.
"""

import contextlib
import dataclasses
import http.client
import json
import re
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import urlsplit

import grpc

from .api import exchange

EVERY = 7
#: Stands for the requests whose answers are streams of events.
STREAM = "GET events"
TIMEOUT_S = 30.0
#: Headers that belong to a connection.
OF_CONNECTION = ("connection", "transfer-encoding", "content-length", "date", "server")


@dataclasses.dataclass
class Request:
    """A request on its way to a server."""

    method: str
    path: str
    headers: dict[str, str]
    body: bytes | None


@dataclasses.dataclass
class Answer:
    """An answer on its way to a client."""

    status: int
    headers: dict[str, str]
    body: bytes

    @property
    def json(self) -> Any:
        """The body's value."""
        return json.loads(self.body)

    def with_json(self, value: Any) -> "Answer":
        """The same with another body."""
        return dataclasses.replace(self, body=json.dumps(value).encode())


Forward = Callable[[Request], Answer]


@dataclasses.dataclass
class Plant:
    """One kind of violation: which requests it touches, and what it does to them."""

    name: str
    #: The check that must find it.
    check: str
    method: str
    path: str
    #: Between clients and the balancer (for streams over gRPC one of its own), between a sink and its receiver, or as
    #: another address of a node.
    place: str
    break_it: "Callable[[Plant, Request, Forward], Answer]"
    #: It touches one in this number of the requests that it could touch.
    every: int = EVERY
    #: Answers of before, of plants that need them.
    kept: list[Answer] = dataclasses.field(default_factory=list)
    count: int = 0

    def pass_on(self, request: Request, forward: Forward) -> Answer | None:
        """The answer to a request that it may touch; none for the others."""
        if request.method != self.method or not re.search(self.path, request.path):
            return None
        self.count += 1
        if self.count % self.every == 0:
            return self.break_it(self, request, forward)
        answer = forward(request)
        if answer.status == 200:
            self.kept.append(answer)
        return answer


def _import_nothing(_plant: Plant, _request: Request, _forward: Forward) -> Answer:
    """Acknowledges an import that no server has seen."""
    counts = {"accepted": 3, "duplicate": 0, "rejected": 0}
    return Answer(200, {"content-type": "application/json"}, json.dumps(counts).encode())


def _answer_of_before(plant: Plant, request: Request, forward: Forward) -> Answer:
    """Answers as it was some requests ago."""
    return plant.kept[-plant.every // 2] if len(plant.kept) > plant.every else forward(request)


def _change_any_revision(_plant: Plant, request: Request, forward: Forward) -> Answer:
    """Makes a change whatever revision it was based on."""
    return forward(dataclasses.replace(request, headers=request.headers | {"if-match": "*"}))


def _unknown_version(_plant: Plant, request: Request, forward: Forward) -> Answer:
    """Says that a version answered which never existed here."""
    answer = forward(request)
    return answer.with_json({"items": [{"model_version": 99}]}) if answer.status == 200 else answer


def _fail_in_between(_plant: Plant, request: Request, forward: Forward) -> Answer:
    """Says that a run has failed which goes on or has succeeded."""
    answer = forward(request)
    if answer.status != 200:
        return answer
    page = answer.json
    for run in page["items"][-1:]:
        run["state"] = "failed"
    return answer.with_json(page)


def _claim_again(_plant: Plant, request: Request, forward: Forward) -> Answer:
    """Says that another worker has claimed the latest run."""
    answer = forward(request)
    if answer.status != 200:
        return answer
    page = answer.json
    for run in page["items"][:1]:
        run["attempt"] += 1
    return answer.with_json(page)


def _drop_an_entry(_plant: Plant, request: Request, forward: Forward) -> Answer:
    """Leaves a change out of the audit log."""
    answer = forward(request)
    page = answer.json
    page["items"] = [entry for entry in page["items"] if entry["action"] != "model-activated"]
    return answer.with_json(page)


def _deliver_nothing(_plant: Plant, _request: Request, _forward: Forward) -> Answer:
    """Takes a webhook that no receiver has seen."""
    return Answer(200, {}, b"")


def _deliver_again(_plant: Plant, request: Request, forward: Forward) -> Answer:
    """Delivers a webhook a second time under another id."""
    headers = {name.lower(): value for name, value in request.headers.items()}
    forward(dataclasses.replace(request, headers=headers | {"webhook-id": "another"}))
    return forward(request)


def _take_any_key(_plant: Plant, request: Request, forward: Forward) -> Answer:
    """Takes a key that the server refuses."""
    answer = forward(request)
    return answer if answer.status != 401 else dataclasses.replace(answer, status=200)


def _pass_on(_plant: Plant, request: Request, forward: Forward) -> Answer:
    return forward(request)


def _another_version(_plant: Plant, request: Request, forward: Forward) -> Answer:
    """Says that another version is active."""
    answer = forward(request)
    return answer.with_json(answer.json | {"number": 99})


def plants() -> list[Plant]:
    """All kinds of violations."""
    runs, audit, ended = r"/training-runs\?limit=20$", "^/v1/audit", "processes_end_as_they_should"
    delivered, owner = "positions_are_delivered_under_stable_ids", "a_camera_has_one_owner"
    active, clients = "/cameras/active/active-model$", "clients"
    return [
        Plant(
            "lost-sample", "samples_are_stored_exactly_once", "POST", "/samples-1/samples$", clients, _import_nothing
        ),
        Plant("lost-item", "streamed_samples_are_stored_exactly_once", "", "^$", "streams", _pass_on),
        Plant("stale-profile", "profiles_are_linearizable", "GET", "/cameras/profile$", clients, _answer_of_before),
        Plant("lost-update", "profiles_are_linearizable", "PATCH", "/cameras/profile$", clients, _change_any_revision),
        Plant("stale-model", "active_models_are_linearizable", "GET", active, clients, _answer_of_before),
        Plant("unknown-model", "fusions_use_a_recent_model", "POST", "/fusions$", clients, _unknown_version),
        Plant(
            "revived-key", "keys_work_from_creation_to_revocation", "GET", "^/v1/session$", clients, _take_any_key, 1
        ),
        Plant("ended-twice", "runs_end_once", "GET", runs, clients, _fail_in_between),
        Plant("stolen-run", "live_runs_are_not_taken_over", "GET", runs, clients, _claim_again),
        Plant("hidden-change", "the_audit_log_has_exactly_the_changes", "GET", audit, clients, _drop_an_entry, 1),
        Plant("lost-event", "events_are_complete_or_marked_lost", STREAM, "/events$", clients, _pass_on),
        Plant("lost-delivery", delivered, "POST", "^/hook$", "hook", _deliver_nothing),
        Plant("renamed-delivery", delivered, "POST", "^/hook$", "hook", _deliver_again),
        Plant("second-owner", owner, "POST", "/owned/tracks$", "node", _pass_on),
        Plant("diverging-node", "all_nodes_agree_at_the_end", "GET", active, "node", _another_version, 1),
        Plant("killed-process", ended, "", "^$", "process", _pass_on),
    ]


def in_groups(planted: list[Plant]) -> list[list[Plant]]:
    """Plants in as few groups as it takes to have one for each check and each request in a group."""
    groups: list[list[Plant]] = []
    for plant in planted:
        for group in groups:
            if not any(
                plant.check == other.check
                or (plant.method, plant.path, plant.place) == (other.method, other.path, other.place)
                for other in group
            ):
                group.append(plant)
                break
        else:
            groups.append([plant])
    return groups


class Proxy:
    """Passes requests on to another address, through plants."""

    def __init__(self, target: str, planted: list[Plant]) -> None:
        self._target = target
        self._plants = planted
        proxy = self

        class Handler(BaseHTTPRequestHandler):
            """Hands requests to the proxy."""

            protocol_version = "HTTP/1.1"

            def handle(self) -> None:
                with contextlib.suppress(ConnectionError):
                    super().handle()

            def _handle(self) -> None:
                proxy.handle(self)

            do_GET = do_POST = do_PUT = do_PATCH = do_DELETE = _handle  # noqa: N815

            def log_message(self, *_: Any) -> None:
                """Logs nothing."""

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    @property
    def port(self) -> int:
        """Where it listens."""
        return int(self._server.server_address[1])

    @property
    def url(self) -> str:
        """Its address."""
        return f"http://127.0.0.1:{self.port}"

    def handle(self, client: BaseHTTPRequestHandler) -> None:
        """Answers one request; breaks the connection where the server does."""
        client.close_connection = True
        length = client.headers.get("content-length")
        headers = {name: value for name, value in client.headers.items() if name.lower() not in OF_CONNECTION}
        request = Request(client.command, client.path, headers, client.rfile.read(int(length)) if length else None)
        with contextlib.suppress(OSError, http.client.HTTPException):
            if request.path.endswith("/events"):
                self._stream(client, request)
            else:
                self._answer(client, request)

    def _answer(self, client: BaseHTTPRequestHandler, request: Request) -> None:
        answers = (plant.pass_on(request, self._forward) for plant in self._plants)
        answer = next((one for one in answers if one is not None), None) or self._forward(request)
        client.send_response(answer.status)
        for name, value in answer.headers.items():
            if name not in OF_CONNECTION:
                client.send_header(name, value)
        client.send_header("content-length", str(len(answer.body)))
        client.end_headers()
        client.wfile.write(answer.body)

    def _forward(self, request: Request) -> Answer:
        return Answer(*exchange(request.method, self._target + request.path, request.body, request.headers, TIMEOUT_S))

    def _stream(self, client: BaseHTTPRequestHandler, request: Request) -> None:
        """Passes events on, where a plant says so without some of them."""
        drops = any(plant.method == STREAM for plant in self._plants)
        connection = http.client.HTTPConnection(self._target.removeprefix("http://"), timeout=TIMEOUT_S)
        with contextlib.closing(connection):
            connection.request("GET", request.path, headers=request.headers)
            response = connection.getresponse()
            client.send_response(response.status)
            client.end_headers()
            event, count = b"", 0
            while line := response.readline():
                event += line
                if line == b"\n":
                    count += 1
                    if not drops or count % EVERY:
                        client.wfile.write(event)
                    event = b""


class StreamProxy:
    """Passes streams over gRPC on to another address, without some of their items: the next ones are acknowledged."""

    def __init__(self, target: str) -> None:
        self._channel = grpc.insecure_channel(urlsplit(target).netloc)
        self._server = grpc.server(ThreadPoolExecutor())
        handlers: dict[str, Any] = {"Stream": grpc.stream_stream_rpc_method_handler(self._stream)}
        service = grpc.method_handlers_generic_handler("sightfix.v1.FusionService", handlers)
        self._server.add_generic_rpc_handlers([service])
        self.url = f"http://127.0.0.1:{self._server.add_insecure_port('127.0.0.1:0')}"
        self._server.start()

    def _stream(self, requests: Iterator[bytes], context: grpc.ServicerContext) -> Iterator[bytes]:
        # The first message opens the stream.
        kept = (request for number, request in enumerate(requests, 1) if number % EVERY)
        forward: Any = self._channel.stream_stream("/sightfix.v1.FusionService/Stream")
        yield from forward(kept, metadata=context.invocation_metadata())
