"""One viewer's WebSocket: a task that reads and one that writes; one task for all sends states and statistics."""

import asyncio
import contextlib
import itertools
import json
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from starlette.requests import Request
from starlette.responses import Response
from starlette.websockets import WebSocket, WebSocketDisconnect

from viewmend.live import protocol
from viewmend.live.auth import RateLimit
from viewmend.live.protocol import Ack, Cancel, ClockChange, Hello, Limits, Look, Message, Ping, ProtocolError
from viewmend.live.service import RenderService
from viewmend.live.sessions import ViewerSession
from viewmend.rendering.error_mask import ERROR_RULES

HELLO_S = 10.0
"""Time for a client's first message."""
ACK_S = 30.0
"""Time for the acknowledgement of a frame."""
FAULTS = (1.0, 19.0)
"""Malformed messages per second, and at once, that do not end a connection."""
TICK_S, LIVE_TICK_S = 0.25, 0.1
"""Seconds between checks of what viewers have to know; while a rig pushes frames, it is also checked after each."""
STATE_S = 300.0
"""Time after which a state is sent again though nothing has changed; pages continue its clock by themselves."""


Common = tuple[dict[str, Any], dict[str, Any] | None, dict[str, Any] | None, int]
"""See `SessionRegistry.common`."""


class Extension:
    """An optional part of the live server; by default, every method does nothing."""

    notice: str | None = None
    """What `viewmend serve` prints after the address; {address} and {query} are replaced."""

    def routes(self) -> Mapping[str, Callable[[Request], Awaitable[Response]]]:
        """Handlers of GET requests by path; the server checks token and origin."""
        return {}

    def running(self) -> contextlib.AbstractAsyncContextManager[None]:
        """A context that the server holds while it serves."""
        return contextlib.nullcontext()

    def welcome_json(self) -> dict[str, Any]:
        """Fields of the message `welcome`."""
        return {}

    def state_json(self, session: ViewerSession) -> dict[str, Any]:
        """Fields of a viewer's message `state`."""
        return {}

    def handle(self, session: ViewerSession, message: Message) -> bool:
        """Use a viewer's message, under the service's lock; False if it is of no use."""
        return False

    def leave(self, session: ViewerSession) -> None:
        """Note that a viewer has left, under the service's lock."""

    def metrics(self) -> list[str]:
        """Lines for /metrics."""
        return []


@dataclass
class SessionRegistry:
    """The sessions of all viewers, and what their connections share."""

    service: RenderService
    limits: Limits
    budget_ms: float | None
    about: dict[str, Any]
    """Fields of the message `welcome` that are the same for all viewers."""
    extensions: Sequence[Extension] = ()
    sessions: list[ViewerSession] = field(default_factory=list)
    connections: "dict[ViewerConnection, float]" = field(default_factory=dict)
    """Those that have said hello, each with the time before which nothing is due on it unless something changes."""
    numbers: "itertools.count[int]" = field(default_factory=itertools.count)
    shown: dict[str, Any] | None = None
    """The message `show` that moves all pages, also those that will be opened; set on any thread."""

    _informer: "asyncio.Task[None] | None" = None

    def join(self, connection: "ViewerConnection") -> None:
        """Inform a viewer from now on."""
        common = self.common()
        self.connections[connection] = connection.inform(common)
        if self._informer is None or self._informer.done():
            self._informer = asyncio.create_task(self._inform(common))

    async def _inform(self, common: Common) -> None:
        """Let all connections send what is due, while there are any; they have been informed of `common`."""
        news, loop = asyncio.Event(), asyncio.get_running_loop()

        def note() -> None:
            with contextlib.suppress(RuntimeError):  # the event loop has ended
                loop.call_soon_threadsafe(news.set)

        self.service.changed = note
        while self.connections:
            news.clear()
            is_new, now = (newest := self.common()) != common, self.service.now()
            common = newest if is_new else common
            for connection in [each for each, due_s in self.connections.items() if is_new or due_s <= now]:
                try:
                    self.connections[connection] = connection.inform(common)
                except Exception as error:  # ends this connection only
                    connection.fail(error)
            if self.service.source.span.live:  # a rig's frames are announced at once
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(news.wait(), LIVE_TICK_S)
            else:
                await asyncio.sleep(TICK_S)

    def common(self) -> Common:
        """What is the same for all viewers: their part of `state`, the messages `show` and `rig`, and their number."""
        return self.source_json(), self.shown, self.service.renderer.rig_json, len(self.sessions)

    def source_json(self) -> dict[str, Any]:
        """The part of the message `state` that is the same for all viewers."""
        service, span, status = self.service, self.service.source.span, self.service.source.status
        return {
            "source": "loading" if status.state == "ready" and not service.is_ready else status.state,
            "error": status.error or service.error,
            "model_error": service.renderer.model_error,
            "first": span.first,
            "end": span.end,
            "total": span.total,
            "loops": not span.live,
            "kind": "live" if span.live else "recording",
        }


@dataclass
class ClosingError(Exception):
    """Ends a connection."""

    code: int
    message: str


async def close_with_error(socket: WebSocket, code: int, message: str) -> None:
    """Send an error message and close a socket."""
    await socket.send_text(json.dumps(protocol.error_json(code, message, fatal=True)))
    await socket.close(code)


class ViewerConnection:
    """Reads a viewer's messages, and sends it frames, states and errors."""

    def __init__(self, socket: WebSocket, registry: SessionRegistry) -> None:
        self._socket, self._registry, self._service = socket, registry, registry.service
        self._now, self._loop = registry.service.now, asyncio.get_running_loop()
        self._wake_writer = asyncio.Event()
        self._pending: dict[str, dict[str, Any]] = {}
        self._frame: bytes | None = None
        rate = registry.limits.messages_per_s
        self._rate, self._faults = RateLimit(rate, 2 * rate, self._now), RateLimit(*FAULTS, self._now)
        self._rig: dict[str, Any] | None = None
        self._shown: dict[str, Any] | None = None
        self._failed: asyncio.Future[None] = self._loop.create_future()
        self._seen: tuple[Any, ...] = ()
        self._state: tuple[Any, ...] = ()
        self._state_at = self._stats_at = -STATE_S
        self._viewers = 0
        """Viewers in the last statistics."""
        ladder = registry.service.renderer.ladder
        self._session = ViewerSession(self._send_frame, self._report_error, registry.budget_ms, ladder, self._now)

    async def run(self) -> None:
        """Serve an accepted socket until it ends."""
        sessions, limit = self._registry.sessions, self._registry.limits.viewers
        try:
            if len(sessions) >= limit:
                raise ClosingError(4503, f"expected at most {limit} viewers; try again later")
            sessions.append(self._session)
            await self._shake_hands()
            self._service.join(self._session)
            await self._serve()
        except ClosingError as closing:
            with contextlib.suppress(WebSocketDisconnect, RuntimeError, TimeoutError):
                async with asyncio.timeout(2):
                    await close_with_error(self._socket, closing.code, closing.message)
        except (WebSocketDisconnect, RuntimeError):  # the client has gone, maybe in the middle of a frame
            pass
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
            raise ClosingError(4408, f"expected a hello within {HELLO_S:g} s; reconnect") from None
        except ProtocolError as error:
            raise ClosingError(4400, str(error)) from None
        if not isinstance(hello, Hello):
            raise ClosingError(4400, "expected 'hello' as the first message; see docs/live-protocol.md")
        if hello.version != protocol.VERSION:
            raise ClosingError(4426, f"expected version {protocol.VERSION}, got {hello.version}; reload the page")
        about = self._registry.about
        welcome = about | {
            "type": "welcome",
            "version": protocol.VERSION,
            "viewer": next(self._registry.numbers),
            "modes": protocol.MODES,
            "error_rules": tuple(ERROR_RULES),
            "error_rule": self._service.renderer.error_rule,
            "background": self._service.renderer.background,
            "codecs": [codec for codec in about["codecs"] if codec in ("jpeg", *hello.codecs)],
        }
        await self._socket.send_text(json.dumps(welcome))

    async def _serve(self) -> None:
        tasks = [asyncio.create_task(work()) for work in (self._read, self._write)]
        self._registry.join(self)
        try:
            done, _ = await asyncio.wait([*tasks, self._failed], return_when=asyncio.FIRST_COMPLETED)
        finally:
            del self._registry.connections[self]
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
        for task in done:
            if not task.cancelled():
                task.result()

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
                if not self._rate.allow():
                    await asyncio.sleep(0.05)  # nothing is read meanwhile, which slows the client down
                    self._count_fault(
                        4429, f"expected at most {self._registry.limits.messages_per_s} messages a second; send fewer"
                    )
                    continue
                self._handle(protocol.parse(text, self._registry.limits))
            except ProtocolError as error:
                self._count_fault(4400, str(error))

    def _count_fault(self, code: int, message: str) -> None:
        if not self._faults.allow():
            raise ClosingError(code, message)
        self._send_soon(protocol.error_json(code, message, fatal=False))

    def _handle(self, message: Message) -> None:
        if isinstance(message, Ping):
            now_ms = round(1000 * self._now(), 2)
            self._send_soon({"type": "pong", "sent_ms": message.sent_ms, "server_ms": now_ms})
            return
        if isinstance(message, Hello):
            raise ProtocolError("expected one hello, got a second; send it once")
        if isinstance(message, Look) and message.codec not in self._registry.about["codecs"]:
            raise ProtocolError(f"expected a codec among {self._registry.about['codecs']}, got '{message.codec}'")
        with self._service.lock:
            if isinstance(message, Look):
                self._session.look(message)
            elif isinstance(message, Cancel):
                self._session.cancel()
            elif isinstance(message, Ack):
                self._session.ack(message.frame)
            elif isinstance(message, ClockChange):
                self._session.change_clock(message, self._service.source.span, self._service.edge)
            used = [extension.handle(self._session, message) for extension in self._registry.extensions]
            if not any(used) and not isinstance(message, Look | Cancel | Ack | ClockChange):
                raise ProtocolError(
                    "expected a server that broadcasts, got one that does not; start it with --broadcast"
                )
            self._service.lock.notify_all()
        if isinstance(message, ClockChange):
            self.inform(self._registry.common())
        self._registry.connections[self] = 0.0

    async def _write(self) -> None:
        while True:
            await self._wake_writer.wait()
            self._wake_writer.clear()
            while self._pending or self._frame is not None:
                while self._pending:
                    await self._socket.send_text(json.dumps(self._pending.pop(next(iter(self._pending)))))
                if self._frame is not None:
                    frame, self._frame = self._frame, None
                    await self._socket.send_bytes(frame)

    def inform(self, common: Common) -> float:
        """Send rig, state and statistics if they are due, and end a connection that acknowledges no frames.

        `common` is the same object while it is equal. Returns the time before which this need not be called again,
        unless `common` changes or the viewer sends something.
        """
        session, (shared, shown, _, viewers) = self._session, common
        span, now = self._service.source.span, self._now()
        self._send_new_rig()
        catches_up = span.live and session.clock.playing and not session.clock.live
        changing = bool(self._registry.extensions) or catches_up  # at any time
        seen = (common, session.clock_changes, session.buffering)
        if seen != self._seen or changing or now - self._state_at >= STATE_S:
            self._seen = seen
            self._send_state(shared)
        if self._rig is not None and shown is not self._shown and shown:
            self._shown = shown
            self._send_soon(shown)
        if now - self._stats_at >= 1 and (viewers != self._viewers or session.sent_since(self._stats_at - 1)):
            self._stats_at, self._viewers = now, viewers
            self._send_soon(session.stats_json(viewers))
        if session.in_flight is not None and now - session.in_flight_since > ACK_S:
            self.fail(ClosingError(4408, f"expected an ack within {ACK_S:g} s; reconnect"))
        gets_views = session.wants_views or session.in_flight is not None or session.sent_since(now - 2)
        is_steady = self._viewers == viewers and not changing and not gets_views
        return self._state_at + STATE_S if is_steady else now

    def fail(self, error: Exception) -> None:
        """End the connection."""
        if not self._failed.done():
            self._failed.set_exception(error)

    def _send_state(self, shared: dict[str, Any]) -> None:
        """Send a state, unless it is what a viewer expects after the last one: clocks run on."""
        source, now = self._service.source, self._now()
        with self._service.lock:
            own = self._session.state_json(source.span, self._service.edge)
        for extension in self._registry.extensions:
            own |= extension.state_json(self._session)
        expected = ("behind",) if source.span.live else ("time", "behind")  # a rig's frames are announced
        state = (shared, self._seen[1], {key: own[key] for key in own if key not in expected})
        if state != self._state or now - self._state_at >= STATE_S:
            self._state, self._state_at = state, now
            self._send_soon({"type": "state"} | shared | own)

    def _send_new_rig(self) -> None:
        rig = self._service.renderer.rig_json
        if rig is not self._rig and rig is not None and self._service.is_ready:
            self._rig = rig
            self._send_soon({"type": "rig"} | rig)

    def _send_soon(self, message: dict[str, Any]) -> None:
        """Queue a message; it replaces one of the same type that is still waiting."""
        self._pending[message["type"]] = message
        self._wake_writer.set()

    def _send_frame(self, message: bytes) -> None:
        def put() -> None:
            self._send_new_rig()  # which is written before the frame
            self._frame = message
            self._wake_writer.set()

        with contextlib.suppress(RuntimeError):  # the event loop has ended
            self._loop.call_soon_threadsafe(put)

    def _report_error(self, message: str) -> None:
        with contextlib.suppress(RuntimeError):
            self._loop.call_soon_threadsafe(self._send_soon, protocol.error_json("render", message, fatal=False))
