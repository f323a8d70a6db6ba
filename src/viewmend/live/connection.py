"""One viewer's WebSocket: one task reads, one writes, one sends states and statistics."""

import asyncio
import contextlib
import itertools
import json
import time
from dataclasses import asdict, dataclass, field
from typing import Any

from starlette.websockets import WebSocket, WebSocketDisconnect

from viewmend.live.broadcast import Broadcast
from viewmend.live.guard import FaultLimit, RateLimit
from viewmend.live.protocol import (
    MODES,
    VERSION,
    Ack,
    Hello,
    Limits,
    Look,
    Message,
    OnAir,
    Ping,
    ProtocolError,
    error_json,
    parse,
)
from viewmend.live.service import RenderService
from viewmend.live.sessions import ViewerSession
from viewmend.rendering.error_rules import ERROR_RULES

HELLO_S = 10.0
ACK_S = 30.0
TICK_S = 0.1


@dataclass
class SessionRegistry:
    """The sessions of all viewers, and what their connections share."""

    service: RenderService
    limits: Limits
    budget_ms: float | None
    about: dict[str, Any]
    """Fields of the message `welcome`: model, codecs, export, token_needed, server."""
    sessions: list[ViewerSession] = field(default_factory=list)
    numbers: "itertools.count[int]" = field(default_factory=itertools.count)
    broadcast: Broadcast | None = None
    """The view for many, where there is one."""

    def source_json(self) -> dict[str, Any]:
        """The part of the message `state` that is the same for all."""
        service = self.service
        span, status, renderer = service.supply.span, service.supply.status, service.renderer
        waits = status.state == "ready" and not service.ready
        return {
            "source": "loading" if waits else status.state,
            "error": status.error or service.error,
            "model_error": renderer.model_error,
            "first": span.first,
            "end": span.end,
            "total": span.total,
            "loops": not span.live,
            "kind": "live" if span.live else "recording",
        }


class ClosingError(Exception):
    """Ends a connection with this close code."""

    def __init__(self, code: int, message: str) -> None:
        super().__init__(message)
        self.code = code


async def close_with_error(socket: WebSocket, code: int, message: str) -> None:
    """Say why a socket ends, and end it."""
    await socket.send_text(json.dumps(error_json(code, message, fatal=True)))
    await socket.close(code)


class ViewerConnection:
    """Reads a viewer's messages, and sends it frames, states and errors."""

    def __init__(self, socket: WebSocket, registry: SessionRegistry) -> None:
        self._socket = socket
        self._registry = registry
        self._service = registry.service
        self._loop = asyncio.get_running_loop()
        self._wake_writer = asyncio.Event()
        self._pending: dict[str, dict[str, Any]] = {}
        self._frame: bytes | None = None
        self._faults = FaultLimit()
        self._rate = RateLimit(registry.limits.messages_per_s)
        self._rig: dict[str, Any] | None = None
        self._session = ViewerSession(
            self._deliver, self._report_error, registry.budget_ms, registry.service.renderer.ladder
        )

    async def run(self) -> None:
        """Serve an accepted socket until it ends."""
        try:
            if len(self._registry.sessions) >= self._registry.limits.viewers:
                raise ClosingError(4503, f"expected at most {self._registry.limits.viewers} viewers; try again later")
            self._registry.sessions.append(self._session)
            await self._handshake()
            self._service.join(self._session)
            await self._serve()
        except ClosingError as closed:
            with contextlib.suppress(WebSocketDisconnect, RuntimeError, TimeoutError):
                async with asyncio.timeout(2):
                    await close_with_error(self._socket, closed.code, str(closed))
        except (WebSocketDisconnect, RuntimeError):  # gone, maybe in the middle of a frame
            pass
        finally:
            self._service.leave(self._session)
            with self._service.lock:
                self._go_on_air(False)
            if self._session in self._registry.sessions:
                self._registry.sessions.remove(self._session)

    async def _handshake(self) -> None:
        try:
            async with asyncio.timeout(HELLO_S):
                hello = parse(await self._receive(), self._registry.limits)
        except TimeoutError:
            raise ClosingError(4408, f"expected a hello within {HELLO_S:g} s; reconnect") from None
        except ProtocolError as error:
            raise ClosingError(4400, str(error)) from None
        if not isinstance(hello, Hello):
            raise ClosingError(4400, "expected 'hello' as the first message; see docs/live-protocol.md")
        if hello.version != VERSION:
            raise ClosingError(4426, f"expected version {VERSION}, got {hello.version}; reload the page")
        welcome = {
            "type": "welcome",
            "version": VERSION,
            "viewer": next(self._registry.numbers),
            "modes": MODES,
            "error_rules": tuple(ERROR_RULES),
            "error_rule": self._service.renderer.error_rule,
            "background": self._service.renderer.background,
            "budget_ms": self._registry.budget_ms,
            "limits": asdict(self._registry.limits),
            **self._registry.about,
        }
        welcome["codecs"] = [codec for codec in self._registry.about["codecs"] if codec in ("jpeg", *hello.codecs)]
        await self._socket.send_text(json.dumps(welcome))

    async def _serve(self) -> None:
        tasks = [asyncio.create_task(work()) for work in (self._read, self._write, self._send_status)]
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
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
        text = message.get("text")
        if text is None:
            raise ProtocolError("expected text, got a binary message")
        return text

    async def _read(self) -> None:
        while True:
            try:
                text = await self._receive()
                if not self._rate.allows():
                    await asyncio.sleep(0.05)  # reads no further: the flood dams itself up
                    self._fault(4429, f"expected at most {self._registry.limits.messages_per_s} messages a second")
                    continue
                self._handle(parse(text, self._registry.limits))
            except ProtocolError as error:
                self._fault(4400, str(error))

    def _fault(self, code: int, message: str) -> None:
        if self._faults.exceeded():
            raise ClosingError(code, message)
        self._send_soon(error_json(code, message, fatal=False))

    def _go_on_air(self, on: bool) -> None:
        if self._registry.broadcast is not None:
            self._registry.broadcast.go_on_air(self._session, on)

    def _handle(self, message: Message) -> None:
        if isinstance(message, Ping):
            now_ms = round(1000 * time.monotonic(), 2)
            self._send_soon({"type": "pong", "sent_ms": message.sent_ms, "server_ms": now_ms})
            return
        if isinstance(message, Hello):
            raise ProtocolError("expected one hello, got another")
        if isinstance(message, Look) and message.codec not in self._registry.about["codecs"]:
            raise ProtocolError(f"expected a codec among {self._registry.about['codecs']}, got '{message.codec}'")
        if isinstance(message, OnAir) and self._registry.broadcast is None:
            raise ProtocolError("expected a server that broadcasts, got one that does not; start it with --broadcast")
        with self._service.lock:
            if isinstance(message, Look):
                self._session.look(message)
                if self._registry.broadcast is not None:
                    self._registry.broadcast.look(self._session)
            elif isinstance(message, OnAir):
                self._go_on_air(message.on)
            elif isinstance(message, Ack):
                self._session.ack(message.frame)
            else:
                self._session.change(message, self._service.supply.span)
            self._service.lock.notify_all()

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

    async def _send_status(self) -> None:
        """Send rig, state and statistics when they are due, and end a connection that does not answer."""
        last, state_at, stats_at = None, 0.0, time.monotonic()
        while True:
            now = time.monotonic()
            if self._service.ready:
                self._send_new_rig()
            source = self._registry.source_json()
            own = self._session.state_json(self._service.supply.span, self._service.edge)
            if (broadcast := self._registry.broadcast) is not None:
                own |= {"on_air": broadcast.is_on_air(self._session), "watched": broadcast.watched}
            shown = (source, {key: own[key] for key in own if key not in ("time", "behind")})
            if shown != last or now - state_at >= 0.5:
                last, state_at = shown, now
                self._send_soon({"type": "state"} | source | own)
            if now - stats_at >= 1:
                stats_at = now
                self._send_soon(self._session.stats_json(len(self._registry.sessions)))
            if self._session.in_flight is not None and now - self._session.in_flight_since > ACK_S:
                raise ClosingError(4408, f"expected an ack within {ACK_S:g} s; reconnect")
            await asyncio.sleep(TICK_S)

    def _send_new_rig(self) -> None:
        if (rig := self._service.renderer.rig_json) is not None and rig is not self._rig:
            self._rig = rig
            self._send_soon({"type": "rig"} | rig)

    def _send_soon(self, message: dict[str, Any]) -> None:
        """Queue a message, in place of one of its type that is still waiting."""
        self._pending[message["type"]] = message
        self._wake_writer.set()

    def _deliver(self, message: bytes) -> None:
        def put() -> None:
            self._send_new_rig()  # which is written before the frame
            self._frame = message
            self._wake_writer.set()

        with contextlib.suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(put)

    def _report_error(self, message: str) -> None:
        with contextlib.suppress(RuntimeError):
            self._loop.call_soon_threadsafe(self._send_soon, error_json("render", message, fatal=False))
