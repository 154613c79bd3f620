"""Operations of clients, one JSON line each: what was asked, when it was called, and when its answer came."""

import dataclasses
import json
import threading
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

#: Statuses below 500 after which nobody knows whether the change was made.
UNCERTAIN = (408,)
FOREVER_NS = 1 << 62


@dataclasses.dataclass(frozen=True)
class Operation:
    """One request of a client, or one message that came to it.

    Times are nanoseconds of the machine's monotonic clock, which all processes share. The status is missing where no
    answer came.
    """

    client: str
    action: str
    subject: str
    arguments: dict[str, Any]
    call_ns: int
    return_ns: int
    status: int | None
    answer: Any
    request_id: str = ""

    @property
    def is_done(self) -> bool:
        """The server says that it did it."""
        return self.status is not None and 200 <= self.status < 300

    @property
    def is_refused(self) -> bool:
        """The server says that it did not."""
        return self.status is not None and 300 <= self.status < 500 and self.status not in UNCERTAIN

    @property
    def is_unknown(self) -> bool:
        """It may have been done, or may be done yet."""
        return not self.is_done and not self.is_refused


class Recorder:
    """Appends the operations of one client to a file, each as soon as it has returned."""

    def __init__(self, file: Path, client: str) -> None:
        self.client = client
        self._lock = threading.Lock()
        self._file = file.open("a", encoding="utf-8")

    def add(self, operation: Operation) -> Operation:
        """Writes an operation."""
        line = json.dumps(dataclasses.asdict(operation), separators=(",", ":"))
        with self._lock:
            self._file.write(line + "\n")
            self._file.flush()
        return operation

    def note(self, action: str, subject: str, arguments: dict[str, Any], answer: Any = None) -> Operation:
        """Writes what came to the client now."""
        now = time.monotonic_ns()
        return self.add(Operation(self.client, action, subject, arguments, now, now, 200, answer))


def read_operations(folder: Path) -> list[Operation]:
    """All operations of a history, by the time of their call."""
    lines = (line for file in sorted(folder.glob("*.ndjson")) for line in file.read_text("utf-8").splitlines())
    return sorted((Operation(**json.loads(line)) for line in lines), key=lambda operation: operation.call_ns)


def of_action(operations: Iterable[Operation], *actions: str) -> list[Operation]:
    """The operations of some actions, in their order."""
    return [operation for operation in operations if operation.action in actions]


def by_subject(operations: Iterable[Operation]) -> dict[str, list[Operation]]:
    """Operations by the camera or key that they are about."""
    subjects: dict[str, list[Operation]] = {}
    for operation in operations:
        subjects.setdefault(operation.subject, []).append(operation)
    return subjects
