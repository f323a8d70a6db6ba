"""What a view costs: milliseconds, operations and bytes of each stage, and the least that this machine could take.

The stages are those of the stream's own record of times (`StageTimes`); nothing here calls them in another order than
`Stream` does.
"""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from statistics import median

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import FlopCounterMode

from viewmend.geometry.cameras import Cameras
from viewmend.inpainting.protocol import RenderQuality, ViewInpainter
from viewmend.stream import Stream
from viewmend.studio.rigs import orbit
from viewmend.studio.stage import Studio, StudioConfig
from viewmend.timing import StageTimes

STAGES = ("geometry", "context", "rendering", "inpainting")
GEMM_SIDE, COPY_BYTES = 1024, 1 << 27
ASKED = {"pixels": 1.0, "cameras": 0.5, "holes": 1.0, "viewers": 0.4}
"""Cost may grow with at most these powers."""


@dataclass(frozen=True)
class Ceilings:
    """What the machine does at its best, measured."""

    flops_per_s: float
    """The speed of a product of two square float32 matrices."""
    bytes_per_s: float
    """Bytes that a copy of a large tensor reads and writes."""


@dataclass(frozen=True)
class StageCost:
    """One stage of a view, or of a time."""

    stage: str
    ms: float
    """Median."""
    flops: int
    """Operations of products and convolutions that torch dispatches. Those of numba's kernels are not seen."""
    bytes: int
    """Bytes that the operations torch dispatches read and write. What a cache keeps counts, too."""
    floor_ms: float
    """Least time for these at the ceilings."""
    ratio: float | None
    """How many times the least time it took. None where nothing was counted."""


@dataclass(frozen=True)
class Growth:
    """Milliseconds as something grows."""

    by: str
    sizes: tuple[float, ...]
    ms: tuple[float, ...]
    exponent: float
    """The power of the size that fits best."""
    asked: float
    """The exponent is to be at most this."""


@dataclass(frozen=True, kw_only=True)
class CostScene:
    """The scene and the sizes that are measured."""

    size_px: int = 256
    cameras: int = 8
    repeats: int = 3
    """Times that each figure is the median of."""
    seed: int = 10000
    scales: Sequence[float] = (0.5, 0.71, 1.0, 1.41)
    """Parts of `size_px` at which views are measured."""
    rigs: Sequence[int] = (4, 8, 16)
    viewers: Sequence[int] = (1, 2, 4, 8)
    fractions: Sequence[float] = (0.125, 0.25, 0.5, 1.0)
    """Parts of the subject that are read, where the model chooses."""


@dataclass
class _Traffic(TorchDispatchMode):
    """Counts bytes of the operations' tensors; views move none."""

    bytes: int = field(default=0)

    def __post_init__(self) -> None:
        super().__init__()

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        out = func(*args, **(kwargs or {}))
        if not getattr(func, "is_view", False):
            tensors = [*_tensors(args), *_tensors(tuple((kwargs or {}).values())), *_tensors((out,))]
            self.bytes += sum(t.numel() * t.element_size() for t in tensors)
        return out


def _tensors(values: Sequence[object]) -> list[Tensor]:
    found: list[Tensor] = []
    for value in values:
        if isinstance(value, Tensor):
            found.append(value)
        elif isinstance(value, tuple | list):
            found.extend(_tensors(value))
    return found


def ceilings() -> Ceilings:
    """Measure them: the best of ten tries each."""
    a, source = torch.ones(GEMM_SIDE, GEMM_SIDE), torch.zeros(COPY_BYTES, dtype=torch.uint8)
    target = torch.empty_like(source)
    return Ceilings(2 * GEMM_SIDE**3 / _best_s(lambda: a @ a), 2 * COPY_BYTES / _best_s(lambda: target.copy_(source)))


def _best_s(work: Callable[[], object]) -> float:
    def once() -> float:
        start = time.perf_counter()
        work()
        return time.perf_counter() - start

    return min(once() for _ in range(10))


def _counted(work: Callable[[], object]) -> tuple[int, int]:
    """Operations and bytes of what is done, without compiled regions, which hide theirs."""
    traffic = _Traffic()
    with torch.compiler.set_stance("force_eager"), FlopCounterMode(display=False) as flops, traffic:
        work()
    return flops.get_total_flops(), traffic.bytes


def _less(a: tuple[int, int], b: tuple[int, int]) -> tuple[int, int]:
    """What `a` has beyond `b`, of each."""
    return max(0, a[0] - b[0]), max(0, a[1] - b[1])


class CostBench:
    """Measures one model on a studio's scene."""

    def __init__(self, inpainter: ViewInpainter, config: CostScene) -> None:
        self.inpainter, self.config = inpainter, config
        self.studio = self._studio(config.cameras)

    def _studio(self, cameras: int) -> Studio:
        config = self.config
        frames = config.repeats + 1  # the first warms up
        return Studio(StudioConfig(seed=config.seed, cameras=cameras, frames=frames, size_px=config.size_px))

    def _view(self, azimuth_rad: float = 0.4, size_px: int | None = None) -> Cameras:
        side = size_px or self.config.size_px
        return orbit([azimuth_rad], (side, side), elevation_rad=0.2)

    def _stream(self, studio: Studio, first: int = 0, frames: int = 0) -> Stream:
        stream = Stream(self.inpainter, bounds=studio.bounds)
        for at in range(first, first + frames):
            stream.push(studio.read(at))
        return stream

    def stages(self, machine: Ceilings) -> list[StageCost]:
        """Each stage of a view that is the first of its time."""
        target, count = self._view(), self.config.repeats
        stream, times = self._stream(self.studio), list[StageTimes]()
        for at in range(count + 1):
            stream.push(self.studio.read(at))
            times.append(stream.view(target, time=at).times)
        counts = self._counts(target)
        return [
            self._stage(name, median(getattr(t, name) for t in times[1:]), *counts[name], machine) for name in STAGES
        ]

    def _stage(self, name: str, ms: float, flops: int, moved: int, machine: Ceilings) -> StageCost:
        floor_ms = 1000 * max(flops / machine.flops_per_s, moved / machine.bytes_per_s)
        ratio = round(ms / floor_ms, 2) if floor_ms > 0 else None
        return StageCost(name, round(ms, 3), flops, moved, round(floor_ms, 4), ratio)

    def _counts(self, target: Cameras) -> dict[str, tuple[int, int]]:
        """Operations and bytes by stage: what a time's second viewer does not pay again is context."""
        stream, frame = self._stream(self.studio, 0, 1), self.studio.read(1)
        stream.view(target, time=0)
        pushed = _counted(lambda: stream.push(frame))
        first = _counted(lambda: stream.view(target, time=1))
        second = _counted(lambda: stream.view(target, time=1))
        rendered = _counted(lambda: stream.view(target, time=1, quality=RenderQuality(mend=False)))
        return {
            "geometry": pushed,
            "context": _less(first, second),
            "rendering": rendered,
            "inpainting": _less(second, rendered),
        }

    def _time_ms(self, studio: Studio, work: Callable[[Stream, int], object]) -> float:
        """Median milliseconds of one time's frame and the views of it."""
        stream, took = self._stream(studio), list[float]()
        for at in range(self.config.repeats + 1):
            frame = studio.read(at)
            start = time.perf_counter()
            stream.push(frame)
            work(stream, at)
            took.append(1000 * (time.perf_counter() - start))
        return median(took[1:])

    def growth(self) -> list[Growth]:
        """Cost of a time and its views against pixels, cameras, what is mended, and viewers."""
        config, studio, found = self.config, self.studio, list[Growth]()
        sides = [max(32, round(config.size_px * scale / 4) * 4) for scale in config.scales]
        views = [self._view(size_px=side) for side in sides]
        by_pixels = [self._time_ms(studio, lambda s, at, view=view: s.view(view, time=at)) for view in views]
        found.append(fitted("pixels", [side * side for side in sides], by_pixels))
        target = self._view()
        rigs = [self._studio(count) for count in config.rigs]
        by_cameras = [self._time_ms(rig, lambda s, at: s.view(target, time=at)) for rig in rigs]
        found.append(fitted("cameras", config.rigs, by_cameras))
        if getattr(self.inpainter, "tells_errors", False):
            qualities = [replace(RenderQuality(), read_fraction=part) for part in config.fractions]
            by_holes = [
                self._time_ms(studio, lambda s, at, quality=quality: s.view(target, time=at, quality=quality))
                for quality in qualities
            ]
            found.append(fitted("holes", config.fractions, by_holes))
        around = [self._view(2 * math.pi * n / max(config.viewers)) for n in range(max(config.viewers))]
        by_viewers = [
            self._time_ms(studio, lambda s, at, n=n: [s.view(view, time=at) for view in around[:n]])
            for n in config.viewers
        ]
        found.append(fitted("viewers", config.viewers, by_viewers))
        return found


def fitted(by: str, sizes: Sequence[float | int], ms: Sequence[float]) -> Growth:
    """A growth with the exponent that fits best: least squares of logarithms.

    Raises:
        ValueError: there are less than two different sizes.
    """
    if len(set(sizes)) < 2 or min(*sizes, *ms) <= 0:
        raise ValueError(f"expected two or more different sizes and times above 0, got {list(sizes)}; give more")
    x, y = [math.log(size) for size in sizes], [math.log(value) for value in ms]
    mean_x, mean_y = sum(x) / len(x), sum(y) / len(y)
    slope = sum((a - mean_x) * (b - mean_y) for a, b in zip(x, y, strict=True)) / sum((a - mean_x) ** 2 for a in x)
    return Growth(by, tuple(map(float, sizes)), tuple(round(v, 2) for v in ms), round(slope, 3), ASKED[by])
