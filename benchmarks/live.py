"""Latency, frame rate and size of live views: python benchmarks/live.py [--device cuda] [--write].

Starts a server for each size and moves around a studio scene with the Python client while the scene plays. Latency is
measured from a request to its decoded frame. Then 1 to 8 viewers share the same frames.
"""

import argparse
import contextlib
import json
import threading
import time

from measure import summarise, write

from viewmend.live.client import Client
from viewmend.live.frame_source import RecordedSource
from viewmend.live.listener import Server
from viewmend.live.renderer import Renderer
from viewmend.live.server import LiveServer, ServerConfig
from viewmend.live.service import RenderService
from viewmend.models.checkpoint import load_inpainter
from viewmend.studio.stage import Studio, StudioConfig

SEED, CAMERAS, FRAMES, FPS = 10008, 8, 30, 15.0
SIZES = ((320, 320), (512, 612))
VIEWERS = (1, 2, 4, 8)


@contextlib.contextmanager
def served(size: tuple[int, int], budget_ms: float | None, device: str, model: str, **config: object):
    """The address and service of a server whose frames are all generated; `config` holds fields of `ServerConfig`."""
    scene = StudioConfig(seed=SEED, cameras=CAMERAS, frames=FRAMES, size_px=size, fps=FPS)
    supply = RecordedSource(lambda: Studio(scene), generated=True)
    renderer = Renderer(supply, load_inpainter(model, device), device=device)
    service, settings = RenderService(renderer, supply), ServerConfig(port=0, budget_ms=budget_ms, **config)
    server = Server(LiveServer(service, settings), settings)
    with server.bind() as url:
        thread = threading.Thread(target=server.run)
        thread.start()
        while not (service.is_ready and supply.span.complete):
            time.sleep(0.1)
        yield url.replace("http", "ws"), service
        server.stop()
        thread.join()


def walk(url: str, size: tuple[int, int], seconds: float, start: float, out: list[dict[str, object]]) -> None:
    """Request views from a moving pose for some seconds, and append a summary to `out`."""
    with Client(url) as viewer:
        frames, begun = [], time.perf_counter()
        while time.perf_counter() - begun < seconds:
            azimuth = start + 40.0 * (time.perf_counter() - begun)
            camera = {"azimuth": azimuth, "elevation": 10.0}
            look = viewer.look(camera=camera, width=size[0], height=size[1], moving=True, depth=True)
            frames.append(viewer.frame(look))
        taken = time.perf_counter() - begun
        stages = frames[0].header["stage_ms"]
        out.append(
            {
                "latency": summarise([frame.latency_ms for frame in frames]),
                "fps": round(len(frames) / taken, 2),
                "kb_per_frame": round(sum(frame.size for frame in frames) / 1000 / len(frames), 1),
                "width_mean": round(sum(frame.header["width"] for frame in frames) / len(frames)),
                "stage_ms": {
                    s: summarise([f.header["stage_ms"][s] for f in frames])["median_ms"] for s in stages
                },
                "shared": round(sum(f.header["stage_ms"]["geometry"] == 0 for f in frames) / len(frames), 3),
            }
        )


def crowd(url: str, size: tuple[int, int], viewers: int, seconds: float) -> dict[str, object]:
    """Several viewers following the live edge: what each receives, and the cost per view."""
    seen: list[dict[str, object]] = []
    threads = [
        threading.Thread(target=walk, args=(url, size, seconds, 360.0 * n / viewers, seen))
        for n in range(viewers)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    views = sum(float(str(viewer["fps"])) for viewer in seen)
    return {
        "fps_each": [viewer["fps"] for viewer in seen],
        "latency_median_ms": [viewer["latency"]["median_ms"] for viewer in seen],
        "width_mean": [viewer["width_mean"] for viewer in seen],
        "ms_per_view": round(1000 / views, 1),
        "shared": [viewer["shared"] for viewer in seen],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--model", default="views", help="a shipped model's name, or a folder")
    parser.add_argument("--seconds", type=float, default=15.0)
    parser.add_argument("--budget-ms", type=float, nargs="*", default=[100.0, 0.0], help="0: none")
    parser.add_argument("--write", action="store_true", help="write the result to benchmarks/results")
    options = parser.parse_args()
    figures: dict[str, object] = {}
    for size in SIZES:
        for budget_ms in options.budget_ms:
            with served(size, budget_ms or None, options.device, options.model) as (url, _):
                walk(url, size, 3.0, 0.0, [])
                alone: list[dict[str, object]] = []
                walk(url, size, options.seconds, 0.0, alone)
                label = f"{size[0]}x{size[1]}, " + (f"budget {budget_ms:g} ms" if budget_ms else "no budget")
                figures[label] = alone[0]
                print(label, json.dumps(figures[label]), flush=True)
    for budget_ms in options.budget_ms:
        with served(SIZES[0], budget_ms or None, options.device, options.model) as (url, _):
            walk(url, SIZES[0], 3.0, 0.0, [])
            for viewers in VIEWERS:
                label = f"{viewers} viewers, " + (f"budget {budget_ms:g} ms" if budget_ms else "no budget")
                figures[label] = crowd(url, SIZES[0], viewers, options.seconds)
                print(label, json.dumps(figures[label]), flush=True)
    if options.write:
        config = {"seed": SEED, "cameras": CAMERAS, "frames": FRAMES, "fps": FPS, "model": options.model}
        print(write("live", options.device, config, figures))


if __name__ == "__main__":
    main()
