"""The server uvicorn as `live` uses it: its port is taken before anything is said, silent connections are closed."""

import contextlib
import socket
import time
from collections.abc import Iterator
from weakref import WeakKeyDictionary

import uvicorn

from viewmend.live.door import HttpDoor, Lodge, SocketDoor, Visitor
from viewmend.live.server import LiveServer, ServerConfig

CONNECTIONS = 512
"""All connections at a time; who asks beyond is told to come again."""
SEND_BYTES = 256_000
"""What the system holds of each connection that was not read yet; Linux doubles it."""
SILENT_S = 10.0
"""Seconds after which a connection without a whole request is closed."""


class Server(uvicorn.Server):
    """A uvicorn behind `door`, which also closes connections that ask for nothing, or do not read what they get."""

    def __init__(self, server: LiveServer, config: ServerConfig) -> None:
        """Set up."""
        self._socket: socket.socket | None = None
        super().__init__(
            uvicorn.Config(
                server.app(),
                host=config.host,
                port=config.port,
                loop="asyncio",  # not uvloop, which Ray brings: `door` was tried with this one alone
                http=HttpDoor,
                ws=SocketDoor,
                ws_ping_interval=5.0,
                ws_ping_timeout=10.0,
                ws_per_message_deflate=False,
                limit_concurrency=CONNECTIONS,
                timeout_graceful_shutdown=5,
                log_config=None,  # what is logged is escaped, as all that a terminal shows
                log_level="error",  # strangers can cause warnings as they like
                access_log=False,
                server_header=False,
            )
        )
        self.server_state = Lodge()
        self._since: WeakKeyDictionary[object, tuple[int, float]] = WeakKeyDictionary()
        """The id of the last request that was answered, if any, and since when the connection asks for nothing more."""

    @contextlib.contextmanager
    def bound(self) -> Iterator[str]:
        """The server's address, once its port is taken.

        Raises:
            OSError: somebody else has the port.
        """
        config = self.config
        family = socket.AF_INET6 if ":" in config.host else socket.AF_INET
        with socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP) as listener:
            # What nobody reads is small, and that somebody reads slowly is seen; inherited by what is accepted.
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BYTES)
            # With its protocol named, asyncio sets TCP_NODELAY on what is accepted: small answers leave at once.
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                listener.bind((config.host, config.port))
                listener.listen(64)  # who is told the address may come at once, and waits
            except OSError as error:
                what = error.strerror or str(error)
                raise OSError(f"port {config.port} of {config.host}: {what}; choose another --port or --host") from None
            self._socket = listener
            name = f"[{config.host}]" if ":" in config.host else config.host
            yield f"http://{name}:{listener.getsockname()[1]}"

    def run_bound(self) -> None:
        """Serve until stopped (Ctrl-C, SIGTERM, or `should_exit`)."""
        assert self._socket is not None, "bound() comes first"
        self.run(sockets=[self._socket])

    async def on_tick(self, counter: int) -> bool:
        """Called ten times a second."""
        if counter % 10 == 0:
            self._close_silent()
            self._close_unread()
        return await super().on_tick(counter)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """End; nobody is waited for who is no viewer, or does not read."""
        for connection in list(self.server_state.connections):
            if isinstance(connection, Visitor) and not (connection.admitted and connection.has_read_all):
                connection.transport.abort()
        await super().shutdown(sockets)

    def _close_unread(self) -> None:
        now = time.monotonic()
        for connection in list(self.server_state.connections):
            if isinstance(connection, Visitor) and not connection.reads(now):
                connection.transport.abort()

    def _close_silent(self) -> None:
        now = time.monotonic()
        for connection in list(self.server_state.connections):
            # HTTP connections only: viewers' sockets have time limits of their own. Half a request is no request.
            cycle = getattr(connection, "cycle", connection)
            if cycle is not None and not getattr(cycle, "response_complete", False):
                self._since.pop(connection, None)
                continue
            answered, since = self._since.get(connection, (id(cycle), now))
            if answered != id(cycle):
                since = now
            self._since[connection] = id(cycle), since
            if now - since > SILENT_S and connection.transport is not None:
                connection.transport.close()
