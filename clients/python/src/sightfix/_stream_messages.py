"""Messages and errors of the gRPC stream."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import grpc
from google.rpc import error_details_pb2, status_pb2

from sightfix._errors import BY_GRPC_CODE, Problem, ProblemError, ServerFaultError, UnavailableError
from sightfix._items import LiveItem
from sightfix._json import format_time
from sightfix.models import Durability, Observation, Sample, Violation
from sightfix.v1 import fusion_service_pb2 as messages
from sightfix.v1 import sample_service_pb2 as samples
from sightfix.v1 import values_pb2 as values

Answer = messages.StreamAnswer
Acknowledgement = messages.StreamAcknowledgement


def to_message(item: LiveItem | Observation | Sample) -> messages.StreamItem:
    """An item as a message without its seq.

    Raises:
        ValueError: The time has no UTC offset.
    """
    message = messages.StreamItem()
    message.time.FromJsonString(format_time(item.time))
    if item.target_id is not None:
        message.target_id = item.target_id
    if item.bounding_box is not None:
        box = item.bounding_box
        message.bounding_box.CopyFrom(
            values.BoundingBox(left_px=box.left_px, top_px=box.top_px, width_px=box.width_px, height_px=box.height_px)
        )
    if item.fix is not None:
        fix = item.fix
        message.fix.CopyFrom(
            values.Fix(longitude_deg=fix.longitude_deg, latitude_deg=fix.latitude_deg, sigma_m=fix.sigma_m)
        )
    # Not every kind of item has these.
    optional = (("receiver_id", "receiver_id"), ("tracker_id", "tracker_id"), ("class", "class_"), ("score", "score"))
    for name, attribute in optional:
        value = getattr(item, attribute, None)
        if value is not None:
            setattr(message, name, value)
    return message


def durability_value(durability: Durability) -> samples.Durability.ValueType:
    """The durability as a value of the gRPC interface."""
    return samples.DURABILITY_SYNCED if durability == "synced" else samples.DURABILITY_RELAXED


@dataclass(frozen=True)
class StreamFailure:
    """Why a stream ended."""

    error: ProblemError
    is_retryable: bool


RETRYABLE = ("UNAVAILABLE", "DEADLINE_EXCEEDED", "ABORTED", "INTERNAL")
# A broken connection comes under these codes, too, but without details of the server.
RETRYABLE_WITHOUT_DETAILS = ("UNKNOWN", "CANCELLED", "RESOURCE_EXHAUSTED")


def stream_failure(error: grpc.RpcError) -> StreamFailure:
    """The meaning of the status of a stream that ended."""
    # Every error of a call has its status, which the type does not show.
    call: Any = error
    code = call.code().name
    details = server_details(call)
    retryable = code in RETRYABLE or (code in RETRYABLE_WITHOUT_DETAILS and not details.kind)
    kind = BY_GRPC_CODE.get(code, ServerFaultError)
    return StreamFailure(kind(details), retryable)


def server_details(call: Any) -> Problem:
    """The problem in the details of a status (google.rpc.Status in the trailing metadata)."""
    code, message = call.code().name, call.details() or ""
    kind, trace_id, owner, violations = "", "", None, []
    for key, value in call.trailing_metadata() or ():
        if key != "grpc-status-details-bin":
            continue
        for detail in status_pb2.Status.FromString(value).details:
            info, bad, request = (
                error_details_pb2.ErrorInfo(),
                error_details_pb2.BadRequest(),
                error_details_pb2.RequestInfo(),
            )
            if detail.Unpack(info):
                kind, owner = info.reason, info.metadata.get("owner")
            elif detail.Unpack(bad):
                violations = [Violation(field=it.field, message=it.description) for it in bad.field_violations]
            elif detail.Unpack(request):
                trace_id = request.request_id
    title = code.replace("_", " ").capitalize()
    return Problem(
        status=0,
        kind=kind,
        title=title,
        detail=message,
        trace_id=trace_id,
        violations=tuple(violations),
        owner=owner,
    )


def closed_early() -> ProblemError:
    """The error of a server that closes its streams before all items are done."""
    detail = "the server closed the stream before all items were done"
    return UnavailableError(Problem(status=0, kind="", title="Unavailable", detail=detail))
