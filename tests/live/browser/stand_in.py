"""A server that speaks docs/live-protocol.md with a synthetic scene, for quick tests of the page alone."""

import asyncio
import io
import json
import threading
import time
from dataclasses import dataclass, field

import cv2
import numpy as np
import torch
import uvicorn
from live.browser import scene
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from viewmend.data.videos import write_mp4
from viewmend.live.encoding import pack_depth, to_jpeg
from viewmend.live.protocol import pack
from viewmend.live.responses import HEADERS, page_files
from viewmend.live.video import STRINGS, VideoStream

MODES = ["rendered", "holes", "completed", "depth", "coverage", "confidence", "hull", "points"]
LIMITS = {
    "max_side_px": 1024,
    "max_pixels": 700_000,
    "max_message_bytes": 65536,
    "messages_per_s": 240,
    "viewers": 4,
}


@dataclass
class Seen:
    """One viewer, and what it said."""

    socket: WebSocket
    loop: asyncio.AbstractEventLoop
    look: dict | None = None
    time: float = 0.0
    playing: bool = False
    live: bool = True
    speed: float = 1.0
    greeted: bool = False
    silent: bool = False
    """True is as if the network had gone: nothing is sent, and nothing is heard."""
    acknowledged: int = 0
    sent: int = 0
    answered: tuple = ()


@dataclass
class StandIn:
    """The server, in a thread of its own; tests read what it heard and change what it says."""

    playing: bool = False
    ground: str = "000000"
    """What the model would paint upon."""
    video: bool = True
    source: str = "ready"
    error: str | None = None
    model_error: str | None = None
    confidence: float | None = 0.9
    hold: bool = False
    """True sends no frames."""
    refuse: int | None = None
    """A code to close new sockets with."""
    broken: bool = False
    """True sends pictures that cannot be decoded."""
    frames: int = scene.FRAMES
    film_hold: bool = False
    """True lets films end half-way, and stay there."""
    film: tuple[int | None, int | None] = (None, None)
    originals: list[dict] = field(default_factory=list)
    looks: list[dict] = field(default_factory=list)
    clocks: list[dict] = field(default_factory=list)
    paths: list[dict] = field(default_factory=list)
    turntables: list[dict] = field(default_factory=list)
    hellos: list[dict] = field(default_factory=list)
    viewers: list[Seen] = field(default_factory=list)

    def __enter__(self) -> "StandIn":
        self.files = page_files()
        routes = [Route("/", self._file), Route("/page/{name:path}", self._file)]
        routes += [Route("/path", self._progress), Route("/camera.jpg", self._original)]
        routes += [Route("/turntable", self._turntable), Route("/frame.jpg", self._scored)]
        routes += [Route("/path.mp4", self._film, methods=["POST"]), WebSocketRoute("/ws", self._viewer)]
        config = uvicorn.Config(
            Starlette(routes=routes),
            port=0,
            log_config=None,
            log_level="error",
            ws="websockets-sansio",
            lifespan="off",
        )
        self.server = uvicorn.Server(config)
        self.thread = threading.Thread(target=self.server.run, daemon=True)
        self.thread.start()
        while not self.server.started:
            time.sleep(0.01)
        self.port = self.server.servers[0].sockets[0].getsockname()[1]
        return self

    def __exit__(self, *exception: object) -> None:
        self.drop()
        self.server.should_exit = True
        self.thread.join(5)

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}/"

    def drop(self) -> None:
        """Break all connections."""
        for viewer in self.viewers:
            asyncio.run_coroutine_threadsafe(viewer.socket.close(1011), viewer.loop)

    async def _file(self, request: Request) -> Response:
        file = self.files.get(request.path_params.get("name", "index.html"))
        if file is None:
            return JSONResponse({"error": "no such file"}, 404)
        return Response(file.content, media_type=file.media_type, headers=HEADERS)

    async def _film(self, request: Request) -> Response:
        body = json.loads(await request.body())
        self.paths.append(body)
        while self.film_hold:
            self.film = (len(body["poses"]) // 2, len(body["poses"]))
            await asyncio.sleep(0.05)
            if await request.is_disconnected():
                self.film = (None, None)
                return Response()
        return Response(await asyncio.to_thread(film, body), media_type="video/mp4")

    async def _progress(self, request: Request) -> Response:
        return JSONResponse(dict(zip(("done", "of"), self.film, strict=True)))

    async def _turntable(self, request: Request) -> Response:
        self.turntables.append(dict(request.query_params))
        return JSONResponse({"target": [0.0, 0.1, 0.0], "distance": 2.5, "f": 600.0})

    async def _original(self, request: Request) -> Response:
        asked = dict(request.query_params)
        self.originals.append(asked)
        image = scene.original(asked["name"], int(asked["time"]))
        return Response(cv2.imencode(".jpg", image[..., ::-1])[1].tobytes(), media_type="image/jpeg")

    async def _scored(self, request: Request) -> Response:
        asked = dict(request.query_params)
        image = scene.original(asked["camera"], int(asked["time"]))
        content = cv2.imencode(".jpg", image[..., ::-1])[1].tobytes()
        return Response(content, media_type="image/jpeg", headers={"X-Viewmend-PSNR": "25.0"})

    async def _viewer(self, socket: WebSocket) -> None:
        await socket.accept()
        if self.refuse is not None:
            await socket.close(self.refuse)
            return
        viewer = Seen(socket, asyncio.get_running_loop(), playing=self.playing)
        self.viewers.append(viewer)
        talk = asyncio.create_task(self._talk(viewer))
        try:
            while True:
                await self._hear(viewer, json.loads(await socket.receive_text()))
        except (WebSocketDisconnect, RuntimeError):
            talk.cancel()
        finally:
            self.viewers.remove(viewer)

    async def _hear(self, viewer: Seen, message: dict) -> None:
        kind = message["type"]
        if viewer.silent:
            return
        if kind == "hello":
            self.hellos.append(message)
            codecs = [c for c in message["codecs"] if c == "jpeg" or self.video]
            about = {
                "version": 1,
                "viewer": 1,
                "server": "stand-in",
                "model": "none",
                "modes": MODES,
                "codecs": codecs,
            }
            about |= {
                "error_rules": ["holes", "all", "yours"],
                "error_rule": "all",
                "background": self.ground,
            }
            more = {"budget_ms": None, "limits": LIMITS, "token_needed": False}
            await viewer.socket.send_json({"type": "welcome", **about, **more})
            await viewer.socket.send_json(scene.rig())
            viewer.greeted = True
        elif kind == "look":
            self.looks.append(message)
            viewer.look = message
        elif kind == "ack":
            viewer.acknowledged = message["frame"]
        elif kind == "clock":
            self.clocks.append(message)
            viewer.playing = message.get("playing", viewer.playing)
            viewer.speed = message.get("speed", viewer.speed)
            viewer.time = float(message.get("seek", viewer.time))
            if "seek" in message or viewer.speed != 1 or not viewer.playing:
                viewer.live = False
            if message.get("live"):
                viewer.live, viewer.playing, viewer.speed = True, True, 1.0

    async def _talk(self, viewer: Seen) -> None:
        last, told = time.monotonic(), 0.0
        while not viewer.silent:
            now = time.monotonic()
            if viewer.playing:
                viewer.time = (viewer.time + 10 * viewer.speed * (now - last)) % scene.FRAMES
            last = now
            if viewer.greeted and now - told > 0.1:
                told = now
                await viewer.socket.send_json(self._state(viewer))
            if viewer.look and not self.hold and viewer.acknowledged == viewer.sent:
                wanted = (viewer.look["id"], int(viewer.time))
                if wanted != viewer.answered:
                    viewer.answered = wanted
                    viewer.sent += 1
                    await viewer.socket.send_bytes(await asyncio.to_thread(self._frame, viewer))
            await asyncio.sleep(0.005)

    def _state(self, viewer: Seen) -> dict:
        source = {"source": self.source, "error": self.error, "model_error": self.model_error}
        span = {"first": 0, "end": self.frames, "total": self.frames, "loops": True, "kind": "recording"}
        clock = {
            "time": int(viewer.time),
            "playing": viewer.playing,
            "speed": viewer.speed,
            "live": viewer.live,
        }
        return {"type": "state", **source, **span, **clock, "behind": 0, "buffering": False}

    def _frame(self, viewer: Seen) -> bytes:
        look, now = dict(viewer.look or {}), int(viewer.time)
        eyes = look.get("eyes") or [look["camera"]]
        part = 0.5 if look.get("moving") and look.get("adaptive", True) else 1.0
        width, height = (max(16, 2 * int(part * look[side] / 2)) for side in ("width", "height"))
        parts, data, cameras, share = [], [], [], 0.0
        for eye, camera in enumerate(eyes):
            x, y = width / look["width"], height / look["height"]
            lens = {
                "fx": camera["fx"] * x,
                "fy": camera["fy"] * y,
                "cx": camera["cx"] * x,
                "cy": camera["cy"] * y,
            }
            K = [lens["fx"], 0, lens["cx"], 0, lens["fy"], lens["cy"], 0, 0, 1]
            cameras.append({"K": K, "R": camera["R"], "T": camera["T"]})
            rgb, z, points = scene.render({**camera, **lens}, width, height, now)
            share = scene.hole_share(z, points)
            for mode in look.get("modes", ["completed"]):
                image = scene.picture(rgb, z, points, mode)
                image[z == 0] = tuple(bytes.fromhex(look.get("background", "000000")))
                about, content = self._encode(image, look.get("codec", "jpeg"))
                parts.append({"kind": "image", "eye": eye, "mode": mode, **about})
                data.append(content)
            if look.get("depth"):
                about, content = depth_part(z, 2)
                parts.append({"eye": eye, **about})
                data.append(content)
        header = {
            "frame": viewer.sent,
            "look": look["id"],
            "sent_ms": look["sent_ms"],
            "time": now,
            "width": width,
        }
        header |= {"height": height, "full": part == 1.0, "cameras": cameras, "holes": share}
        header |= {
            "source_views": scene.SOURCES,
            "input_views": scene.INPUTS,
            "top_k": look.get("top_k"),
            "context_times": 3,
            "dropped": 0,
        }
        header |= {"colours": scene.COLOURS, "confidence": self.confidence}
        stages = {"geometry": 8.0, "context": 4.0, "rendering": 6.0, "encode": 2.0}
        stages["inpainting"] = 30.0 + 10 * np.sin(now)
        header["stage_ms"] = {**stages, "wait": 1.0, "total": sum(stages.values()) + 1}
        header["parts"] = [
            about | {"bytes": len(content)} for about, content in zip(parts, data, strict=True)
        ]
        return pack(header, data)

    def _encode(self, image: np.ndarray, codec: str) -> tuple[dict, bytes]:
        data = to_jpeg(image, 92) if codec == "jpeg" else VideoStream().encode(image, codec, key=True)[0]
        about = {"codec": codec, "key": True, "codec_string": STRINGS.get(codec)}
        return about, b"\xff\xd8broken" if self.broken else data


def depth_part(z: np.ndarray, stride: int) -> tuple[dict, bytes]:
    packed = vars(pack_depth(torch.from_numpy(z), stride)).copy()
    data = packed.pop("data")
    return {"kind": "depth", "encoding": "u16-delta-zlib", **packed}, data


def film(body: dict) -> bytes:
    """The posted path as MP4."""
    file, eyes = io.BytesIO(), 1 if body["stereo_m"] is None else 2
    images = (
        scene.picture(*scene.render(pose, body["width"], body["height"], now), body["mode"])
        for pose, now in zip(body["poses"], body["times"], strict=True)
    )
    write_mp4(file, (np.hstack([image] * eyes) for image in images), float(body["fps"]))
    return file.getvalue()
