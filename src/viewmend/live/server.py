"""The live server's routes, over HTTP and WebSocket."""

import asyncio
import contextlib
import functools
import os
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import asdict, dataclass, field
from typing import Any
from urllib.parse import urlsplit

import torch
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import BaseRoute, Mount, Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from viewmend import __version__
from viewmend.geometry.orbit import coarse_surface
from viewmend.live import render_jobs, responses
from viewmend.live.assets import NOT_IN_TIME, AssetQuery, AssetStore, BusyError, frame_key, wait_for_frame
from viewmend.live.auth import AccessControl
from viewmend.live.connection import ViewerConnection
from viewmend.live.connection_limits import authenticate
from viewmend.live.extension import Extension
from viewmend.live.protocol import HEADER_BYTES, Limits, ProtocolError, read_message
from viewmend.live.push import PushSource, receive_rig
from viewmend.live.registry import SessionRegistry
from viewmend.live.render_jobs import ImageQuery, PathJob, RenderJob, Result, SourceImageQuery, TurntableQuery
from viewmend.live.responses import HEADERS, MAX_BODY_BYTES, asset_response, error_response, page_files
from viewmend.live.service import RenderService
from viewmend.live.video import video_codecs
from viewmend.models.checkpoint import shipped_models
from viewmend.utils.plugins import import_object

IMAGE_S = 60.0
"""Time limit of a single image, seconds."""
SOURCE_IMAGE_S = 5.0
"""Time limit of a camera's own image, seconds."""
EXPORT_S = 3600.0
"""Time limit of a camera path, seconds."""
MAX_IMAGES = 4
"""Number of single images that are rendered at the same time."""
TOKEN_EXPECTED = "expected the token, as 'Authorization: Bearer TOKEN' or ?token=TOKEN"
TOO_MANY_IMAGES = f"expected at most {MAX_IMAGES} images at a time; try again"
EXTENSIONS = {
    "broadcast": "viewmend.contrib.broadcast.extension:broadcast_extension",
}
"""Optional parts of the server: MODULE:FUNCTION of each, imported on demand. The function is called
with the option's value, checks it, and returns an `ExtensionFactory`."""
ExtensionFactory = Callable[[RenderService, "ServerConfig"], Extension]
"""Makes an extension of a server with this service and config."""


@dataclass(frozen=True, kw_only=True)
class ServerConfig:
    """Address and limits of a server."""

    host: str = "127.0.0.1"
    port: int = 8008
    token: str | None = None
    public_url: str | None = None
    """The address at which a proxy serves this server; it may have a path."""
    budget_ms: float | None = 100.0
    model: str = "views"
    """The model's name in `welcome` and /health."""
    draws_in_page: bool = True
    """Whether pages draw moving views by themselves."""
    limits: Limits = field(default_factory=Limits)
    extensions: tuple[ExtensionFactory, ...] = ()

    def __post_init__(self) -> None:
        if not 0 <= self.port <= 65535:
            raise ValueError(f"expected a port from 0 to 65535, got {self.port}; 0 takes a free one")
        if self.budget_ms is not None and not self.budget_ms > 0:
            raise ValueError(f"expected a budget_ms above 0, or None for no limit, got {self.budget_ms}")


def load_extension(name: str, value: Any) -> ExtensionFactory:
    """Prepare an optional part of the server with the value of its option; ValueError or OSError if it cannot."""
    return import_object(EXTENSIONS[name])(value)


class LiveServer:
    """The routes, and what they share."""

    def __init__(self, service: RenderService, config: ServerConfig) -> None:
        self._service = service
        self._config = config
        self._access = AccessControl(config.host, config.token, config.public_url)
        self._files = page_files()
        self.assets = AssetStore(service.source.read, service.renderer.make_assets)
        self._images = asyncio.Semaphore(MAX_IMAGES)
        self._is_exporting = False
        self._path_job: PathJob | None = None
        self._is_pushing = False
        self.extensions = [make(service, config) for make in config.extensions]
        about: dict[str, Any] = {
            "server": f"viewmend {__version__}",
            "model": config.model,
            "budget_ms": config.budget_ms,
            "limits": asdict(config.limits),
            "codecs": ["jpeg", *video_codecs()],
            "models": [name for name in shipped_models() if name != config.model],
            "token_needed": bool(config.token),
            "broadcast": False,
        }
        for extension in self.extensions:
            about |= extension.welcome_json()
        self.registry = SessionRegistry(service, config.limits, config.budget_ms, about, self.extensions)

    def app(self) -> Starlette:
        """The ASGI application; its lifespan starts and stops the service."""
        page = self._guard(self._page, needs_token=False)  # the page's files are public
        routes: list[BaseRoute] = [
            Route("/", page),
            Route("/page/{name:path}", page),
            Route("/watch", self._guard(functools.partial(self._page, name="watch.html"), needs_token=False)),
            Route("/health", self._guard(self._health)),
            Route("/metrics", self._guard(self._metrics)),
            Route("/frame.jpg", self._guard(self._image)),
            Route("/camera.jpg", self._guard(self._source_image)),
            Route("/assets/{time}", self._guard(self._asset)),
            Route("/assets/{time}/{camera}", self._guard(self._asset)),
            Route("/turntable", self._guard(self._turntable)),
            Route("/path", self._guard(self._progress)),
            Route("/path.mp4", self._guard(self._export), methods=["POST"]),
            WebSocketRoute("/ws", self._viewer),
            WebSocketRoute("/push", self._push),
        ]
        for extension in self.extensions:
            routes += [Route(path, self._guard(handler)) for path, handler in extension.routes().items()]
        prefix = urlsplit(self._config.public_url or "").path.rstrip("/")
        if prefix:  # of a proxy that does not remove it
            routes.append(Mount(prefix, routes=list(routes)))
        return Starlette(routes=routes, lifespan=self._run)

    @contextlib.asynccontextmanager
    async def _run(self, app: Starlette) -> AsyncIterator[None]:
        self._service.start()
        try:
            async with contextlib.AsyncExitStack() as stack:
                for extension in self.extensions:
                    await stack.enter_async_context(extension.running())
                yield
        finally:
            await asyncio.to_thread(self._service.stop)

    def _guard(
        self, handler: Callable[[Request], Awaitable[Response]], needs_token: bool = True
    ) -> Callable[[Request], Awaitable[Response]]:
        """Refuse requests from other sites' pages or without the token, and turn errors into responses."""

        async def guarded(request: Request) -> Response:
            foreign = self._access.find_foreign_origin(request)
            if foreign:
                return error_response(403, foreign)
            if await self._access.has_token(request):
                authenticate(request)
            elif needs_token:
                return error_response(401, TOKEN_EXPECTED)
            try:
                return await handler(request)
            except ProtocolError as error:
                return error_response(400, str(error))
            except BusyError as error:
                return error_response(429, str(error))
            except (TimeoutError, render_jobs.RenderError) as error:
                return error_response(503, str(error))

        return guarded

    async def _page(self, request: Request, name: str = "index.html") -> Response:
        file = self._files.get(request.path_params.get("name", name))
        if file is None:
            return error_response(404, "the page has no such file")
        return Response(file.content, media_type=file.media_type, headers=HEADERS)

    async def _health(self, request: Request) -> Response:
        source = self.registry.source_json()
        error = source["error"] or source["model_error"]
        state = self._service.source.status.state
        failing = state == "failing" or (error is not None and state != "loading")
        rig = self._service.source.rig
        health = {
            "status": "failing" if failing else "ok" if self._service.is_ready else "loading",
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
        text = responses.metrics_text(self.registry)
        return PlainTextResponse(text, media_type="text/plain; version=0.0.4; charset=utf-8")

    async def _image(self, request: Request) -> Response:
        asked: ImageQuery = read_message(dict(request.query_params), ImageQuery, strict=False)
        self._config.limits.check_size(asked.width, asked.height)
        renderer = self._service.renderer
        if renderer.rig_json is not None:
            names = [camera["name"] for camera in renderer.rig_json["cameras"]]
            if asked.camera is not None and asked.camera not in names:
                raise ProtocolError(
                    f"expected a camera among {', '.join(names)[:200]}, got '{asked.camera[:40]}'"
                )
            try:
                renderer.left_out(asked.left_out)
            except ValueError as error:
                raise ProtocolError(str(error)) from None
        async with self._image_slot():
            image, result = await self._wait(request, render_jobs.ImageJob(asked), IMAGE_S, NOT_IN_TIME)
        timing = ", ".join(f"{stage};dur={ms:.1f}" for stage, ms in vars(result.times).items())
        headers = {"Server-Timing": timing, "X-Viewmend-Time": str(result.time), "Cache-Control": "no-store"}
        if result.psnr_db is not None:
            headers["X-Viewmend-PSNR"] = f"{result.psnr_db:.3f}"
        return Response(image, media_type="image/jpeg", headers=headers)

    def _image_slot(self) -> asyncio.Semaphore:
        """The semaphore to hold while a single image is rendered; BusyError if too many images are."""
        if self._images.locked():
            raise BusyError(TOO_MANY_IMAGES)
        return self._images

    async def _source_image(self, request: Request) -> Response:
        asked: SourceImageQuery = read_message(dict(request.query_params), SourceImageQuery, strict=False)
        async with self._image_slot():
            source = self._service.source
            index = int(source.span.clamp(source.edge if asked.time == "live" else asked.time))
            frame = await wait_for_frame(source.read, index, SOURCE_IMAGE_S)
            image = await asyncio.to_thread(render_jobs.source_jpeg, frame, asked.name)
        headers = {"X-Viewmend-Time": str(index), "Cache-Control": "no-store"}
        return Response(image, media_type="image/jpeg", headers=headers)

    async def _turntable(self, request: Request) -> Response:
        asked: TurntableQuery = read_message(dict(request.query_params), TurntableQuery, strict=False)
        self._config.limits.check_size(asked.width, asked.height)
        source = self._service.source
        home = self._service.renderer.home
        if home is None or source.rig is None:
            return error_response(503, "there is no frame yet; see /health")
        points = []
        async with self._image_slot():
            for index in asked.moments(source.span):
                frame = await wait_for_frame(source.read, index, SOURCE_IMAGE_S)
                assert frame.mask is not None, "frames with geometry have masks"
                try:
                    points.append(
                        await asyncio.to_thread(coarse_surface, frame.mask, frame.cameras, source.rig.bounds)
                    )
                except ValueError as error:
                    return error_response(503, str(error))
                if await request.is_disconnected():
                    break
        if not any(map(len, points)):
            return error_response(503, "there is no subject in these frames; choose others")
        fitted = render_jobs.frame_motion(asked, torch.cat(points), home)
        return JSONResponse(fitted, headers={"Cache-Control": "no-store"})

    async def _asset(self, request: Request) -> Response:
        given = {**request.query_params, **request.path_params}
        asked: AssetQuery = read_message(given, AssetQuery, strict=False)
        span = self._service.source.span
        version = self._service.renderer.assets_version
        if version is None or not span.first <= asked.time < span.end:
            available = "that exists (there is none yet)"
            if span.first < span.end:
                available = f"from {span.first} to {span.end - 1}"
            return error_response(404, f"expected a frame {available}, got {asked.time}; see /health")
        try:
            without = self._service.renderer.left_out(asked.without.split(","))
            made = await self.assets.get(asked.time, version, without)
            key = frame_key(asked.time, without)
            self._service.ahead.note_drawn(key)
        except ValueError as error:
            return error_response(404, f"this frame cannot be drawn: {error}"[:400])
        if asked.camera is None:
            asset = made.shape
        elif asked.camera == "mesh":
            asset = self._service.ahead.mesh(key)
        elif asked.camera < len(made.images):
            asset = made.images[asked.camera]
        else:
            asset = self._service.ahead.image(key, asked.camera)
        if asset is None:
            return error_response(
                404,
                f"expected a camera from 0 to {len(made.images) - 1}, or a completed view or mesh that was "
                f"made, got {asked.camera}",
            )
        return asset_response(request, asset, is_final=asked.v == version)

    async def _progress(self, request: Request) -> Response:
        done, of = (None, None) if self._path_job is None else self._path_job.progress
        return JSONResponse({"done": done, "of": of}, headers={"Cache-Control": "no-store"})

    async def _export(self, request: Request) -> Response:
        if self._is_exporting:
            return error_response(409, "another path is being rendered; try again later")
        self._is_exporting = True
        try:
            body = await responses.read_body(request)
            if body is None:
                return error_response(
                    413, f"expected a body of at most {MAX_BODY_BYTES} bytes; send fewer poses"
                )
            # Parsed on a thread, as a megabyte of JSON would block the event loop.
            job = PathJob(await asyncio.to_thread(render_jobs.parse_path, body, self._config.limits))
            self._path_job = job
            video = await self._wait(request, job, EXPORT_S, "the path took too long; request fewer poses")
        finally:
            self._is_exporting = False
            self._path_job = None
        return Response(video, media_type="video/mp4", headers={"Cache-Control": "no-store"})

    async def _wait(self, request: Request, job: RenderJob[Result], limit_s: float, late: str) -> Result:
        """The result of a job; TimeoutError with the message `late` after the limit, or if the client disconnects."""
        self._service.join(job)
        end = time.monotonic() + limit_s
        result = asyncio.wrap_future(job.done)
        try:
            while not result.done():
                await asyncio.wait([result], timeout=0.5)
                if not result.done() and (time.monotonic() > end or await request.is_disconnected()):
                    raise TimeoutError(late)
            return result.result()
        finally:
            self._service.leave(job)
            job.done.cancel()

    async def _check(self, socket: WebSocket) -> bool:
        """Whether a WebSocket may be accepted; if not, its handshake is answered by the reason."""
        foreign = self._access.find_foreign_origin(socket)
        if foreign:
            await socket.send_denial_response(error_response(403, foreign))
        elif not await self._access.has_token(socket):
            await socket.send_denial_response(error_response(401, TOKEN_EXPECTED))
        else:
            return True
        return False

    async def _viewer(self, socket: WebSocket) -> None:
        if await self._check(socket):
            authenticate(socket, 4 * self._config.limits.max_message_bytes)
            await socket.accept()
            await ViewerConnection(socket, self.registry).run()

    async def _push(self, socket: WebSocket) -> None:
        source = self._service.source
        if not await self._check(socket):
            return
        if not isinstance(source, PushSource) or self._is_pushing:
            kind = "reads its own cameras" if source.span.live else "plays a recording"
            reason = (
                "another rig is pushing"
                if self._is_pushing
                else f"this server {kind}; start viewmend serve live"
            )
            await socket.send_denial_response(error_response(409, reason))
            return
        self._is_pushing = True
        try:
            authenticate(socket, HEADER_BYTES)
            await socket.accept()
            await receive_rig(socket, source)
        except (WebSocketDisconnect, RuntimeError):  # the rig has gone, maybe while a frame was decoded
            pass
        finally:
            self._is_pushing = False
            source.disconnect()
