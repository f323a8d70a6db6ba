"""The server: what is asked over HTTP and WebSocket goes to the render service and back."""

import asyncio
import contextlib
import os
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import dataclass, field

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from viewmend import __version__
from viewmend.capture.video_writer import can_write_mp4
from viewmend.live.answers import BODY_BYTES, refusal, whole_body
from viewmend.live.broadcast import Broadcast
from viewmend.live.broadcast_answers import film_answer
from viewmend.live.connection import SessionRegistry, ViewerConnection
from viewmend.live.door import admit
from viewmend.live.guard import Guard
from viewmend.live.metrics_text import metrics_text
from viewmend.live.originals import original_jpeg, parse_original
from viewmend.live.page_files import HEADERS, page_files
from viewmend.live.protocol import HEADER_BYTES, Limits, ProtocolError
from viewmend.live.push import receive_rig
from viewmend.live.pushed import PushedFrames
from viewmend.live.render_jobs import PathJob, PictureJob, RenderJob, Result, parse_path, parse_query
from viewmend.live.riftcast_service import RiftcastService
from viewmend.live.service import RenderService
from viewmend.live.video import video_codecs

PICTURE_S = 60.0
ORIGINAL_S = 5.0
EXPORT_S = 3600.0
PICTURES_AT_ONCE = 4
TOKEN_WANTED = "expected the token, as 'Authorization: Bearer TOKEN' or ?token=TOKEN"


@dataclass(frozen=True, kw_only=True)
class ServerConfig:
    """Where and for whom."""

    host: str = "127.0.0.1"
    port: int = 8008
    token: str | None = None
    budget_ms: float | None = 100.0
    model: str = "views"
    """What `welcome` and /health call it."""
    limits: Limits = field(default_factory=Limits)
    broadcast_px: tuple[int, int] | None = None
    """Width and height, even, of the film for all who watch; None for none."""


class LiveServer:
    """The routes, and what they share."""

    def __init__(self, service: RenderService, config: ServerConfig, riftcast: RiftcastService | None = None) -> None:
        self._service, self._riftcast = service, riftcast
        self._guard = Guard(config.host, config.token)
        self._config = config
        self._files = page_files()
        self._pictures = 0
        self._exporting = False
        self._film: PathJob | None = None
        self._pushing = False
        size_px = config.broadcast_px
        self._broadcast = None if size_px is None else Broadcast(service, size_px, config.budget_ms)
        about = {
            "server": f"viewmend {__version__}",
            "model": config.model,
            "codecs": ["jpeg", *video_codecs()],
            "export": can_write_mp4(),
            "token_needed": bool(config.token),
            "broadcast": self._broadcast is not None,
        }
        self.registry = SessionRegistry(service, config.limits, config.budget_ms, about, broadcast=self._broadcast)

    def app(self) -> Starlette:
        """The ASGI application; its lifespan starts and stops the service."""
        page = self._guarded(self._page, needs_token=False)  # it holds no secret
        routes = [
            Route("/", page),
            Route("/page/{name:path}", page),
            Route("/watch", self._guarded(self._watch, needs_token=False)),
            Route("/broadcast/{name}", self._guarded(self._film_file)),
            Route("/health", self._guarded(self._health)),
            Route("/metrics", self._guarded(self._metrics)),
            Route("/frame.jpg", self._guarded(self._picture)),
            Route("/camera.jpg", self._guarded(self._original)),
            Route("/path", self._guarded(self._progress)),
            Route("/path.mp4", self._guarded(self._export), methods=["POST"]),
            WebSocketRoute("/ws", self._viewer),
            WebSocketRoute("/push", self._push),
        ]
        return Starlette(routes=routes, lifespan=self._lifespan)

    @contextlib.asynccontextmanager
    async def _lifespan(self, app: Starlette) -> AsyncIterator[None]:
        self._service.start()
        try:
            async with contextlib.nullcontext() if self._riftcast is None else self._riftcast.running():
                yield
        finally:
            if self._broadcast is not None:
                await asyncio.to_thread(self._broadcast.stop)
            await asyncio.to_thread(self._service.stop)

    def _guarded(
        self, answer: Callable[[Request], Awaitable[Response]], needs_token: bool = True
    ) -> Callable[[Request], Awaitable[Response]]:
        async def checked(request: Request) -> Response:
            foreign = self._guard.foreign_origin(request)
            if foreign:
                return refusal(403, foreign)
            if await self._guard.lacks_token(request):
                if needs_token:
                    return refusal(401, TOKEN_WANTED)
            else:
                admit(request)
            try:
                return await answer(request)
            except ProtocolError as error:
                return refusal(400, str(error))

        return checked

    async def _page(self, request: Request) -> Response:
        return self._page_file(request.path_params.get("name", "index.html"))

    async def _watch(self, request: Request) -> Response:
        return self._page_file("watch.html")

    def _page_file(self, name: str) -> Response:
        file = self._files.get(name)
        if file is None:
            return refusal(404, "there is no such file of the page")
        return Response(file.content, media_type=file.media_type, headers=HEADERS)

    async def _health(self, request: Request) -> Response:
        source = self.registry.source_json()
        error = source["error"] or source["model_error"]
        state = self._service.supply.status.state
        failing = state == "failing" or (error is not None and state != "loading")
        status = "failing" if failing else "ok" if self._service.ready else "loading"
        rig = self._service.supply.rig
        health = {
            "status": status,
            "source": source["source"],
            "name": None if rig is None else rig.name,
            "model": self._config.model,
            "error": error,
            "viewers": len(self.registry.sessions),
            "version": __version__,
            "process": os.getpid(),
        }
        return JSONResponse(health, 503 if failing else 200)

    async def _metrics(self, request: Request) -> Response:
        return PlainTextResponse(metrics_text(self.registry), media_type="text/plain; version=0.0.4; charset=utf-8")

    async def _picture(self, request: Request) -> Response:
        asked = parse_query(dict(request.query_params), self._config.limits)
        if self._pictures >= PICTURES_AT_ONCE:
            return refusal(429, f"expected at most {PICTURES_AT_ONCE} pictures at once; ask again")
        job = PictureJob(asked)
        self._pictures += 1
        try:
            image, result = await self._wait(request, job, PICTURE_S)
        except (TimeoutError, RuntimeError) as error:
            return refusal(503, str(error) or "the frame did not come in time; see /health")
        finally:
            self._pictures -= 1
        timing = ", ".join(f"{stage};dur={ms:.1f}" for stage, ms in vars(result.times).items())
        headers = {"Server-Timing": timing, "X-Viewmend-Time": str(result.time), "Cache-Control": "no-store"}
        return Response(image, media_type="image/jpeg", headers=headers)

    async def _original(self, request: Request) -> Response:
        asked = parse_original(dict(request.query_params))
        if self._pictures >= PICTURES_AT_ONCE:
            return refusal(429, f"expected at most {PICTURES_AT_ONCE} pictures at once; ask again")
        supply, end = self._service.supply, time.monotonic() + ORIGINAL_S
        at = int(supply.span.clamp(self._service.edge if asked.time == "live" else asked.time))
        self._pictures += 1
        try:
            while (frame := supply.read(at)) is None:
                if time.monotonic() > end:
                    return refusal(503, "the frame did not come in time; see /health")
                await asyncio.sleep(0.05)
            image = await asyncio.to_thread(original_jpeg, frame, asked.name)
        finally:
            self._pictures -= 1
        headers = {"X-Viewmend-Time": str(at), "Cache-Control": "no-store"}
        return Response(image, media_type="image/jpeg", headers=headers)

    async def _progress(self, request: Request) -> Response:
        done, of = (None, None) if self._film is None else self._film.progress
        return JSONResponse({"done": done, "of": of}, headers={"Cache-Control": "no-store"})

    async def _export(self, request: Request) -> Response:
        if not can_write_mp4():
            return refusal(501, "videos need PyAV; install it, or viewmend's extra 'video'")
        if self._exporting:
            return refusal(409, "another path is being rendered; ask again")
        self._exporting = True
        try:
            body = await whole_body(request)
            if body is None:
                return refusal(413, f"expected at most {BODY_BYTES} bytes")
            # On a thread: a megabyte of JSON takes its time.
            job = PathJob(await asyncio.to_thread(parse_path, body, self._config.limits))
            self._film = job
            video = await self._wait(request, job, EXPORT_S)
        except (TimeoutError, RuntimeError) as error:
            return refusal(503, str(error) or "the path took too long; ask for fewer poses")
        finally:
            self._exporting, self._film = False, None
        return Response(video, media_type="video/mp4", headers={"Cache-Control": "no-store"})

    async def _film_file(self, request: Request) -> Response:
        if self._broadcast is None:
            return refusal(404, "this server does not broadcast; start it with --broadcast")
        return await film_answer(self._broadcast, request)

    async def _wait(self, request: Request, job: RenderJob[Result], limit_s: float) -> Result:
        """The job's result. A job is given up when its client goes."""
        self._service.join(job)
        end, waiting = time.monotonic() + limit_s, asyncio.wrap_future(job.done)
        try:
            while not waiting.done():
                await asyncio.wait([waiting], timeout=0.5)
                if not waiting.done() and (time.monotonic() > end or await request.is_disconnected()):
                    raise TimeoutError
            return waiting.result()
        finally:
            self._service.leave(job)
            job.done.cancel()

    async def _welcome(self, socket: WebSocket) -> bool:
        """Whether a socket may be accepted; a foreign page's, or one without the token, is refused in its handshake."""
        if foreign := self._guard.foreign_origin(socket):
            await socket.send_denial_response(refusal(403, foreign))
        elif await self._guard.lacks_token(socket):
            await socket.send_denial_response(refusal(401, TOKEN_WANTED))
        else:
            return True
        return False

    async def _viewer(self, socket: WebSocket) -> None:
        if await self._welcome(socket):
            admit(socket, 4 * self._config.limits.max_message_bytes)
            await socket.accept()
            await ViewerConnection(socket, self.registry).run()

    async def _push(self, socket: WebSocket) -> None:
        supply = self._service.supply
        if not await self._welcome(socket):
            return
        if not isinstance(supply, PushedFrames) or self._pushing:
            shows = "reads its own cameras" if supply.span.live else "shows a recording"
            reason = "another rig is pushing" if self._pushing else f"this server {shows}; start viewmend serve live"
            await socket.send_denial_response(refusal(409, reason))
            return
        self._pushing = True
        try:
            admit(socket, HEADER_BYTES)
            await socket.accept()
            await receive_rig(socket, supply)
        except (WebSocketDisconnect, RuntimeError):  # gone, maybe while its frame was decoded
            pass
        finally:
            self._pushing = False
            supply.lost()
