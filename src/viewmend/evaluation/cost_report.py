"""A report of what views cost: as JSON, as lines, beside an earlier one, and as plots."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from msgspec import Struct

from viewmend.atomic_writes import write_atomically, write_text
from viewmend.evaluation.cost import Ceilings, Growth, StageCost
from viewmend.evaluation.provenance import Provenance
from viewmend.evaluation.report_plot import STYLE, require_matplotlib
from viewmend.foreign_input import bounded_bytes
from viewmend.json_input import read_json, typed

SLOWER = 1.2
"""A stage that takes so many times as long as before is called slower."""


@dataclass(frozen=True, kw_only=True)
class CostReport:
    """All that was measured."""

    model: str
    size_px: int
    cameras: int
    machine: Provenance
    ceilings: Ceilings
    stages: Sequence[StageCost]
    growth: Sequence[Growth]

    def write(self, path: Path) -> None:
        """As JSON."""
        write_text(path, json.dumps(asdict(self), indent=1) + "\n")

    def lines(self) -> list[str]:
        """For people."""
        top = self.ceilings
        lines = [
            f"{self.model}, views of {self.size_px} x {self.size_px} from {self.cameras} cameras; at most "
            f"{top.flops_per_s / 1e9:.1f} GFLOP/s and {top.bytes_per_s / 1e9:.1f} GB/s here, load {self.machine.load}",
            "  stage             ms     GFLOP        MB  least ms   times",
        ]
        for cost in self.stages:
            ratio = "-" if cost.ratio is None else f"{cost.ratio:.1f}"
            work = f"{cost.flops / 1e9:9.3f} {cost.bytes / 1e6:9.1f} {cost.floor_ms:9.2f}"
            lines.append(f"  {cost.stage:<12}{cost.ms:8.1f} {work} {ratio:>7}")
        for grown in self.growth:
            verdict = "met" if grown.exponent <= grown.asked else "missed"
            lines.append(f"  grows with {grown.by} to the {grown.exponent:.2f} (at most {grown.asked}: {verdict})")
        return lines


class _Stage(Struct, frozen=True):
    stage: str
    ms: float


class _Growth(Struct, frozen=True):
    by: str
    exponent: float


class EarlierReport(Struct, frozen=True):
    """What is compared of a report."""

    model: str
    size_px: int
    cameras: int
    stages: tuple[_Stage, ...]
    growth: tuple[_Growth, ...] = ()


def read_report(path: Path) -> EarlierReport:
    """A report that `CostReport.write` wrote.

    Raises:
        ValueError: the file holds none; says what and where.
    """
    try:
        return typed(read_json(bounded_bytes(path)), EarlierReport, "give a file of viewmend benchmark --out")
    except OSError as error:
        raise ValueError(f"{path}: expected a report, got: {error.strerror}; check --versus") from error
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def versus(now: CostReport, before: EarlierReport) -> list[str]:
    """How each stage and exponent changed, and the stages that got slower.

    Raises:
        ValueError: the reports are not of the same model and scene.
    """
    ours, theirs = ((r.model, r.size_px, r.cameras) for r in (now, before))
    if ours != theirs:
        raise ValueError(f"expected a report of model, size and cameras {ours}, got {theirs}; measure the same")
    earlier = {stage.stage: stage.ms for stage in before.stages}
    lines, slower = ["  stage          before      now   times"], []
    for cost in now.stages:
        was = earlier.get(cost.stage, 0.0)
        times = cost.ms / was if was > 0 else float("nan")
        lines.append(f"  {cost.stage:<12}{was:9.1f}{cost.ms:9.1f}{times:8.2f}")
        slower += [cost.stage] if times >= SLOWER else []
    exponents = {growth.by: growth.exponent for growth in before.growth}
    known = [grown for grown in now.growth if grown.by in exponents]
    lines += [f"  exponent of {one.by}: {exponents[one.by]:.2f}, now {one.exponent:.2f}" for one in known]
    return [*lines, f"slower: {', '.join(slower)}" if slower else "no stage is slower"]


def write_plots(report: CostReport, path: Path) -> None:
    """A page of plots: each stage beside the least it could take, and what it grows with (SVG, PNG or PDF by its name).

    Raises:
        MissingMatplotlibError: matplotlib is not installed.
    """
    require_matplotlib()
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(STYLE):
        figure = Figure((12, 8), layout="constrained")
        grid = figure.subplots(2, 3).flatten()
        names = [cost.stage for cost in report.stages]
        for n, (label, values) in enumerate(
            (("measured", [c.ms for c in report.stages]), ("least", [c.floor_ms for c in report.stages]))
        ):
            grid[0].bar([k + 0.4 * n for k in range(len(names))], [max(v, 0.01) for v in values], 0.4, label=label)
        grid[0].set_xticks([k + 0.2 for k in range(len(names))], names, fontsize=8)
        grid[0].set(yscale="log", ylabel="ms", title="stages")
        grid[0].legend()
        for axes, grown in zip(grid[1:], report.growth, strict=False):
            axes.plot(grown.sizes, grown.ms, "o-")
            axes.set(xscale="log", yscale="log", xlabel=grown.by, ylabel="ms")
            axes.set_xticks(grown.sizes, [f"{size:g}" for size in grown.sizes], fontsize=9)
            axes.set_xticks([], minor=True)
            axes.yaxis.set_minor_formatter("{x:.0f}")
            axes.yaxis.set_major_formatter("{x:.0f}")
            axes.set_title(f"{grown.by}: {grown.exponent:.2f}, at most {grown.asked}")
        for axes in grid[1 + len(report.growth) :]:
            axes.set_axis_off()
        kind = path.suffix.lstrip(".")
        write_atomically(path, lambda half: figure.savefig(half, format=kind))
