"""Frame rates of our models and of the published networks, side by side in one run.

    python research/baselines.py [--device cuda] [--quick] [--write]

Published networks have random weights, which does not affect their speed. `views` is measured as a stream uses it:
"views-holes" fills holes only, "views-predicted" and "views-all" refine more, and "views-moving" is what the live page
shows while the view moves (no camera is sampled). Every method completes the same view of a stream with a full past:
three frames just before it and three further back. Geometry and rendering are not part of the times.

Each size is a run of its own that includes the fastest baseline; ratios are within one run. With --write, results of
the same day are merged, each with its own settings, so a slow machine can be measured in parts. With --windows N, N
windows of a view are run and the network's time is extrapolated to all of them.
"""

import argparse
import json
import os
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from typing import Any

import benchmarks_path  # noqa: F401
import torch
from measure import machine, result_file, summarise, synchronise, write
from stream_adapter import STREAMED, Streamed
from torch import Tensor

from viewmend.contrib.baselines.framing import DILATION_PX, Canvas, Window, window_canvas, windows_over
from viewmend.contrib.baselines.online import (
    Clip,
    OnlineConfig,
    OnlineInpainter,
    OnlineNetwork,
    OnlineState,
    Sampling,
)
from viewmend.contrib.baselines.published import NETWORKS
from viewmend.models.base import ContextProvider, Inpainter, Memory, RenderQuality, State
from viewmend.models.checkpoint import build
from viewmend.models.classical import Unfilled
from viewmend.models.network import set_compute_dtype
from viewmend.models.paper.config import paper, paper_small
from viewmend.models.paper.context import window_times
from viewmend.rendering.crop import subject_crop
from viewmend.rendering.view import RenderConfig
from viewmend.stream import Stream, StreamConfig
from viewmend.studio.rigs import orbit
from viewmend.studio.stage import Studio, StudioConfig
from viewmend.types import ContextViews, IncompleteView

SEED, CAMERAS, STEP, NOW = 10008, 8, 4, 13
"""Distance of the earlier frames, instead of 10, so that a short scene has a full past."""
SIZES = ((320, 320), (512, 612), (1024, 1224))
RANDOM = {"paper-small": paper_small, "paper": paper}
OURS = ("paper-small", "paper", *STREAMED)
FRAMINGS = ("def", "win", "mul")
RIVAL = ("dstt", "def")
"""The fastest baseline, which is part of every run."""


NewContext = Callable[[], ContextProvider]
StreamedView = Callable[[str], tuple[Streamed, IncompleteView]]


class FewWindows(OnlineInpainter):
    """A baseline that only completes the first windows of a view and estimates the time of the others."""

    def __init__(self, network: OnlineNetwork, config: OnlineConfig, most: int) -> None:
        super().__init__(Clocked(network), config)
        self.most = most
        self.left_out = 0.0
        """Windows that were skipped per window that was run."""

    def unmeasured_s(self) -> float:
        """Estimated network time of the windows that the last step skipped."""
        assert isinstance(self.network, Clocked)
        return self.left_out * self.network.take_s()

    def _windows_with_holes(self, view: IncompleteView, canvas: Canvas) -> list[Window]:
        windows = super()._windows_with_holes(view, canvas)
        few = windows[: self.most]
        self.left_out = (len(windows) - len(few)) / max(len(few), 1)
        return few


class Clocked:
    """A network that measures its own run time."""

    def __init__(self, network: OnlineNetwork) -> None:
        self.network, self.seconds, self.check_size = network, 0.0, network.check_size

    def complete_clip(self, clip: Clip) -> Tensor:
        return self._timed(lambda: self.network.complete_clip(clip), str(clip.now.device))

    def take_s(self) -> float:
        """Seconds since the last call."""
        taken, self.seconds = self.seconds, 0.0
        return taken

    def _timed(self, work: Callable[[], Any], device: str) -> Any:
        synchronise(device)
        start = time.perf_counter()
        found = work()
        synchronise(device)
        self.seconds += time.perf_counter() - start
        return found


def stage(size: tuple[int, int], device: str) -> tuple[list[IncompleteView], NewContext, StreamedView]:
    """The views of a stream up to `NOW`, and two functions.

    The first makes the context of one model, which caches all encodings except those of `NOW`. Models must not share
    it: each stores encodings of its own sizes. The second makes one of `STREAMED` with its crop of the view of `NOW`.
    """
    studio = Studio(StudioConfig(seed=SEED, cameras=CAMERAS, frames=NOW + 1, size_px=size))
    assert studio.bounds is not None
    target = orbit([0.4], size, elevation_rad=0.25).to(device)
    stream = Stream(Unfilled(), StreamConfig(memory_mb=None), studio.bounds)
    seen = [stream.add_frame(studio.read(t).to(device)) for t in range(NOW + 1)]
    views = [stream.render(target, t) for t in range(NOW + 1)]
    for observation in seen:  # depth belongs to the geometry's time
        observation.depth(observation.frame.cameras.names)

    def at(time: int, names: tuple[str, ...]) -> ContextViews | None:
        return seen[time].context(names)

    def new_context() -> ContextProvider:
        memory = defaultdict[int, Memory](dict)
        return ContextProvider(at, memory=lambda time: {} if time == NOW else memory[time])

    def streamed(name: str) -> tuple[Streamed, IncompleteView]:
        rule, fraction = STREAMED[name]
        inpainter, config = Streamed(at, fraction, device), RenderConfig(error_rule=rule)
        judge = Stream(Unfilled(), StreamConfig(render=config), studio.bounds)
        judge.add_frame(seen[NOW].frame, seen[NOW].proxy)
        view, margin_px = judge.render(target, NOW), inpainter.net.crop_margin_px(RenderQuality())
        return inpainter, view if margin_px is None else subject_crop(view, margin_px).of_view(view)

    return views, new_context, streamed


def ours(name: str, views: list[IncompleteView], context: ContextProvider, device: str, precision: str):
    torch.manual_seed(0)
    inpainter = build(replace(RANDOM[name](), k_w=STEP)).to(device).eval()
    set_compute_dtype(inpainter, torch.bfloat16 if precision == "bfloat16" else torch.float32)
    state: State = inpainter.initial_state()
    for time_back in sorted(set(window_times(NOW, inpainter.config)) - {NOW}):
        _, state = inpainter.step(views[time_back], context, state)
    return inpainter, state


def baseline(name: str, framing: str, views: list[IncompleteView], context: ContextProvider, options):
    """A baseline whose past repeats one frame: values do not affect its speed."""
    torch.manual_seed(0)
    network = NETWORKS[name]().to(options.device).eval()
    config = OnlineConfig(framing=framing, sampling=Sampling(step=STEP))
    inpainter = FewWindows(network, config, options.windows)
    _, first = inpainter.step(replace(views[NOW], time=NOW - 1), context, inpainter.initial_state())
    times = config.sampling.times(NOW)
    assert len(times) == 6
    frames = {t: frame for t in times for frame in first.frames.values()}
    return inpainter, OnlineState(frames=frames, canvas_px=first.canvas_px)


def timed_steps(
    inpainter: Inpainter,
    state: State,
    view: IncompleteView,
    context: ContextProvider,
    device: str,
    seconds: float,
) -> dict[str, float]:
    """Milliseconds per step, for at least `seconds`; the first step is dropped if there are more."""
    taken: list[float] = []
    end, few = time.perf_counter() + seconds, inpainter if isinstance(inpainter, FewWindows) else None
    if few is not None:
        few.unmeasured_s()
    while (time.perf_counter() < end and len(taken) < 30) or len(taken) < (1 if few else 2):
        synchronise(device)
        start = time.perf_counter()
        inpainter.step(view, context, state)
        synchronise(device)
        step_s = time.perf_counter() - start
        taken.append(1e3 * (step_s + (few.unmeasured_s() if few is not None else 0.0)))
    taken = taken[1:] or taken
    found = {"fps": round(1e3 * len(taken) / sum(taken), 4), **summarise(taken), "runs": len(taken)}
    return found if few is None or not few.left_out else {**found, "windows_run": few.most}


def ratios(figures: dict[str, dict[str, float]]) -> dict[str, dict[str, float]]:
    """Our frame rates relative to the fastest baseline and to each network's mul variants."""
    others = {name: f["fps"] for name, f in figures.items() if name not in OURS}
    found = {}
    for name in [own for own in OURS if own in figures]:
        own = figures[name]["fps"]
        fastest = max(others, key=lambda n: others[n])
        against = {f"fastest ({fastest})": own / others[fastest]}
        against |= {n: own / fps for n, fps in others.items() if n.endswith("mul")}
        found[name] = {n: round(value, 2) for n, value in against.items()}
    return found


def setting(view: IncompleteView) -> dict[str, object]:
    holes = view.error > 0
    config = OnlineConfig()
    canvas = window_canvas(view.rgb, holes, config.size_px, DILATION_PX)
    return {
        "size_px": [view.error.shape[1], view.error.shape[0]],
        "hole_px": int(holes.sum()),
        "holes_of_hull": round(float(holes.sum() / (view.mask > 0).sum()), 4),
        "windows": len(windows_over(canvas.holes, config.size_px, config.overlap_px)),
    }


def measure(
    size: tuple[int, int], options: argparse.Namespace, done: Callable[[dict], None]
) -> dict[str, object]:
    views, new_context, streamed = stage(size, options.device)
    figures: dict[str, dict[str, float]] = {}
    load = round(os.getloadavg()[0], 1)
    result: dict[str, object] = {**setting(views[NOW]), "load_average": load, "methods": figures}
    wanted = [*product(options.networks, options.framings)]

    def add(
        name: str, inpainter: Inpainter, state: State, view: IncompleteView, context: ContextProvider
    ) -> None:
        figures[name] = timed_steps(inpainter, state, view, context, options.device, options.seconds)
        print(f"{size[0]}x{size[1]} {name}: {figures[name]}", flush=True)
        done(result)

    with torch.inference_mode():
        for name in options.ours:
            context = new_context()
            if name in STREAMED:
                inpainter, part = streamed(name)
                add(name, inpainter, State(), part, context)
            else:
                inpainter, state = ours(name, views, context, options.device, options.precision)
                add(name, inpainter, state, views[NOW], context)
        for network, framing in dict.fromkeys((RIVAL, *wanted)):
            context = new_context()
            inpainter, state = baseline(network, framing, views, context, options)
            add(f"{network}-o-{framing}", inpainter, state, views[NOW], context)
    result["fps_of_ours_over"] = ratios(figures)
    done(result)
    return result


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="cpu")
    parser.add_argument(
        "--precision", default="float32", choices=("float32", "bfloat16"), help="precision of our models"
    )
    parser.add_argument("--ours", nargs="+", default=list(OURS), choices=list(OURS))
    parser.add_argument("--networks", nargs="+", default=list(NETWORKS), choices=list(NETWORKS))
    parser.add_argument("--framings", nargs="+", default=list(FRAMINGS), choices=FRAMINGS)
    parser.add_argument("--windows", type=int, default=1000, help="run at most this many windows of a view")
    parser.add_argument(
        "--seconds", type=float, default=20.0, help="time per method and size; at least one step"
    )
    parser.add_argument("--sizes", nargs="+", default=[f"{w}x{h}" for w, h in SIZES])
    parser.add_argument("--quick", action="store_true", help="smallest size, DSTT on whole views, one step")
    parser.add_argument(
        "--write", action="store_true", help="write the result to benchmarks/results after each method"
    )
    options = parser.parse_args()
    if options.quick:
        options.networks, options.framings, options.seconds = ["dstt"], ["def"], 0.0
        options.sizes = options.sizes[:1]
    config = {
        "seed": SEED,
        "weights": "random",
        "past": "3 frames before, 3 further back",
        "window_px": OnlineConfig().size_px,
    }
    earlier = result_file("baselines", options.device, config)
    results: dict[str, object] = json.loads(earlier.read_text())["results"] if earlier.exists() else {}

    parts = (options.ours, options.networks, options.framings)
    chosen = ", ".join([options.precision, *map(" ".join, parts)])
    precision = {"ours": options.precision, "baselines": "float32"}
    own = {**machine(options.device), "precision": precision, "seconds": options.seconds}

    for text in options.sizes:
        width, height = (int(side) for side in text.split("x"))

        def done(result: dict, text: str = text) -> None:
            results[f"{text}, {chosen}"] = {**own, **result}
            if options.write:
                write("baselines", options.device, config, results)

        print(json.dumps(measure((width, height), options, done)["fps_of_ours_over"], indent=1), flush=True)


if __name__ == "__main__":
    main()
