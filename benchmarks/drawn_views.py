"""Score views as the page draws them while they move: python benchmarks/drawn_views.py [--sets SET ...].

In each scene a camera is left out. Its view is drawn by the page's own code in Chromium, from the cameras' images alone
(`page`) and from completed virtual cameras too (`page+virtual`), both on the fused mesh, and completed by the model
itself behind the hull, as a live view at rest is (`views`). SET is P, CAPTURE:INPUTS, for example
../shared/captures/wd2:8, or turn: a studio seen by six cameras 60 degrees apart, along the way from one to the next.
Of the virtual cameras only those are completed that the page uses at the pose, which gives the same pixels as all of
them.

Columns: PSNR of the whole view on black; LPIPS (AlexNet) in the subject's box, and its ratio to that of `views`. Then,
for a time of each set: bytes of mesh and images; bytes and processor seconds of all completed views, from the mean of
those that were made; and milliseconds of a painted view in Chromium without graphics hardware.
"""

import argparse
import base64
import json
import math
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from statistics import fmean
from typing import Any, get_args

import cv2
import numpy as np
import torch
from jaxtyping import Float
from live_chromium import chromium
from measure import write
from torch import Tensor
from torch.nn import functional as F
from whole_views import detail_scores, perceptual_metrics

from viewmend.completed_cameras import MAX_COMPLETED, complete_views, place_around, with_finer_images
from viewmend.evaluation.scores import TrueView, true_view
from viewmend.geometry.cameras import Cameras, concatenate_cameras
from viewmend.geometry.proxy import GeometryProxy
from viewmend.live.assets import COMPLETED_SOURCES, FrameAssets, make_assets
from viewmend.live.poses import cameras_json
from viewmend.live.responses import page_files
from viewmend.metrics.image_quality import psnr
from viewmend.models.compositing import composite
from viewmend.models.registry import make_method
from viewmend.scenes.capture_scenes import capture_set
from viewmend.scenes.held_out import LeaveOneOutFrame
from viewmend.scenes.studio_scenes import procedural_set
from viewmend.stream import Geometry, Stream, StreamConfig
from viewmend.studio.rigs import orbit
from viewmend.studio.stage import Studio, StudioConfig

SETS = ("../shared/captures/wd2:8", "../shared/captures/utrecht:all", "P", "turn")
TURN_SEED = 10001
"""Seed of the studio of the turn."""
TURN_STEP_DEG = 60.0
"""Angle between neighbouring cameras of the turn's studio, degrees."""
HARNESS = """<!doctype html><canvas id="picture"></canvas><script type="module">
import { Stage } from "./page/draw/stage.js";
import { Assets } from "./page/link/assets.js";
const canvas = document.getElementById("picture");
const stage = new Stage(canvas);
stage.scene.fillers = 3;  // as with graphics hardware
const assets = new Assets((path) => new URL(`frames/${path}`, location.href).href, true);
assets.open({ assets: "" });
const options = { playing: false, framesPerMs: 0, live: false };
const arrived = ({ shape, images }) => shape && images.size === shape.header.cameras.length;
while (!(assets.frames.has(0) && arrived(assets.frames.get(0)))) {
  assets.request(0, [0, 0, 9], { first: 0, end: 1 }, options);
  await new Promise((resolve) => setTimeout(resolve, 20));
}
const whole = assets.frames.get(0);
const { header } = whole.shape;
const isReal = (n) => !header.cameras[n].completed;
const real = {
  ...whole,
  shape: { ...whole.shape, header: { ...header, cameras: header.cameras.filter((_, n) => isReal(n)) } },
  images: new Map([...whole.images].filter(([n]) => isReal(n))),
};
const paint = (viewer, frame) => {
  stage.clear("000000");
  const parts = [{ mode: "completed", until: 1 }];
  stage.draw(viewer, [0, 0, canvas.width, canvas.height], { parts, reproject: false, rig: null, frame });
};
window.drawView = (viewer, virtual, times) => {
  const frame = virtual ? whole : real;
  canvas.width = viewer.lens.width;
  canvas.height = viewer.lens.height;
  paint(viewer, frame);
  const picture = canvas.toDataURL("image/png");
  const start = performance.now();
  for (let n = 0; n < times; n++) {
    paint(viewer, frame);
    stage.gl.readPixels(0, 0, 1, 1, stage.gl.RGBA, stage.gl.UNSIGNED_BYTE, new Uint8Array(4));
  }
  return [picture, (performance.now() - start) / times];
};
window.ready = true;
</script>"""


@dataclass(frozen=True)
class Score:
    """How close a view is to what the left-out camera saw."""

    psnr_db: float
    lpips: float


@dataclass
class SetScores:
    """The scores of a set's views, by who made them, and what a time costs."""

    views: dict[str, list[Score]] = field(default_factory=dict)
    real_bytes: list[int] = field(default_factory=list)
    """Bytes of the mesh and the cameras' images of a time."""
    view_bytes: list[float] = field(default_factory=list)
    """Bytes of a completed view."""
    view_cpu_s: list[float] = field(default_factory=list)
    """Processor seconds of a completed view."""
    fusion_cpu_s: list[float] = field(default_factory=list)
    """Processor seconds of a frame's fused geometry; empty if the hull is drawn."""
    paint_ms: dict[str, list[float]] = field(default_factory=dict)
    """Milliseconds of a painted view."""


class Host:
    """A web server on this machine for the page's drawing code and one frame."""

    def __init__(self) -> None:
        files = page_files()
        self.frame: FrameAssets | None = None
        host = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                name = self.path.lstrip("/")
                if name.startswith("frames/") and host.frame is not None:
                    _, _, *camera = name.split("/")
                    content = host.frame.images[int(camera[0])] if camera else host.frame.shape
                elif name.startswith("page/") and name.removeprefix("page/") in files:
                    content = files[name.removeprefix("page/")]
                else:
                    content = None
                self.send_response(200)
                self.send_header("Content-Type", "text/html" if content is None else content.media_type)
                self.end_headers()
                self.wfile.write(HARNESS.encode() if content is None else content.content)

            def log_message(self, format: str, *values: Any) -> None:
                """Log nothing."""

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.address = f"http://127.0.0.1:{self._server.server_port}/"
        threading.Thread(target=self._server.serve_forever, daemon=True).start()


def main() -> None:
    """Score every set, and print a table of means."""
    parser = argparse.ArgumentParser(description=str(__doc__).split("\n")[0])
    parser.add_argument("--sets", nargs="+", default=SETS)
    parser.add_argument("--views", type=int, default=8, help="number of views per set, evenly spaced")
    parser.add_argument("--size", type=int, default=320, help="width and height of the views of P and turn")
    parser.add_argument(
        "--geometry", choices=get_args(Geometry), default="fused", help="the mesh that is drawn"
    )
    parser.add_argument(
        "--paints", type=int, default=10, help="a view is painted this many times to be timed"
    )
    parser.add_argument("--sheets", type=Path, help="folder for a picture of each view by each method")
    parser.add_argument("--write", action="store_true", help="write the result to benchmarks/results")
    options = parser.parse_args()
    host = Host()
    metrics = {"lpips_alex": perceptual_metrics()["lpips_alex"]}
    results = {}
    with chromium() as browser:
        page = browser.new_page()
        for name in options.sets:
            scores = SetScores()
            for number, frame in enumerate(poses(name, options.views, options.size)):
                pictures = draw(frame, host, page, scores, options.paints, options.geometry)
                truth = true_view(frame.truth, "black")
                judge(pictures, truth, metrics, scores)
                if options.sheets:
                    save(pictures | {"true": truth.rgb}, options.sheets / f"{Path(name).name}-{number}.png")
                print(f"  {number}: {method_lpips(scores)}", flush=True)
            results[name] = report(name, scores)
            if options.write:  # after every set, so that nothing is lost if a later one fails
                config = {key: getattr(options, key) for key in ("sets", "views", "size", "geometry")}
                print(write("drawn_views", "cpu", config, results), flush=True)


def poses(name: str, count: int, size_px: int) -> Iterator[LeaveOneOutFrame]:
    """The views of a set: what the inputs saw, and what the camera that is left out saw."""
    if name == "turn":
        yield from turn(count, size_px)
        return
    kind, _, inputs = name.partition(":")
    scenes = procedural_set(1, size_px) if kind == "P" else capture_set(Path(kind), inputs or "all")
    number_of_scenes = min(count, len(scenes))
    chosen = [scenes[len(scenes) * n // number_of_scenes] for n in range(number_of_scenes)]
    times = math.ceil(count / number_of_scenes)
    for scene in chosen:
        for number, frame in enumerate(scene.frames()):
            if number == times:
                break
            yield frame


def turn(count: int, size_px: int) -> Iterator[LeaveOneOutFrame]:
    """Views on the way from one camera of a ring to the next."""
    ring = orbit([math.radians(TURN_STEP_DEG * n) for n in range(6)], (size_px, size_px))
    studio = Studio(StudioConfig(seed=TURN_SEED, cameras=ring, frames=1, size_px=size_px))
    steps = [math.radians(TURN_STEP_DEG * (n + 1) / (count + 1)) for n in range(count)]
    way = orbit(steps, (size_px, size_px))
    for n in range(count):
        yield LeaveOneOutFrame(studio.read(0), studio.truth(way[[n]], 0), studio.bounds)


def draw(
    frame: LeaveOneOutFrame, host: Host, page: Any, scores: SetScores, paints: int, geometry: Geometry
) -> dict[str, Float[Tensor, "3 height width"]]:
    """The left-out camera's view by the model, and as the page draws it, `paints` times to be timed."""
    model = make_method("views")
    stream = Stream(model, StreamConfig(memory_mb=None), frame.bounds)
    cached = stream.add_frame(frame.inputs)
    proxy = cached.proxy
    assert isinstance(proxy, GeometryProxy), "no other geometry was given"
    target = frame.truth.cameras
    completed = stream.view(target, time=cached.frame.time).completed
    pictures = {"views": composite("black", completed.rgb, completed.opacity).clamp(0, 1)}

    if geometry == "fused":
        start_s = time.process_time()
        stream = Stream(model, StreamConfig(memory_mb=None, geometry="fused"), frame.bounds)
        cached = stream.add_frame(frame.inputs)
        proxy = cached.proxy
        assert isinstance(proxy, GeometryProxy), "no other geometry was given"
        scores.fusion_cpu_s.append(time.process_time() - start_s)

    # the virtual cameras that the page uses at this pose
    rig = frame.inputs.cameras
    ring = with_finer_images(place_around(rig, proxy.center, None, MAX_COMPLETED))
    vertices = proxy.mesh.vertices
    used = closest(concatenate_cameras([rig, ring]), target, vertices.mean(0))
    virtual = ring[[number - len(rig) for number in used if number >= len(rig)]]
    start_s = time.process_time()
    views = complete_views(stream, cached, virtual)
    scores.view_cpu_s.append((time.process_time() - start_s) / len(virtual))
    plain = make_assets(frame.inputs, proxy, stream.config.render)
    host.frame = make_assets(frame.inputs, proxy, stream.config.render, views)
    scores.real_bytes.append(plain.size_bytes)
    scores.view_bytes.append((host.frame.size_bytes - plain.size_bytes) / len(virtual))

    page.goto(host.address)
    page.wait_for_function("window.ready", timeout=600_000)
    for name, with_virtual in (("page", False), ("page+virtual", True)):
        asked = [viewer_json(target), with_virtual, paints]
        png, paint_ms = page.evaluate("(asked) => window.drawView(...asked)", asked)
        encoded = np.frombuffer(base64.b64decode(png.split(",")[1]), np.uint8)
        rgb = cv2.imdecode(encoded, cv2.IMREAD_COLOR_RGB)
        pictures[name] = torch.from_numpy(rgb).movedim(-1, 0).float() / 255
        scores.paint_ms.setdefault(name, []).append(paint_ms)
    return pictures


def closest(cameras: Cameras, target: Cameras, center: Float[Tensor, "3"]) -> list[int]:
    """Numbers of the cameras that the page colours a view from, as `chooseCameras` in link/assets.js does."""
    to_cameras = F.normalize(cameras.centers - center, dim=1)
    to_eye = F.normalize(target.centers[0] - center, dim=0)
    return (to_cameras @ to_eye).argsort(descending=True, stable=True)[:COMPLETED_SOURCES].tolist()


def viewer_json(camera: Cameras) -> dict[str, Any]:
    """A camera as the page's `Viewpoint`."""
    (about,) = cameras_json(camera)
    fx, _, cx, _, fy, cy, *_ = about["K"]
    size = {"width": about["width"], "height": about["height"]}
    return {"R": about["R"], "T": about["T"], "lens": {"fx": fx, "fy": fy, "cx": cx, "cy": cy, **size}}


def judge(
    pictures: Mapping[str, Tensor], truth: TrueView, metrics: Mapping[str, Any], scores: SetScores
) -> None:
    """Add a pose's scores."""
    for name, rgb in pictures.items():
        lpips = detail_scores(rgb, rgb, truth, dict(metrics))["lpips_alex"]
        psnr_db = psnr(rgb, truth.rgb)
        assert lpips is not None and psnr_db is not None, "views have pixels"
        scores.views.setdefault(name, []).append(Score(psnr_db, lpips))


def method_lpips(scores: SetScores) -> dict[str, float]:
    """The LPIPS of the last pose, by who made the view."""
    return {method: round(found[-1].lpips, 4) for method, found in scores.views.items()}


def report(name: str, scores: SetScores) -> dict[str, Any]:
    """Print and return a set's means."""
    own = fmean(score.lpips for score in scores.views["views"])
    table = {}
    print(f"{name}, {len(scores.view_bytes)} poses: PSNR, LPIPS, LPIPS over that of views, paint ms")
    for method, found in scores.views.items():
        lpips = fmean(score.lpips for score in found)
        paint_ms = fmean(scores.paint_ms.get(method, [math.nan]))
        row = {"psnr_db": fmean(score.psnr_db for score in found), "lpips": lpips, "ratio": lpips / own}
        table[method] = row | {"paint_ms": paint_ms, "poses": [asdict(score) for score in found]}
        print(f"  {method:14s}", *(f"{value:8.4f}" for value in row.values()), f"{paint_ms:8.1f}", flush=True)
    cost = {
        "real_mb": fmean(scores.real_bytes) / 1e6,
        "completed_mb": MAX_COMPLETED * fmean(scores.view_bytes) / 1e6,
        "completed_cpu_s": MAX_COMPLETED * fmean(scores.view_cpu_s),
    }
    if scores.fusion_cpu_s:
        cost["fusion_cpu_s"] = fmean(scores.fusion_cpu_s)
    print(f"  a time: {json.dumps({key: round(value, 2) for key, value in cost.items()})}", flush=True)
    return table | {"cost": cost}


def save(pictures: Mapping[str, Tensor], file: Path) -> None:
    """Write a pose's pictures in a row."""
    file.parent.mkdir(parents=True, exist_ok=True)
    row = torch.cat(list(pictures.values()), 2).movedim(0, -1).cpu().numpy()
    cv2.imwrite(str(file), cv2.cvtColor((255 * row).round().astype(np.uint8), cv2.COLOR_RGB2BGR))


if __name__ == "__main__":
    main()
