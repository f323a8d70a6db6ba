"""The time of each stage of a view on this machine."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median

from msgspec import Struct

from viewmend.data.synthetic.rigs import orbit
from viewmend.data.synthetic.stage import Studio, StudioConfig
from viewmend.evaluation.provenance import Provenance
from viewmend.models.base import Inpainter
from viewmend.stream import Stream
from viewmend.utils.atomic_writes import write_text
from viewmend.utils.timing import StageTimes
from viewmend.utils.untrusted_input import bounded_bytes, read_json, typed

STAGES = ("geometry", "context", "rendering", "inpainting")
SEED = 10000
"""The measured scene."""
SLOWER = 1.2
"""A stage that takes this many times as long as before is reported as slower."""


@dataclass(frozen=True)
class StageCost:
    """One stage of the first view of a frame."""

    stage: str
    ms: float
    """Median."""
    ms_p95: float


@dataclass(frozen=True, kw_only=True)
class CostReport:
    """All measurements."""

    model: str
    size_px: int
    cameras: int
    machine: Provenance
    stages: Sequence[StageCost]

    def write(self, path: Path) -> None:
        """Write the report as JSON."""
        write_text(path, json.dumps(asdict(self), indent=1) + "\n")

    def lines(self) -> list[str]:
        """The report as text."""
        size, machine = f"{self.size_px} x {self.size_px}", self.machine
        return [
            f"{self.model}, views of {size} from {self.cameras} cameras; {machine.device}, load {machine.load}",
            "  stage         median ms   p95 ms",
            *(f"  {cost.stage:<12}{cost.ms:11.1f}{cost.ms_p95:9.1f}" for cost in self.stages),
        ]


def measure_stages(inpainter: Inpainter, size_px: int, cameras: int, repeats: int) -> list[StageCost]:
    """The time of each stage of the first view of a frame, through a `Stream`, after one frame to warm up.

    Args:
        inpainter: completes the views.
        size_px: width and height of all images.
        cameras: of the rig, a ring.
        repeats: frames that each figure is the median of.
    """
    studio = Studio(StudioConfig(seed=SEED, cameras=cameras, frames=repeats + 1, size_px=size_px))
    stream, target = Stream(inpainter, bounds=studio.bounds), orbit([0.4], (size_px, size_px), elevation_rad=0.2)
    times: list[StageTimes] = []
    for at in range(repeats + 1):
        stream.add_frame(studio.read(at))
        times.append(stream.view(target, time=at).times)
    taken = {name: sorted(getattr(t, name) for t in times[1:]) for name in STAGES}
    return [
        StageCost(name, round(median(ms), 3), round(ms[min(len(ms) - 1, int(0.95 * len(ms)))], 3))
        for name, ms in taken.items()
    ]


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
