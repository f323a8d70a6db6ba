"""What an ablation found: each variant against the full model, seed by seed; quality against top-k; plots."""

import json
import statistics
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from viewmend.evaluation.averages import Row, average_cell, tables
from viewmend.evaluation.cells import Cell


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
        rows = {row.method: row for row in tables(cells, methods)[0].rows}
        whole = [one for one in trained if one.top_k is None]
        variants = list(dict.fromkeys(one.variant for one in whole))
        full = [one for one in trained if one.variant == "full"]
        counts = sorted({one.top_k for one in full if one.top_k is not None})
        return cls(
            telea=rows["telea"].scores.psnr_holes,
            scenes=len({cell.key.scene for cell in cells}),
            variants=tuple(_line(v, [o for o in whole if o.variant == v], whole, rows, cells) for v in variants),
            top_k=tuple(
                _line("all" if k is None else str(k), [o for o in full if o.top_k == k], whole, rows, cells)
                for k in (*counts, None)
            ),
        )


def markdown(ablation: Ablation) -> str:
    """Two tables."""
    styles = list(ablation.variants[0].loss_by_style)
    header = ["variant", "holes, dB", "loss against full", *(f"loss, {style}" for style in styles), "whole, dB", "ms"]
    lines = [
        f"{ablation.scenes} scenes of P-stage. Telea: {_figure(ablation.telea)} dB in the holes. Seeds after the mean.",
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
    """An SVG: what each variant loses, a dot for each seed; and quality against milliseconds by top-k."""
    others = ablation.variants[1:]
    values = [v for line in others for v in line.loss if v is not None]
    low, high = min([0.0, *values]), max([0.1, *values])
    rows = 30 * len(others) + 70

    def x(value: float) -> float:
        return 220 + 300 * (value - low) / (high - low)

    parts = [_text(220, 24, "loss in the holes against full, dB"), _path([(x(0.0), 36), (x(0.0), rows - 30)], "#888")]
    for n, line in enumerate(others):
        y = 50 + 30 * n
        parts.append(_text(8, y + 5, line.name))
        parts += [_dot(x(v), y, "#d33") for v in line.loss if v is not None]
    parts += [_text(x(v), rows - 12, f"{v:.2f}") for v in (low, high)]
    points = [(line.ms, _mean(line.holes), line.name) for line in ablation.top_k]
    known = [(ms, db, name) for ms, db, name in points if ms is not None and db is not None]
    if known:
        parts += _curve(known, 600, 50, 300, rows - 110)
    size = f'width="1100" height="{rows}" viewBox="0 0 1100 {rows}"'
    body = "\n".join(parts)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" {size} font-family="sans-serif" font-size="14">\n'
        f'<rect width="100%" height="100%" fill="white"/>\n{body}\n</svg>\n'
    )


def _line(
    name: str, models: Sequence[Trained], whole: Sequence[Trained], rows: dict[str, Row], cells: Sequence[Cell]
) -> Line:
    own = [rows[str(one.folder)] for one in models]
    full = {one.seed: str(one.folder) for one in whole if one.variant == "full"}
    losses = [_losses(str(one.folder), full[one.seed], cells) for one in models]
    styles = sorted({cell.style for cell in cells})
    return Line(
        name=name,
        holes=tuple(row.scores.psnr_holes for row in own),
        whole=tuple(row.scores.psnr_whole for row in own),
        ms=_mean([row.speed.ms_p50 if row.speed else None for row in own]),
        loss=tuple(_mean([loss for _, loss in each]) for each in losses),
        loss_by_style={
            style: _mean([_mean([loss for s, loss in each if s == style]) for each in losses]) for style in styles
        },
    )


def _losses(method: str, full: str, cells: Sequence[Cell]) -> list[tuple[str, float]]:
    """Style and loss of each scene that both have."""
    scores = {(c.key.scene, c.key.method): (c.style, average_cell(c).scores.psnr_holes) for c in cells if not c.error}
    found = []
    for (scene, of), (style, holes) in scores.items():
        _, best = scores.get((scene, full), (style, None))
        if of == method and holes is not None and best is not None:
            found.append((style, best - holes))
    return found


def _cells(line: Line, styles: Sequence[str]) -> list[str]:
    by_style = [_figure(line.loss_by_style.get(style)) for style in styles]
    return [line.name, _seeds(line.holes), _seeds(line.loss), *by_style, _seeds(line.whole), _figure(line.ms)]


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    return [f"| {' | '.join(cells)} |" for cells in (header, ["---"] * len(header), *rows)]


def _seeds(values: Sequence[float | None]) -> str:
    return f"{_figure(_mean(values))} ({', '.join(map(_figure, values))})"


def _figure(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return statistics.fmean(known) if known else None


def _curve(points: Sequence[tuple[float, float, str]], left: int, top: int, width: int, height: int) -> list[str]:
    """PSNR over milliseconds, a dot with its name for each top-k."""
    ms, db = [p[0] for p in points], [p[1] for p in points]
    wide, tall = max(ms) - min(ms) or 1, max(db) - min(db) or 1
    at = [(left + width * (m - min(ms)) / wide, top + height * (max(db) - d) / tall) for m, d, _ in points]
    parts = [
        _text(left, 24, f"dB of full by top-k ({min(db):.2f} to {max(db):.2f}), ms ({min(ms):.0f} to {max(ms):.0f})")
    ]
    parts.append(_path(at, "#36c"))
    for (x, y), (_, _, name) in zip(at, points, strict=True):
        parts += [_dot(x, y, "#36c"), _text(x + 6, y - 6, name)]
    return parts


def _text(x: float | int, y: float | int, text: str) -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}">{text}</text>'


def _dot(x: float | int, y: float | int, colour: str) -> str:
    return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" fill="{colour}"/>'


def _path(points: Sequence[tuple[float | int, float | int]], colour: str) -> str:
    joined = " L".join(f"{x:.1f} {y:.1f}" for x, y in points)
    return f'<path d="M{joined}" stroke="{colour}" fill="none"/>'
