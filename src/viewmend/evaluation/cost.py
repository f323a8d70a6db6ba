"""The cost of a view on this machine: the time of each stage, and how the time grows."""

import json
import math
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median

from msgspec import Struct

from viewmend.data.synthetic.rigs import orbit
from viewmend.data.synthetic.stage import Studio, StudioConfig
from viewmend.evaluation.provenance import Provenance
from viewmend.geometry.cameras import Cameras
from viewmend.models.base import Inpainter, RenderQuality
from viewmend.stream import Stream
from viewmend.utils.atomic_writes import write_text
from viewmend.utils.timing import StageTimes
from viewmend.utils.untrusted_input import bounded_bytes, read_json, typed

STAGES = ("geometry", "context", "rendering", "inpainting")
SCALES = (0.5, 0.71, 1.0, 1.41)
"""Sizes of the measured views, relative to the image size."""
VIEWERS = (1, 2, 4, 8)
FRACTIONS = (0.125, 0.25, 0.5, 1.0)
"""Refined fractions of the subject that are measured."""
MAX_EXPONENT = {"pixels": 1.0, "cameras": 0.5, "holes": 1.0, "viewers": 0.4}
"""Required scaling: the time may grow at most with these powers."""
SLOWER = 1.2
"""A stage that takes this many times as long as before is reported as slower."""


@dataclass(frozen=True)
class StageCost:
    """One stage of the first view of a frame."""

    stage: str
    ms: float
    """Median."""
    ms_p95: float


@dataclass(frozen=True)
class Growth:
    """Milliseconds of a frame and its views as a size grows."""

    by: str
    sizes: tuple[float, ...]
    ms: tuple[float, ...]
    exponent: float
    """Exponent of the best-fitting power law."""
    asked: float
    """Largest exponent allowed (`MAX_EXPONENT`)."""


@dataclass(frozen=True, kw_only=True)
class CostReport:
    """All measurements."""

    model: str
    size_px: int
    cameras: int
    machine: Provenance
    stages: Sequence[StageCost]
    growth: Sequence[Growth]

    def write(self, path: Path) -> None:
        """Write the report as JSON."""
        write_text(path, json.dumps(asdict(self), indent=1) + "\n")

    def lines(self) -> list[str]:
        """The report as text."""
        size, machine = f"{self.size_px} x {self.size_px}", self.machine
        lines = [
            f"{self.model}, views of {size} from {self.cameras} cameras; {machine.device}, load {machine.load}",
            "  stage         median ms   p95 ms",
        ]
        lines += [f"  {cost.stage:<12}{cost.ms:11.1f}{cost.ms_p95:9.1f}" for cost in self.stages]
        for grown in self.growth:
            verdict = "met" if grown.exponent <= grown.asked else "missed"
            lines.append(f"  time ~ {grown.by}^{grown.exponent:.2f} (limit {grown.asked}: {verdict})")
        return lines


class _Stage(Struct, frozen=True):
    stage: str
    ms: float


class EarlierReport(Struct, frozen=True):
    """The compared part of an earlier report."""

    model: str
    size_px: int
    cameras: int
    stages: tuple[_Stage, ...]


def read_report(path: Path) -> EarlierReport:
    """Read a report that `CostReport.write` wrote.

    Raises:
        ValueError: the file is not such a report.
    """
    try:
        return typed(read_json(bounded_bytes(path)), EarlierReport, "give a file of viewmend benchmark --out")
    except OSError as error:
        raise ValueError(f"{path}: expected a report, got: {error.strerror}; check --versus") from error
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def compare(now: CostReport, before: EarlierReport) -> list[str]:
    """The change of each stage as text, ending with the stages that got slower.

    Raises:
        ValueError: the reports are not of the same model and scene.
    """
    own, other = ((r.model, r.size_px, r.cameras) for r in (now, before))
    if own != other:
        raise ValueError(f"expected a report of model, size and cameras {own}, got {other}; measure the same")
    earlier = {stage.stage: stage.ms for stage in before.stages}
    lines, slower = ["  stage          before      now   ratio"], []
    for cost in now.stages:
        was = earlier.get(cost.stage, 0.0)
        ratio = cost.ms / was if was > 0 else float("nan")
        lines.append(f"  {cost.stage:<12}{was:9.1f}{cost.ms:9.1f}{ratio:8.2f}")
        slower += [cost.stage] if ratio >= SLOWER else []
    return [*lines, f"slower: {', '.join(slower)}" if slower else "no stage is slower"]


def fit_growth(by: str, sizes: Sequence[float | int], ms: Sequence[float]) -> Growth:
    """Fit a power law: least squares of the logarithms.

    Raises:
        ValueError: there are fewer than two different sizes.
    """
    if len(set(sizes)) < 2 or min(*sizes, *ms) <= 0:
        raise ValueError(f"expected two or more different sizes and times above 0, got {list(sizes)}; give more")
    x, y = [math.log(size) for size in sizes], [math.log(value) for value in ms]
    mean_x, mean_y = sum(x) / len(x), sum(y) / len(y)
    slope = sum((a - mean_x) * (b - mean_y) for a, b in zip(x, y, strict=True)) / sum((a - mean_x) ** 2 for a in x)
    return Growth(by, tuple(map(float, sizes)), tuple(round(v, 2) for v in ms), round(slope, 3), MAX_EXPONENT[by])


class CostBench:
    """Measures an inpainter on a synthetic scene, through a `Stream`."""

    def __init__(
        self, inpainter: Inpainter, size_px: int = 256, cameras: int = 8, repeats: int = 3, seed: int = 10000
    ) -> None:
        """Create the scene.

        Args:
            inpainter: completes the views.
            size_px: width and height of all images.
            cameras: cameras of the rig; about half and twice as many are measured, too.
            repeats: frames that each figure is the median of; one more warms up.
            seed: the scene.
        """
        self.inpainter, self.size_px, self.cameras, self.repeats, self.seed = inpainter, size_px, cameras, repeats, seed
        self.studio = self._studio(cameras)

    def stages(self) -> list[StageCost]:
        """The time of each stage of the first view of a frame."""
        target, stream, times = self._view(), Stream(self.inpainter, bounds=self.studio.bounds), list[StageTimes]()
        for at in range(self.repeats + 1):
            stream.add_frame(self.studio.read(at))
            times.append(stream.view(target, time=at).times)
        taken = {name: sorted(getattr(t, name) for t in times[1:]) for name in STAGES}
        return [
            StageCost(name, round(median(ms), 3), round(ms[min(len(ms) - 1, int(0.95 * len(ms)))], 3))
            for name, ms in taken.items()
        ]

    def growth(self) -> list[Growth]:
        """The time of a frame and its views against pixels, cameras, refined pixels and viewers."""
        studio, target, found = self.studio, self._view(), list[Growth]()
        sides = [max(32, round(self.size_px * scale / 4) * 4) for scale in SCALES]
        by_pixels = [self._frame_ms(studio, [self._view(size_px=side)]) for side in sides]
        found.append(fit_growth("pixels", [side * side for side in sides], by_pixels))
        rigs = (max(3, self.cameras // 2), self.cameras, 2 * self.cameras)
        by_cameras = [self._frame_ms(self._studio(count), [target]) for count in rigs]
        found.append(fit_growth("cameras", rigs, by_cameras))
        if self.inpainter.predicts_errors:
            by_holes = [self._frame_ms(studio, [target], RenderQuality(refine_fraction=part)) for part in FRACTIONS]
            found.append(fit_growth("holes", FRACTIONS, by_holes))
        around = [self._view(2 * math.pi * n / max(VIEWERS)) for n in range(max(VIEWERS))]
        by_viewers = [self._frame_ms(studio, around[:n]) for n in VIEWERS]
        return [*found, fit_growth("viewers", VIEWERS, by_viewers)]

    def _studio(self, cameras: int) -> Studio:
        return Studio(StudioConfig(seed=self.seed, cameras=cameras, frames=self.repeats + 1, size_px=self.size_px))

    def _view(self, azimuth_rad: float = 0.4, size_px: int | None = None) -> Cameras:
        side = size_px or self.size_px
        return orbit([azimuth_rad], (side, side), elevation_rad=0.2)

    def _frame_ms(self, studio: Studio, views: Sequence[Cameras], quality: RenderQuality | None = None) -> float:
        """Median milliseconds of a frame and these views of it."""
        stream, took = Stream(self.inpainter, bounds=studio.bounds), list[float]()
        for at in range(self.repeats + 1):
            frame = studio.read(at)
            start = time.perf_counter()
            stream.add_frame(frame)
            for view in views:
                stream.view(view, time=at, quality=quality)
            took.append(1000 * (time.perf_counter() - start))
        return median(took[1:])
