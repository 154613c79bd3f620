"""Clients, each a process of its own: one does one kind of thing, over and over, until it is told to end."""

import contextlib
import http.client
import itertools
import json
import threading
import time
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from multiprocessing.synchronize import Event
from typing import Any
from urllib.parse import urlsplit

from .api import Api
from .client import BOX, FIX, Client, Setting, at
from .streams import stream_samples

JSON = "application/json"
ROWS_PER_BATCH = 3
#: Model versions of the camera whose active version changes.
VERSIONS = 6
#: Uses of a key before and after it is revoked.
KEY_USES = 12
#: Silence after which a reader of events opens a new stream, s.
EVENT_SILENCE_S = 4.0
#: Marks a request that came from another node: this one answers it itself.
SENT_ON = {"x-sightfix-forwarded": "1"}


def import_samples(client: Client) -> None:
    """Imports batches, each until it is acknowledged, every other one under an idempotency key."""
    camera = client.setting.client
    for batch in client.steps(0.06):
        rows = "".join(
            f"{at(10 * batch + row)},{camera},{batch},11,28,77,103.98678,30.628\n" for row in range(ROWS_PER_BATCH)
        )
        headers = {"content-type": "text/csv"} | ({"idempotency-key": f"{camera}-{batch}"} if batch % 2 else {})
        body = f"time,target_id,left,top,width,height,longitude,latitude\n{rows}".encode()
        for _ in client.steps(0.05):
            done = client.api.send(
                "import", camera, "POST", f"/v1/cameras/{camera}/samples", body,
                arguments={"batch": batch}, headers=headers,
                keep=lambda answer, _: {name: answer[name] for name in ("accepted", "duplicate", "rejected")},
            )  # fmt: skip
            if done.is_done:
                break


def profile_of(answer: Any, headers: dict[str, str]) -> Any:
    """What the register of a profile holds."""
    return {"etag": headers.get("etag"), "name": answer["display_name"]}


def change_profile(client: Client) -> None:
    """Reads a profile, and changes it from the revision that was read, which may not be the latest any more."""
    etag = None
    for step in client.steps(0.06):
        if etag is None or client.chance.random() < 0.5:
            read = client.api.send("read-profile", "profile", "GET", "/v1/cameras/profile", keep=profile_of)
            if read.is_done:
                etag = read.answer["etag"]
            continue
        name = f"{client.setting.client} {step}"
        changed = client.api.send(
            "change-profile", "profile", "PATCH", "/v1/cameras/profile", {"display_name": name},
            arguments={"expected": etag, "name": name}, headers={"if-match": etag}, keep=profile_of,
        )  # fmt: skip
        etag = changed.answer["etag"] if changed.is_done else None


def activate_models(client: Client) -> None:
    """Activates versions of a model, asks which one is active, and fuses by it."""
    path = "/v1/cameras/active"
    observation = {"observations": [{"time": at(0), "bounding_box": BOX}]}
    for _ in client.steps(0.06):
        choice = client.chance.random()
        if choice < 0.3:
            body = {"number": client.chance.randint(1, VERSIONS)}
            client.api.send("activate", "active", "PUT", f"{path}/active-model", body, arguments=body)
        elif choice < 0.6:
            client.api.send(
                "read-active", "active", "GET", f"{path}/active-model", keep=lambda answer, _: answer["number"]
            )
        else:
            client.api.send("fuse", "active", "POST", f"{path}/fusions", observation,
                            keep=lambda answer, _: answer["items"][0]["model_version"])  # fmt: skip


def change_keys(client: Client) -> None:
    """Creates a key, uses it, revokes it, and uses it again."""
    for step in client.steps(0.05):
        created = client.api.send(
            "create-key", f"{client.setting.client} {step}", "POST", "/v1/keys",
            {"name": f"{client.setting.client} {step}", "role": "viewer"},
            keep=lambda answer, _: {"id": answer["id"], "secret": answer["secret"]},
        )  # fmt: skip
        if not created.is_done:
            continue
        key = created.answer
        _use_key(client, key)
        for _ in client.steps(0.1):
            if client.api.send("revoke-key", key["id"], "DELETE", f"/v1/keys/{key['id']}").is_done:
                break
        _use_key(client, key)


def _use_key(client: Client, key: dict[str, str]) -> None:
    for _ in itertools.islice(client.steps(0.4), KEY_USES):
        client.api.send("use-key", key["id"], "GET", "/v1/session", key=key["secret"])


def runs_of(answer: Any, _headers: dict[str, str]) -> Any:
    """What the checks need of training runs, newest first."""
    return [[run["id"], run["state"], run["attempt"], run.get("model_version"), run["seed"]] for run in answer["items"]]


def train(client: Client) -> None:
    """Starts training runs, each under an idempotency key until it is acknowledged, and watches them."""
    path, number, is_acknowledged = "/v1/cameras/runs/training-runs", 1, True
    for _ in client.steps(0.25):
        if not is_acknowledged or client.chance.random() < 0.4:
            wish = {"seed": number, "epochs": client.setting.epochs, "recipe": "projective"}
            started = client.api.send(
                "start-run", "runs", "POST", path, wish, arguments={"seed": number},
                headers={"idempotency-key": f"run-{number}"}, keep=lambda answer, _: {"id": answer["id"]},
            )  # fmt: skip
            # Refused as long as another one is live, under an idempotency key too.
            is_acknowledged = started.is_done or started.is_refused
            # What was acknowledged is sent again now and then, and must give the same run.
            number += 1 if is_acknowledged and client.chance.random() < 0.8 else 0
        client.api.send("list-runs", "runs", "GET", f"{path}?limit=20", keep=runs_of)


def observation_of(number: int, targets: int) -> dict[str, Any]:
    """The observation of a number; no other one has its target and time."""
    return {"time": at(number * 0.1), "target_id": f"target-{number % targets}", "fix": FIX}


def follow_targets(client: Client) -> None:
    """Sends observations one by one, none again: those of unknown outcome may have been taken or not."""
    for number in client.steps(0.06):
        observation = observation_of(number, 3)
        client.api.send("follow", "yard", "POST", "/v1/cameras/yard/tracks", {"observations": [observation]},
                        arguments={"number": number, "time": observation["time"]})  # fmt: skip


def publish(client: Client) -> None:
    """Sends observations of a camera with a sink, each until it is acknowledged."""
    for number in client.steps(0.08):
        observation = observation_of(number, 5)
        for _ in client.steps(0.05):
            done = client.api.send(
                "publish", "gate", "POST", "/v1/cameras/gate/tracks", {"observations": [observation]},
                arguments={"time": observation["time"]},
            )  # fmt: skip
            if done.is_done:
                break


def probe_owners(client: Client) -> None:
    """Sends a target of its own to one node after the other, and asks that node which targets it follows.

    Only the owner of the camera answers, for the probes are marked as sent on. What it follows tells since when it is
    the owner, for a new owner begins anew.
    """
    for number in client.steps(0.05):
        node = client.chance.choice(client.setting.ways.node_urls)
        target = f"{client.setting.client}-{number}"
        observation = {"time": at(number), "target_id": target, "fix": FIX}
        arguments = {"node": node, "target": target}
        client.api.send("probe", "owned", "POST", "/v1/cameras/owned/tracks", {"observations": [observation]},
                        arguments=arguments, headers=SENT_ON, follow=False, base=node)  # fmt: skip
        client.api.send("probe-read", "owned", "GET", "/v1/cameras/owned/tracks", arguments={"node": node},
                        headers=SENT_ON, follow=False, base=node, keep=_targets)  # fmt: skip


def _targets(answer: Any, _headers: dict[str, str]) -> Any:
    return sorted(feature["properties"]["target_id"] for feature in answer["features"])


def watch_events(client: Client) -> None:
    """Reads the events of a camera, and comes back with the id of the last one whenever the stream ends."""
    last: str | None = None
    for _ in client.steps(0.05):
        with contextlib.suppress(OSError, http.client.HTTPException):
            for event in _events(client, last):
                last = event["id"] or last
                if client.is_ending:
                    return


def _events(client: Client, last: str | None) -> Iterator[dict[str, Any]]:
    """The events of one stream."""
    url = client.setting.ways.url + "/v1/cameras/yard/events"
    for _ in range(4):
        parts = urlsplit(url)
        connection = http.client.HTTPConnection(parts.hostname or "", parts.port, timeout=EVENT_SILENCE_S)
        with contextlib.closing(connection):
            headers = {"authorization": f"Bearer {client.setting.key}"} | ({"last-event-id": last} if last else {})
            connection.request("GET", parts.path, headers=headers)
            response = connection.getresponse()
            if response.status == 307:
                url = response.getheader("location") or url
                continue
            if response.status == 200:
                client.recorder.note("watch", "yard", {"after": last})
                yield from _noted_events(client, response)
        return


def _noted_events(client: Client, response: http.client.HTTPResponse) -> Iterator[dict[str, Any]]:
    fields: dict[str, str] = {}
    while line := response.readline():
        text = line.decode().rstrip("\n")
        if text:
            name, _, value = text.partition(": ")
            fields[name] = value
            continue
        if "event" in fields:
            data = json.loads(fields.get("data", "null"))
            is_track = fields["event"] == "track"
            event = {
                "id": fields.get("id"),
                "name": fields["event"],
                "time": data["properties"]["time"] if is_track else None,
            }
            client.recorder.note("event", "yard", event)
            yield event
        fields = {}


def receive_hooks(client: Client) -> None:
    """Receives webhooks; takes most, refuses some for now, and leaves some unanswered although it has taken them."""
    lock = threading.Lock()

    class Handler(BaseHTTPRequestHandler):
        """Answers deliveries."""

        protocol_version = "HTTP/1.1"

        def handle(self) -> None:
            with contextlib.suppress(ConnectionError):
                super().handle()

        def do_POST(self) -> None:
            body = json.loads(self.rfile.read(int(self.headers["content-length"])))
            with lock:
                choice = client.chance.random()
            answered = 200 if choice < 0.94 else 503 if choice < 0.97 else None
            noted = {"id": self.headers["webhook-id"], "time": body["time"], "answered": answered}
            client.recorder.note("delivery", "gate", noted)
            if answered is None:
                self.close_connection = True
                return
            self.send_response(answered)
            self.send_header("content-length", "0")
            self.end_headers()

        def log_message(self, *_: Any) -> None:
            """Logs nothing."""

    server = ThreadingHTTPServer(("127.0.0.1", client.setting.hook_port), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    for _ in client.steps(0.2):
        pass
    server.shutdown()


#: Names of the clients that store samples, each of a camera of its own, begin so.
STORING = ("samples-", "streams-")
KINDS: dict[str, Callable[[Client], None]] = {
    "samples": import_samples, "profile": change_profile, "active": activate_models, "keys": change_keys,
    "runs": train, "yard": follow_targets, "gate": publish, "owned": probe_owners, "events": watch_events,
    "streams": stream_samples, "hooks": receive_hooks,
}  # fmt: skip
#: How many clients of a kind there are, where it is not one.
CLIENTS = {"samples": 2, "streams": 2, "profile": 3, "active": 3, "keys": 2, "owned": 2}


def names() -> list[str]:
    """Names of all clients: their kinds, with numbers."""
    return [f"{kind}-{number}" for kind in KINDS for number in range(1, CLIENTS.get(kind, 1) + 1)]


def run(setting: Setting, ending: Event) -> None:
    """Runs a client until it is to end."""
    with contextlib.suppress(KeyboardInterrupt):
        KINDS[setting.client.rpartition("-")[0]](Client(setting, ending))


def prepare(api: Api, model: bytes, samples: bytes, hook_port: int) -> None:
    """Stores what the clients need: cameras, model versions, samples to train on, a sink.

    Raises:
        RuntimeError: The server refuses something.
    """

    def must(action: str, subject: str, method: str, path: str, body: Any, content_type: str = JSON) -> None:
        arguments = body if isinstance(body, dict) else {}
        done = api.send(
            action, subject, method, path, body, arguments=arguments, headers={"content-type": content_type}
        )
        if not done.is_done:
            raise RuntimeError(f"{method} {path}: {done.status} {done.answer}")

    cameras = [name for name in names() if name.startswith(STORING)]
    for camera in [*cameras, "profile", "active", "runs", "yard", "gate", "owned"]:
        must("create-camera", camera, "POST", "/v1/cameras", {"id": camera})
    for _ in range(VERSIONS):
        must("import-model", "active", "POST", "/v1/cameras/active/models", model, "application/octet-stream")
    must("activate", "active", "PUT", "/v1/cameras/active/active-model", {"number": 1})
    must("import-rows", "runs", "POST", "/v1/cameras/runs/samples", samples, "text/csv")
    sink = {"address": f"http://127.0.0.1:{hook_port}/hook", "camera_ids": ["gate"], "min_interval_s": 0}
    must("create-connection", "hook", "POST", "/v1/connections", {"id": "hook", "sink": sink})
    api.send("read-profile", "profile", "GET", "/v1/cameras/profile", keep=profile_of)
    # Nodes look for new connections once a second, and queue nothing for a sink that they do not know.
    time.sleep(2.0)
