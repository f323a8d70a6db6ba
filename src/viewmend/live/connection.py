"""One viewer's WebSocket: one task reads its messages, another one sends frames, states and errors."""

import asyncio
import contextlib
import json
import math
from dataclasses import dataclass, field
from typing import Any

from starlette.websockets import WebSocket, WebSocketDisconnect

from viewmend.live import protocol
from viewmend.live.assets import FrameKey
from viewmend.live.auth import RateLimit
from viewmend.live.protocol import (
    Ack,
    Cancel,
    ClockChange,
    CloseCode,
    Hello,
    Look,
    Message,
    Ping,
    ProtocolError,
)
from viewmend.live.registry import SessionRegistry, SharedState
from viewmend.live.sessions import ViewerSession
from viewmend.rendering.error_mask import ERROR_RULES

HELLO_S = 10.0
"""A client has this many seconds for its first message."""
ACK_S = 30.0
"""A client has this many seconds to acknowledge a frame."""
REJECTED_PER_S = 1.0
"""A client may send this many rejected messages a second, on average. Messages are rejected if they are
malformed or exceed the rate limit."""
REJECTED_AT_ONCE = 19.0
"""A client may send this many rejected messages in a burst."""
STATE_S = 300.0
"""The message `state` is repeated after this many seconds without a change, because pages' clocks drift."""
RECENT_S = 2.0
"""A viewer that was sent a frame within this many seconds is not idle."""


@dataclass
class ClosingError(Exception):
    """Ends a connection with an error message."""

    code: CloseCode
    message: str


async def close_with_error(socket: WebSocket, code: CloseCode, message: str) -> None:
    """Send an error message and close a socket."""
    await socket.send_text(json.dumps(protocol.error_json(code, message, fatal=True)))
    await socket.close(code)


@dataclass(frozen=True)
class StateInputs:
    """The inputs of the message `state`, which is computed again when one of them has changed."""

    shared: SharedState
    clock_changes: int
    """How often the viewer has changed its clock."""
    buffering: bool


@dataclass(frozen=True)
class StateNews:
    """The part of the message `state` that a page cannot compute from the previous message.

    The message is sent again when this part has changed.
    """

    source: dict[str, Any]
    """The fields that are the same for all viewers."""
    clock_changes: int
    """How often the viewer has changed its clock."""
    viewer: dict[str, Any]
    """The fields of this viewer, without those that change as its clock runs."""


@dataclass
class SentMessages:
    """The last messages of each type that a viewer was sent."""

    rig: dict[str, Any] | None = None
    show: dict[str, Any] | None = None
    state_inputs: StateInputs | None = None
    state: StateNews | None = None
    state_s: float = -math.inf
    """The time of the last message `state`; -inf before the first."""
    stats_s: float = -math.inf
    """The time of the last message `stats`; -inf before the first."""
    viewers: int = 0
    """The number of viewers in the last message `stats`."""
    made_ahead: int = 0
    """The number of meshes and views that the server had completed in advance (`SharedState.made_ahead`)
    when messages `completed` were last sent. While it stays the same, there is nothing to announce."""
    announced: dict[FrameKey, int] = field(default_factory=dict)
    """The number of meshes and completed views of each frame that a message `completed` last announced. A
    frame is announced again only when this number has changed."""


class ViewerConnection:
    """Reads a viewer's messages, and sends it frames, states and errors."""

    def __init__(self, socket: WebSocket, registry: SessionRegistry) -> None:
        self._socket = socket
        self._registry = registry
        self._service = registry.service
        self._now = registry.service.now
        self._loop = asyncio.get_running_loop()
        self._wake_writer = asyncio.Event()
        self._pending: dict[str, dict[str, Any]] = {}
        """JSON messages that wait for the writer, by the names that `_send_soon` gives them."""
        self._frame: bytes | None = None
        """The frame that waits for the writer."""
        messages_per_s = registry.limits.messages_per_s
        self._messages = RateLimit(messages_per_s, 2 * messages_per_s, self._now)
        self._rejected = RateLimit(REJECTED_PER_S, REJECTED_AT_ONCE, self._now)
        self._failed: asyncio.Future[None] = self._loop.create_future()
        """Set by `fail`; ends the connection with its exception."""
        self._sent = SentMessages()
        ladder = registry.service.renderer.ladder
        self._session = ViewerSession(
            self._send_frame, self._report_error, registry.budget_ms, ladder, self._now
        )

    async def run(self) -> None:
        """Serve an accepted socket until it ends."""
        sessions = self._registry.sessions
        limit = self._registry.limits.viewers
        try:
            if len(sessions) >= limit:
                raise ClosingError(
                    CloseCode.TOO_MANY_VIEWERS, f"expected at most {limit} viewers; try again later"
                )
            sessions.append(self._session)
            await self._shake_hands()
            self._service.join(self._session)
            await self._serve()
        except ClosingError as closing:
            with contextlib.suppress(WebSocketDisconnect, RuntimeError, TimeoutError):
                async with asyncio.timeout(2):
                    await close_with_error(self._socket, closing.code, closing.message)
        except WebSocketDisconnect:
            pass  # the client has gone
        finally:
            self._service.leave(self._session)
            with self._service.lock:
                self._session.cancel()
                for extension in self._registry.extensions:
                    extension.leave(self._session)
            if self._session in sessions:
                sessions.remove(self._session)

    async def _shake_hands(self) -> None:
        try:
            async with asyncio.timeout(HELLO_S):
                hello = protocol.parse(await self._receive(), self._registry.limits)
        except TimeoutError:
            raise ClosingError(
                CloseCode.TIMEOUT, f"expected a hello within {HELLO_S:g} s; reconnect"
            ) from None
        except ProtocolError as error:
            raise ClosingError(CloseCode.MALFORMED, str(error)) from None
        if not isinstance(hello, Hello):
            raise ClosingError(
                CloseCode.MALFORMED, "expected 'hello' as the first message; see docs/live-protocol.md"
            )
        if hello.version != protocol.VERSION:
            raise ClosingError(
                CloseCode.VERSION_MISMATCH,
                f"expected version {protocol.VERSION}, got {hello.version}; reload the page",
            )
        about = self._registry.about
        welcome = about | {
            "type": "welcome",
            "version": protocol.VERSION,
            "viewer": next(self._registry.numbers),
            "modes": protocol.MODES,
            "error_rules": ERROR_RULES,
            "error_rule": self._service.renderer.error_rule,
            "background": self._service.renderer.background,
            "codecs": [codec for codec in about["codecs"] if codec in ("jpeg", *hello.codecs)],
        }
        await self._send(json.dumps(welcome))

    async def _serve(self) -> None:
        tasks = [asyncio.create_task(work()) for work in (self._read, self._write)]
        try:
            self._registry.join(self)
            done, _ = await asyncio.wait([*tasks, self._failed], return_when=asyncio.FIRST_COMPLETED)
        finally:
            self._registry.leave(self)
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
        for task in done:
            if not task.cancelled():
                task.result()  # raises the exception that ended the connection

    async def _receive(self) -> str:
        message = await self._socket.receive()
        if message["type"] == "websocket.disconnect":
            raise WebSocketDisconnect(message.get("code", 1000))
        if message.get("text") is None:
            raise ProtocolError("expected text, got a binary message; send JSON as text")
        return message["text"]

    async def _read(self) -> None:
        while True:
            try:
                text = await self._receive()
                if self._messages.allow():
                    self._handle(protocol.parse(text, self._registry.limits))
                else:
                    await asyncio.sleep(0.05)  # nothing is read meanwhile, which slows the client down
                    limit = self._registry.limits.messages_per_s
                    self._reject(
                        CloseCode.TOO_MANY_MESSAGES, f"expected at most {limit} messages a second; send fewer"
                    )
            except ProtocolError as error:
                self._reject(CloseCode.MALFORMED, str(error))

    def _reject(self, code: CloseCode, message: str) -> None:
        """Answer a client's message with an error, or close the connection if too many were rejected."""
        if not self._rejected.allow():
            raise ClosingError(code, message)
        self._send_soon(protocol.error_json(code, message, fatal=False))

    def _handle(self, message: Message) -> None:
        if isinstance(message, Ping):
            now_ms = round(1000 * self._now(), 2)
            self._send_soon({"type": "pong", "sent_ms": message.sent_ms, "server_ms": now_ms})
            return
        if isinstance(message, Hello):
            raise ProtocolError("expected one hello, got a second; send it once")
        codecs = self._registry.about["codecs"]
        if isinstance(message, Look) and message.codec not in codecs:
            raise ProtocolError(f"expected a codec among {codecs}, got '{message.codec}'")
        with self._service.lock:
            handled_by_session = self._update_session(message)
            handled_by_extension = [
                extension.handle(self._session, message) for extension in self._registry.extensions
            ]
            if not handled_by_session and not any(handled_by_extension):
                # All messages are for sessions, except `on_air`, which is for the broadcast.
                raise ProtocolError(
                    "expected a server that broadcasts, got one that does not; start it with --broadcast"
                )
            self._service.lock.notify_all()

        # The page waits for its new clock, so send it now. Changes by other messages are sent at the next
        # check.
        if isinstance(message, ClockChange):
            self.send_due(self._registry.shared_state())
        self._registry.check_soon(self)

    def _update_session(self, message: Message) -> bool:
        """Apply a message to the viewer's session, under the service's lock; False if it is for extensions."""
        match message:
            case Look():
                self._session.look(message)
            case Cancel():
                self._session.cancel()
            case Ack():
                self._session.ack(message.frame)
            case ClockChange():
                live_edge = self._service.advance_edge()
                self._session.change_clock(message, self._service.source.span, live_edge)
            case _:
                return False
        return True

    async def _write(self) -> None:
        while True:
            await self._wake_writer.wait()
            self._wake_writer.clear()
            while self._pending or self._frame is not None:
                while self._pending:
                    oldest = next(iter(self._pending))
                    message = self._pending.pop(oldest)
                    await self._send(json.dumps(message))
                if self._frame is not None:
                    frame = self._frame
                    self._frame = None  # the render thread may set the next one while this one is sent
                    await self._send(frame)

    async def _send(self, data: str | bytes) -> None:
        """Send a message, as text or binary; WebSocketDisconnect if the client has gone."""
        try:
            if isinstance(data, str):
                await self._socket.send_text(data)
            else:
                await self._socket.send_bytes(data)
        except RuntimeError:  # from starlette, when more is sent on a closed socket
            raise WebSocketDisconnect from None

    def send_due(self, shared: SharedState) -> float:
        """Send the messages that are due, and end the connection if a frame was not acknowledged in time.

        Returns when this has to be called next, on the service's clock; for a viewer that is not idle, that is at
        once. The registry calls earlier if `shared` changes or the viewer sends a message.
        """
        session = self._session
        now = self._now()
        self._send_new_rig()

        # Compute the state when its inputs have changed, or when it has to be repeated. With extensions, or with
        # a clock that plays behind the live edge, it may change at any time, so compute it at every check.
        # `_send_state` sends it if it is new.
        plays_behind = self._service.source.span.live and session.clock.playing and not session.clock.live
        changes_by_itself = bool(self._registry.extensions) or plays_behind
        is_overdue = now - self._sent.state_s >= STATE_S
        inputs = StateInputs(shared, session.clock_changes, session.buffering)
        if inputs != self._sent.state_inputs or changes_by_itself or is_overdue:
            self._sent.state_inputs = inputs
            self._send_state(inputs)

        # Send the message `show` if the serving program has set a new one. The rig, to which it refers,
        # comes first.
        if self._sent.rig is not None and shared.show and shared.show is not self._sent.show:
            self._sent.show = shared.show
            self._send_soon(shared.show)

        # Send statistics, and announce what was completed in advance.
        self._send_statistics(shared.viewers)
        if shared.made_ahead != self._sent.made_ahead:
            self._sent.made_ahead = shared.made_ahead
            self._send_made_ahead()

        if session.in_flight is not None and now - session.in_flight_since > ACK_S:
            self.fail(ClosingError(CloseCode.TIMEOUT, f"expected an ack within {ACK_S:g} s; reconnect"))

        # An idle viewer needs nothing until its state is repeated. For all others, this is called at each check
        # of the registry. A viewer that has not yet been sent the new number of viewers is not idle.
        gets_views = (
            session.wants_views or session.in_flight is not None or session.sent_since(now - RECENT_S)
        )
        is_idle = self._sent.viewers == shared.viewers and not changes_by_itself and not gets_views
        return self._sent.state_s + STATE_S if is_idle else now

    def fail(self, error: Exception) -> None:
        """End the connection."""
        if not self._failed.done():
            self._failed.set_exception(error)

    def _send_state(self, inputs: StateInputs) -> None:
        """Send the message `state`, unless the page can compute it from the previous one."""
        source = self._service.source
        now = self._now()
        with self._service.lock:
            viewer = self._session.state_json(source.span, self._service.advance_edge())
        for extension in self._registry.extensions:
            viewer |= extension.state_json(self._session)

        # A page advances the clock of a recording by itself, but cannot know when a live rig's frames arrive.
        # The distance to the live edge (`behind`) is sent along, but a change of it alone is not news.
        ignored = ("behind",) if source.span.live else ("time", "behind")
        viewer_news = {key: value for key, value in viewer.items() if key not in ignored}
        news = StateNews(inputs.shared.source, inputs.clock_changes, viewer_news)
        if news != self._sent.state or now - self._sent.state_s >= STATE_S:
            self._sent.state = news
            self._sent.state_s = now
            self._send_soon({"type": "state"} | inputs.shared.source | viewer)

    def _send_made_ahead(self) -> None:
        """Send a message `completed` for each frame with new meshes or views that were completed in advance."""
        counts = self._service.ahead.counts()
        for key, count in counts.items():
            if self._sent.announced.get(key) != count:
                frame_index, without = key
                message = {
                    "type": "completed",
                    "time": frame_index,
                    "without": without,
                    "cameras": [image.camera for image in self._service.ahead.images(key)],
                    "mesh": self._service.ahead.mesh(key) is not None,
                }
                self._send_soon(message, f"completed {key}")
        self._sent.announced = counts

    def _send_statistics(self, viewers: int) -> None:
        """Send statistics if they or the number of viewers have changed, at most once a second."""
        now = self._now()
        # Statistics count the frames sent in the second before them. If none was sent since one second before the
        # previous statistics, these said 0, and new ones would say 0 again.
        has_news = viewers != self._sent.viewers or self._session.sent_since(self._sent.stats_s - 1)
        if has_news and now - self._sent.stats_s >= 1:
            self._sent.stats_s = now
            self._sent.viewers = viewers
            self._send_soon(self._session.stats_json(viewers))

    def _send_new_rig(self) -> None:
        rig = self._service.renderer.rig_json
        if rig is not None and rig is not self._sent.rig and self._service.is_ready:
            self._sent.rig = rig
            self._send_soon({"type": "rig"} | rig)

    def _send_soon(self, message: dict[str, Any], name: str | None = None) -> None:
        """Queue a message for the writer, in place of one with the same name that is still waiting.

        By default, the name is the message's type.
        """
        self._pending[name or message["type"]] = message
        self._wake_writer.set()

    def _send_frame(self, message: bytes) -> None:
        def put() -> None:
            self._send_new_rig()  # queued messages are sent before the frame
            self._frame = message
            self._wake_writer.set()

        with contextlib.suppress(RuntimeError):  # the event loop has ended
            self._loop.call_soon_threadsafe(put)

    def _report_error(self, message: str) -> None:
        with contextlib.suppress(RuntimeError):
            self._loop.call_soon_threadsafe(
                self._send_soon, protocol.error_json("render", message, fatal=False)
            )
