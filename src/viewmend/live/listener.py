"""The HTTP server: uvicorn on a port that is bound before anything is printed, with connection limits."""

import asyncio
import contextlib
import socket
from collections.abc import Iterator

import uvicorn

from viewmend.live.connection_limits import ConnectionLimits
from viewmend.live.push import MAX_FRAME_BYTES
from viewmend.live.server import LiveServer, ServerConfig

MAX_CONNECTIONS = 512
"""All connections; requests on further ones are answered by 503."""
SEND_BUFFER_BYTES = 256_000
"""The system's send buffer per connection; Linux doubles it."""


class Server:
    """Serves a `LiveServer` on one port."""

    def __init__(self, server: LiveServer, config: ServerConfig) -> None:
        """Set up; `bind` takes the port."""
        self.limits = ConnectionLimits()
        self._host = config.host
        self._port = config.port
        self._socket: socket.socket | None = None
        self._uvicorn = uvicorn.Server(
            uvicorn.Config(
                self.limits.wrap(server.app()),
                http=self.limits.connect,  # pyrefly: ignore[bad-argument-type]
                ws="websockets-sansio",
                ws_max_size=MAX_FRAME_BYTES,  # the limits of a viewer's and a rig's messages are lower
                ws_ping_interval=45.0,  # proxies close what is silent for a minute
                ws_ping_timeout=10.0,
                ws_per_message_deflate=False,
                limit_concurrency=MAX_CONNECTIONS,
                timeout_graceful_shutdown=5,
                log_config=None,  # the terminal's log escapes what it prints
                log_level="critical",  # unauthenticated clients can cause warnings and errors; `limits.wrap` logs ours
                access_log=False,
                server_header=False,
            )
        )

    def stop(self) -> None:
        """Stop serving, from any thread."""
        self._uvicorn.should_exit = True

    @contextlib.contextmanager
    def bind(self) -> Iterator[str]:
        """Take the port; gives the server's address. OSError if the port is in use."""
        family = socket.AF_INET6 if ":" in self._host else socket.AF_INET
        # With the protocol given, asyncio sets TCP_NODELAY on accepted connections: small answers
        # leave at once.
        with socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP) as listener:
            # Accepted connections inherit the size. A small buffer bounds memory and shows who reads slowly.
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                listener.bind((self._host, self._port))
                listener.listen(64)  # clients may connect as soon as the address is printed
            except OSError as error:
                reason = error.strerror or str(error)
                raise OSError(
                    f"port {self._port} of {self._host}: {reason}; choose another --port or --host"
                ) from None
            self._socket = listener
            name = f"[{self._host}]" if ":" in self._host else self._host
            yield f"http://{name}:{listener.getsockname()[1]}"

    def run(self) -> None:
        """Serve the bound port until stopped (Ctrl-C, SIGTERM or `stop`)."""
        asyncio.run(self._serve())

    async def _serve(self) -> None:
        assert self._socket is not None, "bind() comes first"
        checks = asyncio.create_task(self._check_connections())
        try:
            await self._uvicorn.serve(sockets=[self._socket])
        finally:
            checks.cancel()

    async def _check_connections(self) -> None:
        """Close stalled connections, and at the end all that would delay it."""
        ticks = 0
        while not self._uvicorn.should_exit:
            await asyncio.sleep(0.1)
            ticks += 1
            if ticks % 10 == 0:
                self.limits.close_stalled()
        self.limits.close_unauthenticated()
