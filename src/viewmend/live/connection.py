"""One viewer's WebSocket: three tasks, and a seat in the service."""

import asyncio
import contextlib
import itertools
import json
import time
from dataclasses import asdict, dataclass, field
from typing import Any

from starlette.websockets import WebSocket, WebSocketDisconnect

from viewmend.live.guard import Patience, Rate
from viewmend.live.protocol import MODES, VERSION, Ack, ClockChange, Hello, Limits, Look, Ping, ProtocolError, parse
from viewmend.live.service import RenderService
from viewmend.live.sessions import ViewerSession

HELLO_S = 10.0
ACK_S = 30.0
TICK_S = 0.1


@dataclass
class SessionRegistry:
    """What all viewers' connections share."""

    service: RenderService
    limits: Limits
    budget_ms: float | None
    about: dict[str, Any]
    """Of the message `welcome`: model, codecs, export, token_needed, server."""
    seats: list[ViewerSession] = field(default_factory=list)
    numbers: "itertools.count[int]" = field(default_factory=itertools.count)

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
    """The connection is to end with this code."""

    def __init__(self, code: int, message: str) -> None:
        super().__init__(message)
        self.code = code


class ViewerConnection:
    """Reads what a viewer says and writes what it should know, whatever the other side does."""

    def __init__(self, socket: WebSocket, lobby: SessionRegistry) -> None:
        self._socket = socket
        self._lobby = lobby
        self._service = lobby.service
        self._loop = asyncio.get_running_loop()
        self._news = asyncio.Event()
        self._notes: dict[str, dict[str, Any]] = {}
        self._frame: bytes | None = None
        self._patience = Patience()
        self._rate = Rate(lobby.limits.messages_per_s)
        self._seat = ViewerSession(self._deliver, self._complain, lobby.budget_ms)

    async def run(self) -> None:
        """Serve an accepted socket until it ends."""
        try:
            if len(self._lobby.seats) >= self._lobby.limits.viewers:
                raise ClosingError(4503, f"expected at most {self._lobby.limits.viewers} viewers; try again later")
            self._lobby.seats.append(self._seat)
            await self._greet()
            self._service.join(self._seat)
            await self._serve()
        except ClosingError as closed:
            await self._close(closed.code, str(closed))
        except (WebSocketDisconnect, RuntimeError):  # gone, maybe in the middle of a frame
            pass
        finally:
            self._service.leave(self._seat)
            if self._seat in self._lobby.seats:
                self._lobby.seats.remove(self._seat)

    async def _greet(self) -> None:
        try:
            async with asyncio.timeout(HELLO_S):
                hello = parse(await self._receive(), self._lobby.limits)
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
            "viewer": next(self._lobby.numbers),
            "modes": MODES,
            "budget_ms": self._lobby.budget_ms,
            "limits": asdict(self._lobby.limits),
            **self._lobby.about,
        }
        welcome["codecs"] = [codec for codec in self._lobby.about["codecs"] if codec in ("jpeg", *hello.codecs)]
        await self._socket.send_text(json.dumps(welcome))

    async def _serve(self) -> None:
        tasks = [asyncio.create_task(work()) for work in (self._read, self._write, self._tick)]
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
                    self._fault(4429, f"expected at most {self._lobby.limits.messages_per_s} messages a second")
                    continue
                self._obey(parse(text, self._lobby.limits))
            except ProtocolError as error:
                self._fault(4400, str(error))

    def _fault(self, code: int, message: str) -> None:
        if self._patience.ends():
            raise ClosingError(code, message)
        self._note({"type": "error", "code": code, "message": message, "fatal": False})

    def _obey(self, message: Hello | Look | Ack | ClockChange | Ping) -> None:
        if isinstance(message, Ping):
            now_ms = round(1000 * time.monotonic(), 2)
            self._note({"type": "pong", "sent_ms": message.sent_ms, "server_ms": now_ms})
            return
        if isinstance(message, Hello):
            raise ProtocolError("expected one hello, got another")
        if isinstance(message, Look) and message.codec not in self._lobby.about["codecs"]:
            raise ProtocolError(f"expected a codec among {self._lobby.about['codecs']}, got '{message.codec}'")
        with self._service.lock:
            if isinstance(message, Look):
                self._seat.look(message)
            elif isinstance(message, Ack):
                self._seat.ack(message.frame)
            else:
                self._seat.change(message, self._service.supply.span)
            self._service.lock.notify_all()

    async def _write(self) -> None:
        while True:
            await self._news.wait()
            self._news.clear()
            while self._notes or self._frame is not None:
                while self._notes:
                    await self._socket.send_text(json.dumps(self._notes.pop(next(iter(self._notes)))))
                if self._frame is not None:
                    frame, self._frame = self._frame, None
                    await self._socket.send_bytes(frame)

    async def _tick(self) -> None:
        """Rig, state and statistics when it is time, and the end of those who do not answer."""
        rig, last, state_at, stats_at = None, None, 0.0, time.monotonic()
        while True:
            now = time.monotonic()
            if self._service.ready and self._service.renderer.rig_json is not rig:
                rig = self._service.renderer.rig_json
                self._note({"type": "rig"} | (rig or {}))
            source = self._lobby.source_json()
            own = self._seat.state_json(self._service.supply.span, self._service.edge)
            essence = (source, {key: own[key] for key in own if key not in ("time", "behind")})
            if essence != last or now - state_at >= 0.5:
                last, state_at = essence, now
                self._note({"type": "state"} | source | own)
            if now - stats_at >= 1:
                stats_at = now
                self._note(self._seat.stats_json(len(self._lobby.seats)))
            if self._seat.in_flight is not None and now - self._seat.in_flight_since > ACK_S:
                raise ClosingError(4408, f"expected an ack within {ACK_S:g} s; reconnect")
            await asyncio.sleep(TICK_S)

    def _note(self, note: dict[str, Any]) -> None:
        """Send this, instead of one of its type that is still waiting."""
        self._notes[note["type"]] = note
        self._news.set()

    def _deliver(self, message: bytes) -> None:
        def put() -> None:
            self._frame = message
            self._news.set()

        with contextlib.suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(put)

    def _complain(self, message: str) -> None:
        note = {"type": "error", "code": "render", "message": message, "fatal": False}
        with contextlib.suppress(RuntimeError):
            self._loop.call_soon_threadsafe(self._note, note)

    async def _close(self, code: int, message: str) -> None:
        note = {"type": "error", "code": code, "message": message, "fatal": True}
        with contextlib.suppress(WebSocketDisconnect, RuntimeError, TimeoutError):
            async with asyncio.timeout(2):
                await self._socket.send_text(json.dumps(note))
                await self._socket.close(code)
