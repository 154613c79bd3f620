"""`sightfix._sync`: the synchronous client, derived from `sightfix._async` by replacing names."""

import re
from pathlib import Path

HEADER = "# Generated from sightfix._async; do not edit.\n"

RULES = [
    (r"\basync (def|for|with)\b", r"\1"),
    (r"\bawait ", ""),
    (r"\bAsync(Client|Iterator|BaseTransport)\b", r"\1"),
    (r"\bAsyncIterable\b", "Iterable"),
    (r"\bAsyncGenerator\[(.+?), None\]", r"Generator[\1, None, None]"),
    (r"\bAsyncGenerator\b", "Generator"),
    (r"\basynccontextmanager\b", "contextmanager"),
    (r"\bFusionServiceAsyncStub\b", "FusionServiceStub"),
    (r"\bStopAsyncIteration\b", "StopIteration"),
    (r"\b__a(enter|exit|iter|next)__\b", r"__\1__"),
    (r"\ba(read|close|iter_lines|iter_bytes)\(", r"\1("),
    (r"\bgrpc\.aio\b", "grpc"),
    (r"\basynchronous\b", "synchronous"),
    (r"\b_async\b", "_sync"),
]


def to_synchronous(code: str) -> str:
    """The synchronous form of a module."""
    for pattern, replacement in RULES:
        code = re.sub(pattern, replacement, code)
    return HEADER + code


def write_synchronous(asynchronous: Path, synchronous: Path) -> None:
    """Writes the synchronous form of every module of a folder into another one."""
    synchronous.mkdir(exist_ok=True)
    for module in sorted(asynchronous.glob("*.py")):
        (synchronous / module.name).write_text(to_synchronous(module.read_text()))
