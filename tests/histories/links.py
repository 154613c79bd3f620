"""Ways between processes that can be cut, delayed and reset: each connection passes through one of this process."""

import asyncio
import contextlib
import socket
import threading
from collections.abc import Callable, Coroutine
from typing import Any

CHUNK_BYTES = 1 << 16
#: Time for a connection to the other end, s.
CONNECT_S = 2.0


def free_port() -> int:
    """A port of this machine that nobody listens on now."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return int(listener.getsockname()[1])


class Network:
    """The event loop of all links, on a thread of its own."""

    def __init__(self) -> None:
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="links", daemon=True)
        self._thread.start()

    def run(self, coroutine: Coroutine[Any, Any, Any]) -> Any:
        """Runs a coroutine on the loop and gives what it returns."""
        return asyncio.run_coroutine_threadsafe(coroutine, self._loop).result()

    def link(self, *targets: Callable[[], int]) -> "Link":
        """A listener whose connections go to the ports of the targets, in turn."""
        link = Link(targets)
        self.run(link.listen())
        return link

    def set(self, link: "Link", *, is_cut: bool = False, delay_s: float = 0.0) -> None:
        """Cuts or delays what passes through a link, or lets it pass."""
        self._loop.call_soon_threadsafe(link.change, is_cut, delay_s)

    def reset(self, link: "Link") -> None:
        """Ends all connections of a link."""
        self._loop.call_soon_threadsafe(link.end_all)

    def stop(self) -> None:
        """Ends all connections and the loop."""
        self.run(end_other_tasks())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()


async def end_other_tasks() -> None:
    """Ends what else runs on the loop."""
    others = asyncio.all_tasks() - {asyncio.current_task()}
    for task in others:
        task.cancel()
    await asyncio.gather(*others, return_exceptions=True)


class Link:
    """A listener on this machine that passes bytes on.

    While it is cut nothing passes in either direction and nothing is closed: what was sent stays on the way.
    """

    def __init__(self, targets: tuple[Callable[[], int], ...]) -> None:
        self.port = 0
        self._targets = targets
        self._next = 0
        self._flows = asyncio.Event()
        self._flows.set()
        self._delay_s = 0.0
        self._writers: set[asyncio.StreamWriter] = set()
        self._server: asyncio.Server | None = None

    async def listen(self) -> None:
        """Begins to listen on a port of its own."""
        self._server = await asyncio.start_server(self._accepted, "127.0.0.1", 0)
        self.port = self._server.sockets[0].getsockname()[1]

    def own_port(self) -> int:
        """The port that it listens on."""
        return self.port

    def change(self, is_cut: bool, delay_s: float) -> None:
        """Sets what happens to bytes from now on."""
        self._delay_s = delay_s
        if is_cut:
            self._flows.clear()
        else:
            self._flows.set()

    def end_all(self) -> None:
        """Resets the open connections."""
        for writer in list(self._writers):
            writer.transport.abort()

    async def _accepted(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        # Python 3.11 reports a task of a server that is cancelled.
        with contextlib.suppress(asyncio.CancelledError):
            await self._carry(reader, writer)

    async def _carry(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._writers.add(writer)
        try:
            await self._flows.wait()
            connected = await self._connect()
            if connected is None:
                return
            self._writers.add(connected[1])
            try:
                await self._join(reader, writer, *connected)
            finally:
                self._close(connected[1])
        finally:
            self._close(writer)

    async def _connect(self) -> tuple[asyncio.StreamReader, asyncio.StreamWriter] | None:
        for _ in self._targets:
            target = self._targets[self._next % len(self._targets)]
            self._next += 1
            with contextlib.suppress(OSError, TimeoutError):
                return await asyncio.wait_for(asyncio.open_connection("127.0.0.1", target()), CONNECT_S)
        return None

    async def _join(
        self,
        client: asyncio.StreamReader,
        to_client: asyncio.StreamWriter,
        server: asyncio.StreamReader,
        to_server: asyncio.StreamWriter,
    ) -> None:
        ways = [
            asyncio.create_task(self._pass(client, to_server)),
            asyncio.create_task(self._pass(server, to_client)),
        ]
        # The answer of a server that has closed is complete; a client that has closed waits for none.
        await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
        for way in ways:
            way.cancel()
        await asyncio.gather(*ways, return_exceptions=True)

    async def _pass(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError):
            while chunk := await reader.read(CHUNK_BYTES):
                if self._delay_s > 0:
                    await asyncio.sleep(self._delay_s)
                await self._flows.wait()
                writer.write(chunk)
                await writer.drain()

    def _close(self, writer: asyncio.StreamWriter) -> None:
        self._writers.discard(writer)
        writer.close()
