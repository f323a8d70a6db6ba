"""Limits for connections: what unauthenticated clients may send, and what any client may leave unread.

`LimitedConnection` sits between a socket and uvicorn: it is the socket's
`asyncio.Protocol`, and the `asyncio.Transport` of uvicorn's HTTP and WebSocket protocols.
So it can count, delay and drop bytes with public interfaces only. A client is
unauthenticated until a request has shown the token or, where no token is required, does not
come from another site's page. docs/live.md lists all limits.
"""

import asyncio
import logging
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from starlette.requests import HTTPConnection
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocketDisconnect
from uvicorn.config import Config
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.utils import ClientDisconnected
from uvicorn.server import ServerState

MAX_UNAUTHENTICATED = 128
"""Unauthenticated connections at a time; the oldest one is closed when another arrives."""
MAX_UNAUTHENTICATED_BYTES = 262_144
"""Bytes that an unauthenticated connection may send in all."""
MESSAGE_SLACK_BYTES = 524_288
"""Bytes that may arrive on a WebSocket beyond the message that is read: parts of the next message."""
MESSAGE_SLACK_BYTES_PER_S = 1000
"""Bytes per second that may arrive on a WebSocket for pings and pongs."""
IDLE_S = 10.0
"""A connection without a complete request is closed after this many seconds."""
HANDSHAKE_S = 1.0
"""A WebSocket handshake that uvicorn cannot parse is closed after this long."""
UNREAD_S = 20.0
"""Seconds within which a client with unread data has to read `UNREAD_BYTES` of it."""
UNREAD_BYTES = 64_000
"""Bytes that a client with unread data has to read within `UNREAD_S`."""
PIECE_BYTES = 4096
"""Unauthenticated input is handed to uvicorn in pieces of at most this size."""
PAUSE_FACTOR = 4.0
"""Pause of unauthenticated clients after a turn, as a multiple of its processor time."""
MIN_PAUSE_S = 0.005
"""Shortest pause of unauthenticated clients after a turn, seconds."""
TOO_LARGE = b"\x88\x02\x03\xf1"
"""A WebSocket close frame with code 1009, message too large."""
STATE_KEY = "connection"
"""The key of a request's `LimitedConnection` in the ASGI scope's `state`."""

log = logging.getLogger("viewmend.live")


class FairScheduler:
    """Runs one callback at a time and pauses after each, so that unauthenticated clients use a fifth of the time.

    Of the waiting callbacks, the first one of a connection goes before later ones of other connections.
    """

    def __init__(
        self,
        now: Callable[[], float],
        call_later: Callable[[float, Callable[[], None]], object] | None = None,
        spent: Callable[[], float] = time.thread_time,
    ) -> None:
        """Set up a scheduler; `call_later` is the running event loop's by default.

        `spent` is the thread's processor time: other programs must not prolong the pauses.
        """
        self._now = now
        self._call_later = call_later
        self._spent = spent
        self._waiting: deque[Callable[[], None]] = deque()
        self._free_at_s = 0.0
        self._is_planned = False

    def submit(self, callback: Callable[[], None], first: bool) -> None:
        """Call `callback` when its turn comes; if `first`, before all others that wait."""
        if first:
            self._waiting.appendleft(callback)
        else:
            self._waiting.append(callback)
        self._plan()

    def withdraw(self, callback: Callable[[], None]) -> None:
        """Remove a callback, if it waits."""
        if callback in self._waiting:
            self._waiting.remove(callback)

    def _plan(self) -> None:
        if self._waiting and not self._is_planned:
            self._is_planned = True
            call_later = self._call_later or asyncio.get_running_loop().call_later
            call_later(max(0.0, self._free_at_s - self._now()), self._run_next)

    def _run_next(self) -> None:
        start_s = self._spent()
        try:
            if self._waiting:
                self._waiting.popleft()()
        finally:
            pause_s = max(MIN_PAUSE_S, PAUSE_FACTOR * (self._spent() - start_s))
            self._free_at_s = self._now() + pause_s
            self._is_planned = False
            self._plan()


class LimitedConnection(asyncio.Protocol, asyncio.Transport):
    """One connection: the socket's protocol, and the transport of uvicorn's protocol."""

    def __init__(
        self,
        limits: "ConnectionLimits",
        config: Config,
        server_state: ServerState,
        app_state: dict[str, Any],
        _loop: asyncio.AbstractEventLoop | None = None,
    ) -> None:
        super().__init__()
        self.authenticated = False
        self.requests = 0
        """Requests that are being answered: 0 or 1."""
        self.since_s = limits.now()
        self.idle_since_s = self.since_s
        """The end of the last request."""
        self._read_at_s = self.since_s
        """The last time at which the client had read enough of its data."""
        self._limits = limits
        self._uvicorn: asyncio.BaseProtocol = H11Protocol(
            config, server_state, app_state | {STATE_KEY: self}, _loop
        )
        self._is_websocket = False
        self.message_bytes = 0
        """Bytes that have been read since the application received the last WebSocket message."""
        self._max_message_bytes = 0
        """A WebSocket message may have this many bytes."""
        self._held = b""
        """Input that uvicorn has not received yet."""
        self._received_bytes = 0
        self._unread_bytes = 0
        """The largest amount of unread output since `_read_at_s`."""
        self._turns = 0
        """The number of times that the scheduler has given this connection a turn."""
        self._is_waiting = False
        """Whether `_take_turn` waits for a turn."""
        self._input_paused = False
        self._output_paused = False
        self._next_request: Callable[[], None] | None = None
        """Continues the request that waits for its turn."""

    def authenticate(self, max_message_bytes: int) -> None:
        """Lift the limits for unauthenticated clients; WebSocket messages may have `max_message_bytes` from now on."""
        self.authenticated = True
        self._max_message_bytes = max_message_bytes
        asyncio.get_running_loop().call_soon(self._forward)

    def allow_pings(self) -> None:
        """Forget the bytes that pings and pongs may have in a second; to be called once a second."""
        self.message_bytes = max(0, self.message_bytes - MESSAGE_SLACK_BYTES_PER_S)

    def track_reading(self, now: float) -> bool:
        """Note how much output is unread, and return whether the client reads too slowly."""
        left = self.get_write_buffer_size()
        if left == 0 or left <= self._unread_bytes - UNREAD_BYTES:
            self._read_at_s = now
            self._unread_bytes = left
        self._unread_bytes = max(self._unread_bytes, left)
        return now - self._read_at_s >= UNREAD_S

    async def wait_for_turn(self) -> bool:
        """Wait until a request may be answered; False if the client has gone meanwhile."""
        if not (self.authenticated or self.is_closing()):
            turn = asyncio.Event()
            self._next_request = turn.set
            self._limits.scheduler.submit(turn.set, self._turns <= 1)
            await turn.wait()
            self._next_request = None
        return not self.is_closing()

    # The socket's protocol.

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Begin, and close the oldest unauthenticated connections if there are too many."""
        assert isinstance(transport, asyncio.Transport), "servers accept streams"
        self._transport = transport
        self._limits.add(self)
        self._uvicorn.connection_made(self)

    def connection_lost(self, exc: Exception | None) -> None:
        """Release everything that waits for this connection."""
        self._limits.connections.discard(self)
        self._limits.scheduler.withdraw(self._take_turn)
        self._held = b""
        if self._next_request is not None:
            self._limits.scheduler.withdraw(self._next_request)
            self._next_request()
        self._uvicorn.connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Take input from the socket."""
        self._received_bytes += len(data)
        if not self.authenticated and self._received_bytes > MAX_UNAUTHENTICATED_BYTES:
            self.abort()
            return
        self._held += data
        self._forward()

    def pause_writing(self) -> None:
        """Hold input back while output is not read: pings would be answered without bound."""
        self._output_paused = True
        self._uvicorn.pause_writing()

    def resume_writing(self) -> None:
        """Go on after nearly all output was read."""
        self._output_paused = False
        self._unread_bytes = self.get_write_buffer_size()
        self._read_at_s = self._limits.now()
        self._uvicorn.resume_writing()
        self._forward()

    def _forward(self) -> None:
        """Hand held input to uvicorn: all of it, or the next piece when it is an unauthenticated client's turn."""
        is_held_back = self._input_paused or self._output_paused or self.is_closing()
        if self._held and not is_held_back:
            if self.authenticated:
                self._deliver(len(self._held))
            elif not (self._is_websocket or self._is_waiting):  # WebSockets are read once authenticated
                self._is_waiting = True
                self._limits.scheduler.submit(self._take_turn, self._turns == 0)
        if self.is_closing():
            return
        if self._held or self._input_paused:
            self._transport.pause_reading()
        else:
            self._transport.resume_reading()

    def _take_turn(self) -> None:
        self._is_waiting = False
        self._turns += 1
        if self._held and not self._input_paused and not self.is_closing():
            self._deliver(PIECE_BYTES)
        self._forward()

    def _deliver(self, max_bytes: int) -> None:
        data = self._held[:max_bytes]
        self._held = self._held[max_bytes:]
        self.message_bytes += len(data)
        if self._is_websocket and self.message_bytes > self._max_message_bytes + MESSAGE_SLACK_BYTES:
            self.write(TOO_LARGE)
            self.close()
            return
        assert isinstance(self._uvicorn, asyncio.Protocol), "uvicorn's protocols read streams"
        try:
            self._uvicorn.data_received(data)
        except Exception:  # malformed input, for example after the end of a response
            log.debug("while parsing a request", exc_info=True)
            self.abort()

    # The transport of uvicorn's protocol.

    def set_protocol(self, protocol: asyncio.BaseProtocol) -> None:
        """Upgrade to a WebSocket."""
        self._uvicorn = protocol
        self._is_websocket = True
        asyncio.get_running_loop().call_later(HANDSHAKE_S, self._end_handshake)

    def _end_handshake(self) -> None:
        """Close a WebSocket whose handshake has not become a request."""
        if not self.requests:
            self.close()

    def pause_reading(self) -> None:
        """Hold input back."""
        self._input_paused = True
        self._transport.pause_reading()

    def resume_reading(self) -> None:
        """Hand on input again, but not within this call: uvicorn's protocol may be in the middle of its own work."""
        self._input_paused = False
        asyncio.get_running_loop().call_soon(self._forward)

    def get_extra_info(self, name: str, default: Any = None) -> Any:
        """Information that the socket's transport has about the connection."""
        return self._transport.get_extra_info(name, default)

    def get_write_buffer_size(self) -> int:
        """Number of bytes that are waiting to be sent."""
        return self._transport.get_write_buffer_size()

    def write(self, data: bytes | bytearray | memoryview) -> None:
        """Write to the socket's transport if it is still open."""
        if not self.is_closing():
            self._transport.write(data)

    def is_closing(self) -> bool:
        """Whether the socket is closed or closing."""
        return self._transport.is_closing()

    def close(self) -> None:
        """Close the connection after sending what is waiting."""
        self._transport.close()

    def abort(self) -> None:
        """Close the connection at once."""
        self._transport.abort()


class ConnectionLimits:
    """All connections of a server, and the ASGI middleware that follows their requests."""

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self.now = now
        self.connections: set[LimitedConnection] = set()
        self.scheduler = FairScheduler(now)

    def connect(self, *args: Any, **options: Any) -> LimitedConnection:
        """Make a connection's protocol, as uvicorn's option `http` does."""
        return LimitedConnection(self, *args, **options)

    def add(self, connection: LimitedConnection) -> None:
        """Count a connection, and close the oldest unauthenticated one if there are too many."""
        self.connections.add(connection)
        unauthenticated = [c for c in self.connections if not (c.authenticated or c.is_closing())]
        if len(unauthenticated) > MAX_UNAUTHENTICATED:
            min(unauthenticated, key=lambda c: c.since_s).abort()

    def close_stalled(self) -> None:
        """Close connections without a request, and drop those that do not read; to be called once a second."""
        now = self.now()
        for connection in list(self.connections):
            connection.allow_pings()
            if connection.track_reading(now):
                connection.abort()
            elif not connection.requests and now - connection.idle_since_s > IDLE_S:
                connection.close()

    def close_unauthenticated(self) -> None:
        """Drop all connections but those of authenticated clients that have read everything."""
        for connection in list(self.connections):
            if not connection.authenticated or connection.get_write_buffer_size():
                connection.abort()

    def wrap(self, app: ASGIApp) -> ASGIApp:
        """Make the application follow the limits, and log its errors in place of uvicorn."""

        async def limited(scope: Scope, receive: Receive, send: Send) -> None:
            connection = scope.get("state", {}).get(STATE_KEY)
            if connection is None:  # the application's start and end
                await app(scope, receive, send)
                return

            async def receive_next() -> Message:
                message = await receive()
                connection.message_bytes = 0
                return message

            def raise_if_ended() -> None:
                # A stopping server ends handshakes. uvicorn would answer them again, but
                # not after this error.
                if scope["type"] == "websocket" and connection.is_closing():
                    raise ClientDisconnected

            async def send_if_open(message: Message) -> None:
                raise_if_ended()
                await send(message)

            connection.requests += 1
            try:
                if await connection.wait_for_turn():
                    await app(scope, receive_next, send_if_open)
            except (OSError, WebSocketDisconnect):
                log.debug("a client has gone while it was answered")
            except Exception:
                log.exception("while answering %s", scope["path"])
                raise
            finally:
                connection.requests -= 1
                connection.idle_since_s = self.now()
            raise_if_ended()

        return limited


def authenticate(request: HTTPConnection, max_message_bytes: int = 0) -> None:
    """Lift the limits of a request's connection, as `LimitedConnection.authenticate`; behind a proxy there are none."""
    connection = request.scope.get("state", {}).get(STATE_KEY)
    if connection is not None:
        connection.authenticate(max_message_bytes)


def is_gone(request: HTTPConnection) -> bool:
    """Whether a request's connection is closed; False where a proxy holds it."""
    connection = request.scope.get("state", {}).get(STATE_KEY)
    return connection is not None and connection.is_closing()
