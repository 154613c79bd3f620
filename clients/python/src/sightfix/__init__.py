"""Client of sightfix: positions of targets from an uncalibrated fixed camera and GNSS fixes.

`Client` and `AsyncClient` have the same methods. The types of requests and responses are in `sightfix.models`,
the messages of the gRPC interface in `sightfix.v1`.
"""

from sightfix._async.client import AsyncClient
from sightfix._errors import (
    ConflictError,
    ConnectionFailedError,
    InsufficientStorageError,
    InvalidRequestError,
    JobFailedError,
    NotFoundError,
    PermissionDeniedError,
    Problem,
    ProblemError,
    RevisionMismatchError,
    ServerFaultError,
    SightfixError,
    StreamClosedError,
    TooLargeError,
    UnauthenticatedError,
    UnavailableError,
    WaitTimeoutError,
)
from sightfix._events import CameraEvent, LostEvents, PlaceEventMessage, SiteEvent
from sightfix._items import LiveItem
from sightfix._layout import CsvLayout
from sightfix._request import RetryPolicy
from sightfix._sync.client import Client
from sightfix._tables import live_items
from sightfix.models import BoundingBox, Fix, ImageSize, Observation, Position, Receiver, Sample, TimeRange

__version__ = "0.1.0"

__all__ = [
    "AsyncClient",
    "BoundingBox",
    "CameraEvent",
    "Client",
    "ConflictError",
    "ConnectionFailedError",
    "CsvLayout",
    "Fix",
    "ImageSize",
    "InsufficientStorageError",
    "InvalidRequestError",
    "JobFailedError",
    "LiveItem",
    "LostEvents",
    "NotFoundError",
    "Observation",
    "PermissionDeniedError",
    "PlaceEventMessage",
    "Position",
    "Problem",
    "ProblemError",
    "Receiver",
    "RetryPolicy",
    "RevisionMismatchError",
    "Sample",
    "ServerFaultError",
    "SightfixError",
    "SiteEvent",
    "StreamClosedError",
    "TimeRange",
    "TooLargeError",
    "UnauthenticatedError",
    "UnavailableError",
    "WaitTimeoutError",
    "live_items",
]
