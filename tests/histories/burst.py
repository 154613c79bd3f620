"""A burst: many short requests at once, each on a connection of its own, from one process."""

import asyncio
import contextlib
import time

#: Requests under way at once.
AT_ONCE = 200
TIMEOUT_S = 2.0


def burst(port: int, key: str, duration_s: float) -> None:
    """Asks for a profile, again and again, as often as answers come."""
    request = (
        f"GET /v1/cameras/profile HTTP/1.1\r\nhost: 127.0.0.1:{port}\r\nauthorization: Bearer {key}\r\n"
        "connection: close\r\n\r\n"
    )
    asyncio.run(_ask_all(port, request.encode(), time.monotonic() + duration_s))


async def _ask_all(port: int, request: bytes, end_s: float) -> None:
    await asyncio.gather(*(_ask(port, request, end_s) for _ in range(AT_ONCE)))


async def _ask(port: int, request: bytes, end_s: float) -> None:
    while time.monotonic() < end_s:
        with contextlib.suppress(OSError, TimeoutError):
            async with asyncio.timeout(TIMEOUT_S):
                reader, writer = await asyncio.open_connection("127.0.0.1", port)
                with contextlib.closing(writer):
                    writer.write(request)
                    await reader.read()
