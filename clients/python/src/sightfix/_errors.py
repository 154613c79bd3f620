"""Exceptions, one class per kind of failure."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sightfix.models import Evaluation, SiteTrainingRun, TrainingRun, Violation

TYPE_PREFIX = "urn:sightfix:problem:"

Job = TrainingRun | SiteTrainingRun | Evaluation
"""A background job of the server."""


class SightfixError(Exception):
    """Base class of all exceptions of this package."""


class ConnectionFailedError(SightfixError):
    """No response came: the server cannot be reached, or the connection broke."""


class JobFailedError(SightfixError):
    """A training run or an evaluation failed or was cancelled."""

    def __init__(self, job: Job) -> None:
        super().__init__(f"{job.id} is {job.state}: {job.outcome or 'no reason given'}")
        self.job = job


class WaitTimeoutError(SightfixError):
    """A job did not end within the given time; it continues on the server."""


class StreamClosedError(SightfixError):
    """The stream was closed by this client and takes no more items."""


@dataclass(frozen=True, kw_only=True)
class Problem:
    """The server's description of a failure (RFC 9457), over REST and over gRPC alike."""

    status: int
    """HTTP status; 0 if it came over gRPC."""
    kind: str
    """Stable name of the kind, such as `invalid-argument`; the last part of the problem's `type`."""
    title: str
    """The kind in words."""
    detail: str
    """This occurrence in words."""
    trace_id: str = ""
    """Id of the request, as in the server's log."""
    violations: tuple[Violation, ...] = ()
    """The fields at fault."""
    owner: str | None = None
    """Address of the node of the server that has the camera's live state, if it is another one."""


class ProblemError(SightfixError):
    """The server refused a request or failed. Subclasses tell what the caller can do about it."""

    def __init__(self, problem: Problem) -> None:
        fields = "".join(f"\n  {it.field}: {it.message}" for it in problem.violations)
        trace = f" (trace_id {problem.trace_id})" if problem.trace_id else ""
        super().__init__(f"{problem.title}: {problem.detail}{trace}{fields}")
        self.problem = problem

    @property
    def kind(self) -> str:
        """Stable name of the kind, such as `camera-not-found`."""
        return self.problem.kind

    @property
    def violations(self) -> tuple[Violation, ...]:
        """The fields at fault."""
        return self.problem.violations


class InvalidRequestError(ProblemError):
    """The request is wrong and must be changed; `violations` names the fields."""


class TooLargeError(InvalidRequestError):
    """The request is beyond a limit of the server."""


class UnauthenticatedError(ProblemError):
    """The server needs an API key, or does not know this one."""


class PermissionDeniedError(ProblemError):
    """The API key may not do this, or the server does not answer for this host."""


class NotFoundError(ProblemError):
    """There is no such resource."""


class ConflictError(ProblemError):
    """The state of the resource does not allow the request."""


class RevisionMismatchError(ConflictError):
    """The resource was changed in the meantime: read it again."""


class InsufficientStorageError(ProblemError):
    """The server has no space left, or reached a limit of stored objects."""


class UnavailableError(ProblemError):
    """The server has too much to do, is shutting down, or another node has the camera: try again later."""


class ServerFaultError(ProblemError):
    """The server failed; its log says more under the `trace_id`."""


BY_STATUS: dict[int, type[ProblemError]] = {
    307: UnavailableError,
    401: UnauthenticatedError,
    403: PermissionDeniedError,
    404: NotFoundError,
    408: UnavailableError,
    409: ConflictError,
    412: RevisionMismatchError,
    413: TooLargeError,
    421: PermissionDeniedError,
    428: ConflictError,
    429: UnavailableError,
    502: UnavailableError,
    503: UnavailableError,
    504: UnavailableError,
    507: InsufficientStorageError,
}

BY_GRPC_CODE: dict[str, type[ProblemError]] = {
    "ABORTED": RevisionMismatchError,
    "ALREADY_EXISTS": ConflictError,
    "DEADLINE_EXCEEDED": UnavailableError,
    "FAILED_PRECONDITION": ConflictError,
    "INVALID_ARGUMENT": InvalidRequestError,
    "NOT_FOUND": NotFoundError,
    "PERMISSION_DENIED": PermissionDeniedError,
    "RESOURCE_EXHAUSTED": TooLargeError,
    "UNAUTHENTICATED": UnauthenticatedError,
    "UNAVAILABLE": UnavailableError,
}


def from_response(status: int, reason: str, body: Mapping[str, Any] | None) -> ProblemError:
    """The exception of a response that is not a success; without a body if it is no problem document."""
    internal_error, first_of_client = 500, 400
    default = InvalidRequestError if first_of_client <= status < internal_error else ServerFaultError
    kind = BY_STATUS.get(status, default)
    if body is None or "title" not in body:
        return kind(Problem(status=status, kind="", title=f"HTTP {status}", detail=reason))
    violations = tuple(Violation(field=it["field"], message=it["message"]) for it in body.get("violations", ()))
    return kind(
        Problem(
            status=status,
            kind=str(body.get("type", "")).removeprefix(TYPE_PREFIX),
            title=body["title"],
            detail=body.get("detail", ""),
            trace_id=body.get("trace_id", ""),
            violations=violations,
        )
    )
