"""The server's connections: what a stranger may cost is bounded here, before anything of ours runs.

Who has not shown the token (or, where none is asked for, comes from another site's page) is a stranger. Strangers'
connections are few and the oldest of them make room; messages of theirs have no size. docs/live.md lists all bounds.
"""

import asyncio
import time
from typing import Any

import h11
from starlette.requests import HTTPConnection
from uvicorn.config import Config
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from uvicorn.server import ServerState
from websockets.frames import Frame
from websockets.http11 import Request

from viewmend.live.turns import TURN_BYTES, Turns

STRANGERS = 128
"""Connections of strangers at a time."""
STRANGERS_BYTES = 1024
"""The largest message of a stranger that is not the end of its connection."""
FRAGMENTS = 1024
"""Pieces of one message."""
UNREAD_S = 20.0
"""Seconds in which who is sent something has to read some of it."""
UNREAD_BYTES = 64_000
"""How much is some of it, where not all."""
PONGS_UNREAD_BYTES = 65_536
"""Pings of who has left more than this unread are not answered."""


REFUSED = b"HTTP/1.1 400 Bad Request\r\nConnection: close\r\n\r\n"


class Lodge(ServerState):
    """What all connections share."""

    def __init__(self) -> None:
        super().__init__()
        self.turns = Turns()


class Visitor:
    """What is known of a connection."""

    transport: asyncio.Transport
    admitted = False
    """Whether it has shown the token, or needs none."""

    def __init__(self) -> None:
        self.since = time.monotonic()
        self._unread, self._moved = 0, self.since

    def admit(self, message_bytes: int = 0) -> None:
        """Make it no stranger; from now on its messages may be so large."""
        self.admitted = True

    @property
    def has_read_all(self) -> bool:
        """Whether nothing that was sent is left."""
        return self.transport.get_write_buffer_size() == 0

    @property
    def gone(self) -> bool:
        """Whether nobody is there any more."""
        return self.transport.is_closing()

    def reads(self, now: float) -> bool:
        """Whether it has read, within the time for it, some of what it was sent; ask every second."""
        left = self.transport.get_write_buffer_size()
        if left == 0 or left <= self._unread - UNREAD_BYTES:
            self._moved = now
            self._unread = left
        self._unread = max(self._unread, left)
        return now - self._moved < UNREAD_S

    def drained(self) -> None:
        """It has read nearly all."""
        self._unread, self._moved = self.transport.get_write_buffer_size(), time.monotonic()

    def make_room(self, connections: set[Any]) -> None:
        """End the oldest strangers where there are too many with this one."""
        strangers = sorted((c for c in connections if isinstance(c, Visitor) and not c.admitted), key=lambda c: c.since)
        for oldest in strangers[: max(0, len(strangers) - STRANGERS)]:
            oldest.transport.abort()


def admit(connection: HTTPConnection, message_bytes: int = 0) -> None:
    """Let a connection in; see `Visitor.admit`."""
    visitor_of(connection).admit(message_bytes)


def visitor_of(connection: HTTPConnection) -> Visitor:
    """The connection that a request or a socket came by."""
    visitor = connection.scope["state"]["visitor"]
    assert isinstance(visitor, Visitor), "`Server` makes connections of this kind"
    return visitor


class HttpDoor(H11Protocol, Visitor):
    """A connection that speaks HTTP, and may ask for a WebSocket."""

    def __init__(
        self,
        config: Config,
        server_state: ServerState,
        app_state: dict[str, Any],
        _loop: asyncio.AbstractEventLoop | None = None,
    ) -> None:
        Visitor.__init__(self)
        assert isinstance(server_state, Lodge), "`Server` has one"
        self._turns, self._turns_had = server_state.turns, 0
        self._unheard = b""
        self._asks = self._has_turn = False
        H11Protocol.__init__(self, config, server_state, app_state | {"visitor": self}, _loop)

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Somebody has come."""
        super().connection_made(transport)
        self.make_room(self.connections)

    def connection_lost(self, exc: Exception | None) -> None:
        """Whoever it was has gone."""
        super().connection_lost(exc)
        self._turns.withdraw(self._take_turn)
        self._unheard = b""

    def resume_writing(self) -> None:
        """What was sent is nearly read."""
        self.drained()
        super().resume_writing()

    def data_received(self, data: bytes) -> None:
        """Bytes have come. A stranger's wait for its turn."""
        if self.admitted and not self._unheard:
            self._hear(data)
            return
        self._unheard += data
        self.transport.pause_reading()
        self._ask_turn()

    def handle_events(self) -> None:
        """Go on with what has come: a request that waited for the answer to the one before, say."""
        if self.admitted or self._has_turn:
            super().handle_events()
        else:
            self._ask_turn()

    def _ask_turn(self) -> None:
        if not self._asks:
            self._asks = True
            self._turns.ask(self._take_turn, self._turns_had == 0)

    def _take_turn(self) -> None:
        self._asks, self._has_turn = False, True
        self._turns_had += 1
        piece, self._unheard = self._unheard[:TURN_BYTES], self._unheard[TURN_BYTES:]
        try:
            if not self.gone:
                self._hear(piece)
        finally:
            self._has_turn = False
        if self.gone or self.transport.get_protocol() is not self:  # it has become a socket
            return
        if self._unheard:
            self._ask_turn()
        elif not self.flow.read_paused:
            self.transport.resume_reading()

    def _hear(self, data: bytes) -> None:
        """Take in bytes. The rest of a request that is answered already is not looked at."""
        if self._is_answered_early:
            return
        if data:
            self._unset_keepalive_if_required()
            self.conn.receive_data(data)
        self.handle_events()

    def on_response_complete(self) -> None:
        """An answer is out. No request can follow one that goes on after its answer: the other side is told so."""
        super().on_response_complete()
        if self._is_answered_early and not self.gone:
            try:
                self.transport.write_eof()
            except OSError:  # the other side has just gone
                self.transport.abort()

    def send_400_response(self, msg: str) -> None:
        """What came is no HTTP. The request that it was the rest of, if any, gets no other answer."""
        if self.cycle is not None and not self.cycle.response_complete:
            self.cycle.disconnected = True
            self.cycle.message_event.set()
        if self.conn.our_state in (h11.IDLE, h11.SEND_RESPONSE):
            super().send_400_response(msg)
        else:
            self.transport.close()

    @property
    def _is_answered_early(self) -> bool:
        answered = self.conn.our_state in (h11.DONE, h11.MUST_CLOSE)
        return answered and self.conn.their_state in (h11.SEND_BODY, h11.ERROR)


class SocketDoor(WebSocketsSansIOProtocol, Visitor):
    """A connection that asks for a WebSocket, or is one."""

    def __init__(
        self,
        config: Config,
        server_state: ServerState,
        app_state: dict[str, Any],
        _loop: asyncio.AbstractEventLoop | None = None,
    ) -> None:
        Visitor.__init__(self)
        WebSocketsSansIOProtocol.__init__(self, config, server_state, app_state | {"visitor": self}, _loop)
        self.conn.max_message_size = STRANGERS_BYTES

    def admit(self, message_bytes: int = 0) -> None:
        """Messages may be so large from now on."""
        super().admit(message_bytes)
        self.conn.max_message_size = message_bytes

    def data_received(self, data: bytes) -> None:
        """Bytes have come. A handshake that cannot be read is answered, and the connection ends."""
        super().data_received(data)
        if self.conn.handshake_exc is not None and not self.handshake_initiated and not self.transport.is_closing():
            self.handshake_complete = self.close_sent = True
            answer = b"".join(self.conn.data_to_send())
            self.transport.write(answer or REFUSED)
            self.transport.close()

    def handle_connect(self, event: Request) -> None:
        """Somebody asks for a socket. What a stranger sends before the answer is not read."""
        super().handle_connect(event)
        if not self.close_sent:
            self.read_paused = True
            self.transport.pause_reading()

    async def send(self, message: Any) -> None:
        """Send what the application says; a refusal completes the handshake, too, and who is gone gets none."""
        if self.conn.eof_sent and message["type"].startswith("websocket.http.response"):
            self.handshake_complete = True
            return
        await super().send(message)
        self.handshake_complete = self.handshake_complete or self.close_sent

    def handle_cont(self, event: Frame) -> None:
        """One more piece of a message. Empty ones would cost memory for ever."""
        if len(self.frames) >= FRAGMENTS:
            self.conn.fail(1009, f"expected at most {FRAGMENTS} fragments a message")
            self.handle_parser_exception()
            return
        super().handle_cont(event)

    def handle_ping(self) -> None:
        """A ping is answered, unless the answers before it are not read."""
        if self.transport.get_write_buffer_size() > PONGS_UNREAD_BYTES:
            self.conn.data_to_send()
            return
        super().handle_ping()

    def resume_writing(self) -> None:
        """What was sent is nearly read."""
        self.drained()
        super().resume_writing()
