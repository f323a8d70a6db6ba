"""What an ablation found: each variant against the full model, seed by seed; quality against top-k; plots."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from viewmend.evaluation.averages import Row, gains, tables
from viewmend.evaluation.cells import Cell
from viewmend.evaluation.records import Records, mean, records
from viewmend.evaluation.report_plot import ablation_plot


@dataclass(frozen=True)
class Trained:
    """A model of the ablation."""

    variant: str
    seed: int
    folder: Path
    top_k: int | None = None
    """Context tokens that survive, None for all."""


@dataclass(frozen=True)
class Line:
    """One variant, or the full model at one top-k."""

    name: str
    holes: tuple[float | None, ...]
    """PSNR in the holes, dB, of each seed: mean over scenes."""
    whole: tuple[float | None, ...]
    """PSNR over whole images, likewise."""
    ms: float | None
    """The median step of all seeds."""
    loss: tuple[float | None, ...]
    """What each seed loses in the holes against the full model of this seed, dB: mean over the scenes of both."""
    loss_by_style: dict[str, float | None]
    """The loss by how fast the scenes are: mean over seeds."""


@dataclass(frozen=True)
class Ablation:
    """All of it."""

    telea: float | None
    """PSNR in the holes of the classical fill."""
    scenes: int
    variants: tuple[Line, ...]
    top_k: tuple[Line, ...]
    """The full model, from the fewest tokens to all."""

    @classmethod
    def of(cls, trained: Sequence[Trained], cells: Sequence[Cell]) -> "Ablation":
        """The ablation from the cells of all these models, whose methods are their folders, and of telea."""
        methods = ["telea", *(str(one.folder) for one in trained)]
        scores = records(cells)
        rows = {row.method: row for row in tables(cells, methods)[0].rows}
        whole = [one for one in trained if one.top_k is None]
        variants = list(dict.fromkeys(one.variant for one in whole))
        full = [one for one in trained if one.variant == "full"]
        counts = sorted({one.top_k for one in full if one.top_k is not None})
        return cls(
            telea=rows["telea"].scores.mean("psnr", "holes"),
            scenes=len({cell.key.scene for cell in cells}),
            variants=tuple(_line(v, [o for o in whole if o.variant == v], whole, rows, scores) for v in variants),
            top_k=tuple(
                _line("all" if k is None else str(k), [o for o in full if o.top_k == k], whole, rows, scores)
                for k in (*counts, None)
            ),
        )


def markdown(ablation: Ablation) -> str:
    """Two tables."""
    styles = list(ablation.variants[0].loss_by_style)
    header = ["variant", "holes, dB", "loss against full", *(f"loss, {style}" for style in styles), "whole, dB", "ms"]
    lines = [
        f"{ablation.scenes} scenes of P, upon white. Telea: {_figure(ablation.telea)} dB in the holes. Seeds after the "
        "mean.",
        "",
    ]
    lines += _table(header, [_cells(line, styles) for line in ablation.variants])
    lines += ["", "The full model by the number of context tokens that survive:", ""]
    lines += _table(["top-k", *header[1:]], [_cells(line, styles) for line in ablation.top_k])
    return "\n".join(lines) + "\n"


def to_json(ablation: Ablation) -> str:
    """All figures."""
    return json.dumps(asdict(ablation), indent=1, allow_nan=False) + "\n"


def plots(ablation: Ablation) -> str:
    """An SVG: what each variant loses, a dot for each seed; and quality against milliseconds by top-k.

    Raises:
        MissingMatplotlibError: matplotlib is not installed.
    """
    losses = [(line.name, [v for v in line.loss if v is not None]) for line in ablation.variants[1:]]
    points = [(line.name, line.ms, mean(line.holes)) for line in ablation.top_k]
    known = [(name, ms, db) for name, ms, db in points if ms is not None and db is not None]
    return ablation_plot(losses, known, "loss in the holes against full, dB")


def _line(
    name: str, models: Sequence[Trained], whole: Sequence[Trained], rows: dict[str, Row], scores: Records
) -> Line:
    own = [rows[str(one.folder)] for one in models]
    full = {one.seed: str(one.folder) for one in whole if one.variant == "full"}
    losses = [_losses(str(one.folder), full[one.seed], scores) for one in models]
    styles = sorted({record.style for record in scores})
    return Line(
        name=name,
        holes=tuple(row.scores.mean("psnr", "holes") for row in own),
        whole=tuple(row.scores.mean("psnr", "whole") for row in own),
        ms=mean([row.speed.ms_p50 if row.speed else None for row in own]),
        loss=tuple(mean([loss for _, loss in each]) for each in losses),
        loss_by_style={
            style: mean([mean([loss for s, loss in each if s == style]) for each in losses]) for style in styles
        },
    )


def _losses(method: str, full: str, scores: Records) -> list[tuple[str, float]]:
    """Style and loss of each scene that both have."""
    own = scores.where(method=method)
    styles = {record.scene: record.style for record in own}
    return [(styles[scene], loss) for scene, loss in gains(scores.where(method=full), own).items()]


def _cells(line: Line, styles: Sequence[str]) -> list[str]:
    by_style = [_figure(line.loss_by_style.get(style)) for style in styles]
    return [line.name, _seeds(line.holes), _seeds(line.loss), *by_style, _seeds(line.whole), _figure(line.ms)]


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    return [f"| {' | '.join(cells)} |" for cells in (header, ["---"] * len(header), *rows)]


def _seeds(values: Sequence[float | None]) -> str:
    return f"{_figure(mean(values))} ({', '.join(map(_figure, values))})"


def _figure(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"
