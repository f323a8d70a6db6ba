"""A performance as a folder of static files, which the live page's code draws without a server."""

import html
import json
import secrets
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import torch
from jaxtyping import Float
from torch import Tensor

from viewmend.completed_cameras import MAX_COMPLETED, complete_views, place_around, with_finer_images
from viewmend.data.source import resize_frame, scale_cameras
from viewmend.frame_cache import CachedFrame
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras
from viewmend.geometry.mesh import simplify, vertex_normals
from viewmend.geometry.proxy import GeometryProxy
from viewmend.live.assets import FrameAssets, make_assets
from viewmend.live.encoding import draw_mode
from viewmend.live.poses import HomeView, bounds_json, home_view, rig_json, view_camera
from viewmend.live.protocol import Camera
from viewmend.live.responses import page_files
from viewmend.rendering.view import RenderConfig
from viewmend.stream import Stream
from viewmend.types import MultiViewFrame

RESULTS = ("index.html", "scene.json", "poster.jpg", "page", "frames")
"""Files and folders of a published performance."""
LIVE_FILES = (
    "index.html",
    "main.js",
    "watch.html",
    "watch.js",
    "style/watch.css",
    "link/connection.js",
    "link/segments.js",
    "link/viewer.js",
    "link/worker.js",
    "ui/film.js",
)
"""Files of the live page that a published one does not need; index.html is adapted."""
LEVELS = (
    (80, 1.0, 0.0),
    (75, 0.85, 0.0),
    (70, 0.7, 0.010),
    (60, 0.6, 0.014),
    (55, 0.5, 0.018),
    (50, 0.4, 0.022),
    (45, 0.3, 0.028),
)
"""The levels of detail, the finest first: the fields of a `Detail`."""
POSTER_PX = 720
"""Width and height of the poster."""
POSTER_QUALITY = 85
"""JPEG quality of the poster."""
DEFAULT_FPS = 10.0
"""Frames per second of a capture that does not state them."""
SCENE_BYTES = 100_000
"""Bytes that are reserved for scene.json."""
FILE_NOTICE = (
    "Run python -m http.server in this folder, then open http://localhost:8000: files need a web server"
)
"""What the page says when it was opened as a file."""


@dataclass(frozen=True)
class Detail:
    """How finely a frame is encoded."""

    jpeg_quality: int
    """Quality of the images, up to 100."""
    image_scale: float
    """The images' sides are multiplied by this."""
    mesh_cell: float
    """Vertices within a cube become one, whose side is this share of the longest side of the subject's
    box; 0: all vertices are kept."""


@dataclass(frozen=True)
class PublishedSize:
    """What was written."""

    frames: int
    size_bytes: int
    """Bytes of all files."""
    first_bytes: int
    """Bytes of the page and of all files of the first frame."""
    detail: Detail
    """The coarsest level of detail that was needed."""


@dataclass(frozen=True, kw_only=True)
class PublishConfig:
    """What a published performance contains."""

    title: str
    max_mb: float
    """All files together have at most this size, megabytes."""
    completed_cameras: int
    """Number of completed virtual cameras in every frame."""
    fps: float = DEFAULT_FPS
    """Frames per second of the playback."""

    def __post_init__(self) -> None:
        if self.completed_cameras > MAX_COMPLETED:
            raise ValueError(
                f"expected at most {MAX_COMPLETED} completed cameras, got {self.completed_cameras}"
            )


class SizeBudget:
    """Encodes frames one after the other, so that all together fit.

    A frame may take an equal share of what is left.
    """

    def __init__(self, bytes_left: float, frames: int) -> None:
        self._bytes_left = bytes_left
        self._frames_left = frames
        self.level = 0
        """The level of the last frame; it never gets finer again, so that a performance does not flicker."""

    def encode(
        self, cached: CachedFrame, completed: MultiViewFrame | None, render: RenderConfig
    ) -> FrameAssets:
        """The frame at the finest level that fits.

        Raises:
            ValueError: it does not fit at the coarsest level.
        """
        share = self._bytes_left / self._frames_left
        needed_bytes = 0
        for level in range(self.level, len(LEVELS)):
            assets = encode_frame(cached, completed, render, Detail(*LEVELS[level]))
            needed_bytes = assets.size_bytes
            if needed_bytes <= share:
                self.level = level
                self._bytes_left -= needed_bytes
                self._frames_left -= 1
                return assets
        needed_mb = needed_bytes * self._frames_left / 1e6
        raise ValueError(
            f"expected frames that fit into the size limit, got {needed_mb:.2f} MB for {self._frames_left} "
            f"frames at the lowest quality where {self._bytes_left / 1e6:.2f} MB are left; raise --max-mb, or "
            "use fewer --frames or --completed-cameras"
        )


def encode_frame(
    cached: CachedFrame, completed: MultiViewFrame | None, render: RenderConfig, detail: Detail
) -> FrameAssets:
    """A frame's mesh and images at a level of detail."""
    proxy = cached.proxy
    assert isinstance(proxy, GeometryProxy), "streams compute hulls"
    proxy = proxy.to("cpu")
    if detail.mesh_cell:
        mesh = simplify(proxy.mesh, detail.mesh_cell * float(proxy.bounds.size_m.max()))
        proxy = replace(proxy, mesh=mesh, normals=vertex_normals(mesh))
    frame = _scaled(cached.frame.to("cpu"), detail.image_scale)
    more = None if completed is None else _scaled(completed, detail.image_scale)
    return make_assets(frame, proxy, render, more, detail.jpeg_quality)


def _scaled(frame: MultiViewFrame, scale: float) -> MultiViewFrame:
    return resize_frame(frame, scale_cameras(frame.cameras, scale))


class _Motion:
    """The box that the subject fills over all frames."""

    def __init__(self) -> None:
        self.low = torch.full((3,), torch.inf)
        self.high = torch.full((3,), -torch.inf)

    def add(self, vertices: Float[Tensor, "vertex 3"]) -> None:
        """Extend the box by a frame's vertices."""
        if len(vertices):
            self.low = torch.minimum(self.low, vertices.amin(0).cpu())
            self.high = torch.maximum(self.high, vertices.amax(0).cpu())

    @property
    def box(self) -> Bounds | None:
        """The box; None if no frame had a vertex."""
        return Bounds(self.low, self.high) if bool((self.low < self.high).all()) else None


def publish(
    frames: Iterable[MultiViewFrame],
    count: int,
    stream: Stream,
    first: CachedFrame,
    rig: Cameras,
    up: Float[Tensor, "3"] | None,
    out: Path,
    config: PublishConfig,
) -> PublishedSize:
    """Write a performance into the folder `out`.

    Args:
        frames: the capture, frame by frame, on the stream's device.
        count: the number of frames.
        stream: computes the geometry and completes views.
        first: a frame of the stream that shows the subject; the initial view looks at it, and the
            poster shows it.
        rig: the capture's cameras, also those without an image in the first frame.
        up: the capture's up direction; None to estimate it from the cameras.
        out: the folder.
        config: what the folder contains.

    Raises:
        ValueError: the files do not fit into the size limit, or no frame shows a subject.
        OSError: a file cannot be written.
    """
    rig = rig.to("cpu")
    assert isinstance(first.proxy, GeometryProxy), "streams compute hulls"
    home = home_view(rig, first.proxy.center, up)
    poses: Cameras | None = None
    if config.completed_cameras:
        poses = with_finer_images(place_around(rig, first.proxy.center, up, config.completed_cameras))
    version = secrets.token_hex(4)
    page_bytes = _write_page(out, config.title, count > 1, version) + _write_poster(
        out, stream, home, first.frame.time
    )
    budget = SizeBudget(1e6 * config.max_mb - page_bytes - SCENE_BYTES, count)
    motion = _Motion()
    frame_bytes: list[int] = []
    for number, frame in enumerate(frames):
        cached = stream.add_frame(frame)
        assert isinstance(cached.proxy, GeometryProxy), "streams compute hulls"
        motion.add(cached.proxy.mesh.vertices)
        completed = None if poses is None else complete_views(stream, cached, poses)
        assets = budget.encode(cached, completed, stream.config.render)
        _write_frame(out / "frames" / str(number), assets)
        frame_bytes.append(assets.size_bytes)
    if motion.box is None:
        raise ValueError("expected a frame that shows a subject, got none; choose other --frames")
    fps = config.fps if count > 1 else None
    rig_message = rig_json(config.title, rig, motion.box, home, fps, version)
    scene = {"rig": rig_message, "frames": len(frame_bytes), "motion": bounds_json(motion.box)}
    text = json.dumps(scene, separators=(",", ":"), allow_nan=False).encode()
    (out / "scene.json").write_bytes(text)
    start_bytes = page_bytes + len(text)
    return PublishedSize(
        len(frame_bytes),
        start_bytes + sum(frame_bytes),
        start_bytes + frame_bytes[0],
        Detail(*LEVELS[budget.level]),
    )


def _write_page(out: Path, title: str, moves: bool, version: str) -> int:
    """Write the page; returns its size in bytes."""
    files = page_files()
    written = 0
    for name, file in files.items():
        if name not in LIVE_FILES:
            path = out / "page" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(file.content)
            written += len(file.content)
    modules = [
        name for name in files if name.endswith(".js") and name not in LIVE_FILES and "worker" not in name
    ]
    page = published_html(files["index.html"].content.decode(), title, modules, moves, version).encode()
    (out / "index.html").write_bytes(page)
    return written + len(page)


def published_html(live_html: str, title: str, modules: Sequence[str], moves: bool, version: str) -> str:
    """The page of a published performance, from the live one.

    Args:
        live_html: the live page.
        title: the performance's title, as text.
        modules: the scripts to load at once, by their paths.
        moves: whether there are several frames, and hence a time line.
        version: differs between performances, so that no poster of an earlier one comes from a cache.
    """
    text = html.escape(title)
    preload = "\n".join(f'  <link rel="modulepreload" href="page/{name}">' for name in modules)
    scripts = f"""{preload}
  <script type="module" src="page/published.js"></script>
  <meta property="og:title" content="{text}">
  <meta property="og:image" content="poster.jpg">"""
    kind = "poster" if moves else "poster still"
    poster = f"""    <img class="{kind}" id="poster" src="poster.jpg?v={version}" alt="{text}">
    <div class="labels" id="labels">"""
    says = f'document.getElementById("cover-title").textContent = "{FILE_NOTICE}"'
    file_script = f'if (location.protocol === "file:") {says};'
    notice = f"<noscript>This page needs JavaScript.</noscript>\n  <script>{file_script}</script>"
    changes = {
        '<html lang="en">': '<html lang="en" data-source="published">',
        "<title>viewmend live</title>": f"<title>{text}</title>",
        "Free-viewpoint viewer for live and recorded captures.": f"Free-viewpoint video: {text}.",
        '  <script type="module" src="page/main.js"></script>': scripts,
        '    <div class="labels" id="labels">': poster,
        "<noscript>This page needs JavaScript.</noscript>": notice,
    }
    for live, published in changes.items():
        assert live_html.count(live) == 1, f"the live page has one {live}"
        live_html = live_html.replace(live, published)
    return live_html


def _write_poster(out: Path, stream: Stream, home: HomeView, time: int) -> int:
    """Write the initial view, completed; returns its size in bytes."""
    camera = view_camera(Camera(azimuth=home.azimuth, elevation=home.elevation), home, (POSTER_PX, POSTER_PX))
    device = stream.cached_frame(time).frame.rgb.device
    image = draw_mode(stream.view(camera.to(device), time=time).completed, "completed")
    bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    done, jpeg = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, POSTER_QUALITY])
    assert done, "8-bit images can be encoded"
    (out / "poster.jpg").write_bytes(jpeg.tobytes())
    return len(jpeg)


def _write_frame(folder: Path, assets: FrameAssets) -> None:
    """Write a frame's mesh and images."""
    folder.mkdir(parents=True)
    (folder / "shape.bin").write_bytes(assets.shape.content)
    for number, image in enumerate(assets.images):
        (folder / f"{number}.bin").write_bytes(image.content)
