"""Streams of samples over gRPC: each item is sent again, on another stream, until it is acknowledged."""

import functools
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any
from urllib.parse import urlsplit

import grpc

from .client import BOX, FIX, Client, at
from .record import Operation

PROTO = Path(__file__).resolve().parents[2] / "proto"
#: Each stream has a connection of its own, so that the balancer chooses a node again.
OPTIONS = [("grpc.use_local_subchannel_pool", 1)]
#: After so long a stream is closed in order, and a silent one is given up, s.
OPEN_S = (1.0, 8.0)
SILENCE_S = 2.0
#: No stream lasts longer, s.
LONGEST_S = 20.0
PACE_S = 0.04
#: Items sent and not acknowledged.
MOST_IN_FLIGHT = 64
#: A sample comes in two items, a box and a fix, from every other client.
PARTS = 2


@functools.cache
def interface() -> tuple[ModuleType, ModuleType]:
    """Messages and stubs of the streams, made from the description of the interface (needs grpcio-tools)."""
    sys.path.append(str(PROTO))
    return grpc.protos_and_services("sightfix/v1/fusion_service.proto")


def stream_samples(client: Client) -> None:
    """Streams samples until the client is to end."""
    stream = SampleStream(client)
    for _ in client.steps(0.1):
        stream.open_once()
    stream.give_up()


class SampleStream:
    """The items of one client, numbered from 1, on one stream after the other."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self._camera = client.setting.client
        self._parts = 1 if self._camera.endswith("1") else PARTS
        self._acknowledged = 0
        #: When an item that is not acknowledged was sent for the first time, ns.
        self._sent_ns: dict[int, int] = {}
        self._stream = 0
        self._resumed_after = 0
        self._call: Any = None
        self._heard_s = 0.0
        self._ends_s = 0.0

    def open_once(self) -> None:
        """Streams until the stream ends, in order or not."""
        messages, services = interface()
        self._stream += 1
        self._resumed_after = self._acknowledged
        self._heard_s = time.monotonic()
        self._ends_s = self._heard_s + self._client.chance.uniform(*OPEN_S)
        setting, code, detail = self._client.setting, "OK", ""
        with grpc.insecure_channel(urlsplit(setting.ways.stream_url).netloc, options=OPTIONS) as channel:
            requests = self._requests(messages, self._stream)
            metadata = [("authorization", f"Bearer {setting.key}")]
            self._call = services.FusionServiceStub(channel).Stream(requests, metadata=metadata, timeout=LONGEST_S)
            try:
                for response in self._call:
                    self._receive(messages, response)
            except grpc.RpcError:
                code, detail = self._call.code().name, self._call.details()
        ended = {"stream": self._stream, "code": code, "detail": detail}
        self._client.recorder.note("stream-end", self._camera, ended)

    def give_up(self) -> None:
        """Records the items that nobody has acknowledged."""
        for seq in sorted(self._sent_ns):
            self._record(seq, None)

    def _requests(self, messages: ModuleType, stream: int) -> Iterator[Any]:
        """What is sent on one stream; grpc asks for it on a thread of its own."""
        seq = self._acknowledged
        opening = {"camera_id": self._camera, "client_name": self._camera, "resume_after_seq": seq,
                   "store_samples": True}  # fmt: skip
        yield messages.StreamRequest(opening=opening)
        # A half without the other one would be settled at an end in order.
        while stream == self._stream and not (seq % self._parts == 0 and self._is_to_end()):
            if time.monotonic() - self._heard_s > SILENCE_S:
                self._call.cancel()
                return
            if seq - self._acknowledged < MOST_IN_FLIGHT:
                seq += 1
                self._sent_ns.setdefault(seq, time.monotonic_ns())
                yield messages.StreamRequest(item=self._item(messages, seq))
            time.sleep(PACE_S)

    def _is_to_end(self) -> bool:
        return self._client.is_ending or time.monotonic() > self._ends_s

    def _instant(self, seq: int) -> int:
        return (seq + self._parts - 1) // self._parts

    def _item(self, messages: ModuleType, seq: int) -> Any:
        """A sample, or in turn its box and its fix."""
        item = messages.StreamItem(seq=seq, target_id=self._camera)
        item.time.FromJsonString(at(self._instant(seq)))
        if self._parts == 1 or seq % PARTS == 1:
            box = item.bounding_box
            box.left_px, box.top_px = self._instant(seq), BOX["top_px"]
            box.width_px, box.height_px = BOX["width_px"], BOX["height_px"]
        if self._parts == 1 or seq % PARTS == 0:
            item.fix.longitude_deg, item.fix.latitude_deg = FIX["longitude_deg"], FIX["latitude_deg"]
            item.fix.sigma_m = FIX["sigma_m"]
        return item

    def _receive(self, messages: ModuleType, response: Any) -> None:
        self._heard_s = time.monotonic()
        if response.HasField("reconnect"):
            self._ends_s = 0.0
        if not response.HasField("acknowledgement"):
            return
        upto = response.acknowledgement
        name_of = messages.NotStored.Reason.Name
        self._client.recorder.note(
            "acknowledgement", self._camera,
            {"stream": self._stream, "after": self._resumed_after, "seq": upto.seq, "stored": upto.stored,
             "not_stored": {name_of(one.reason): one.count for one in upto.not_stored}},
        )  # fmt: skip
        for seq in range(self._acknowledged + 1, upto.seq + 1):
            self._record(seq, 200)
        self._acknowledged = max(self._acknowledged, upto.seq)

    def _record(self, seq: int, status: int | None) -> None:
        arguments = {"seq": seq, "sample": self._instant(seq), "stream": self._stream}
        called_ns = self._sent_ns.pop(seq, time.monotonic_ns())
        self._client.recorder.add(
            Operation(self._client.setting.client, "stream-item", self._camera, arguments, called_ns,
                      time.monotonic_ns(), status, None)
        )  # fmt: skip
