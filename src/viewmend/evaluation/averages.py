"""How the figures of a report are averaged, from frames to scenes to sets."""

import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch

from viewmend.evaluation.cells import Cell
from viewmend.evaluation.frame_scores import Scores
from viewmend.evaluation.scorers import KINDS
from viewmend.methods import REFERENCE
from viewmend.metrics.vfid import frechet_distance
from viewmend.metrics.view_scores import ENOUGH_HOLE_PX


@dataclass(frozen=True, kw_only=True)
class MeanScores(Scores):
    """Means of frames' scores; None where there is nothing to average."""

    holes_of_hull: float | None
    """Hole pixels as a share of those that the proxy covers."""
    holes_of_image: float | None
    """Hole pixels as a share of all."""
    past_of_surface: float | None = None
    """Hole pixels that only the past shows, as a share of those inside the true mask."""


@dataclass(frozen=True)
class CellScores:
    """One cell, averaged over its frames."""

    cell: Cell
    scores: MeanScores
    frames: int
    thin_frames: int
    """Frames left out of the scores in the holes: they have fewer than `ENOUGH_HOLE_PX` hole pixels."""
    empty_frames: int
    """Frames without any hole pixel: thin ones, too."""


@dataclass(frozen=True)
class Row:
    """One method in a table."""

    method: str
    scores: MeanScores
    """Means over scenes."""
    over_reference: float | None
    """`psnr_holes` over that of `REFERENCE`, mean over the scenes where both have it."""
    below_reference: int
    """Scenes where it is below the reference."""
    scenes: int
    scored_scenes: int
    """Scenes with a frame that has enough holes."""
    failed: int
    vfid: "Vfid"
    speed: "Speed | None"
    """Speed of the inpainter's step over all frames with holes; None without any."""


@dataclass(frozen=True)
class Vfid:
    """Distances of a method's videos from the truth's, by `scorers.KINDS`; None without I3D or with one video."""

    whole_eval: float | None
    masked_eval: float | None
    whole_train: float | None
    masked_train: float | None


@dataclass(frozen=True)
class Speed:
    """How long steps take."""

    fps: float
    """Frames a second if one step follows the other: 1000 over the mean."""
    ms_p50: float
    ms_p95: float


@dataclass(frozen=True)
class Table:
    """Methods on some scenes."""

    title: str
    rows: tuple[Row, ...]
    frames: int
    """Frames of all scenes together that any method has."""
    thin_frames: int
    """Frames left out of the scores in the holes: they miss too little."""
    empty_frames: int
    """Frames without any hole: thin ones, too."""
    sizes_px: tuple[tuple[int, int], ...]
    """Widths and heights of their views."""


def average_cell(cell: Cell) -> CellScores:
    """Means over the frames; scores in the holes over those with enough pixels of the kind."""
    frames = cell.frames
    wide = [f for f in frames if f.hole_px >= ENOUGH_HOLE_PX]
    inside = [f for f in frames if f.hole_fg_px >= ENOUGH_HOLE_PX]
    past = [f for f in frames if f.past_px >= ENOUGH_HOLE_PX]
    of = {"holes": wide, "masked": wide, "fg": inside, "past": past}  # by the last word of a score's name
    means = {
        f.name: _mean(getattr(frame, f.name) for frame in of.get(f.name.split("_")[-1], frames)) for f in fields(Scores)
    }
    scores = MeanScores(
        **means,
        holes_of_hull=_mean(f.hole_px / f.hull_px if f.hull_px else 0.0 for f in frames),
        holes_of_image=_mean(f.hole_px / f.image_px for f in frames),
        past_of_surface=_mean(f.past_px / f.hole_fg_px for f in inside),
    )
    return CellScores(cell, scores, len(frames), len(frames) - len(wide), sum(f.hole_px == 0 for f in frames))


def tables(cells: Sequence[Cell], methods: Sequence[str]) -> list[Table]:
    """One for each set, and one over all sets first if there are several (the mean of the sets' means)."""
    averaged = [average_cell(cell) for cell in cells]
    sets = list(dict.fromkeys(cell.set for cell in cells))
    per_set = [_table(name, [a for a in averaged if a.cell.set == name], methods) for name in sets]
    if len(sets) < 2:
        return per_set
    return [_overall(per_set, averaged, methods), *per_set]


def tables_by_kind(cells: Sequence[Cell], methods: Sequence[str]) -> list[Table]:
    """Tables of each set: one for each rig and each style that it has more than one of."""
    averaged = [average_cell(cell) for cell in cells]
    found = []
    for name in dict.fromkeys(cell.set for cell in cells):
        own = [a for a in averaged if a.cell.set == name]
        for kind in ("rig", "style"):
            values = list(dict.fromkeys(getattr(a.cell, kind) for a in own))
            for value in values if len(values) > 1 else []:
                part = [a for a in own if getattr(a.cell, kind) == value]
                found.append(_table(f"{name}, {value}", part, methods))
    return found


def mean_scores(many: Sequence[MeanScores]) -> MeanScores:
    """Field by field, over those that have one."""
    return MeanScores(**{f.name: _mean(getattr(scores, f.name) for scores in many) for f in fields(MeanScores)})


def _table(title: str, averaged: Sequence[CellScores], methods: Sequence[str]) -> Table:
    # All methods of a scene saw the same frames: any cell that did not fail counts them.
    scenes = {a.cell.key.scene: a for a in averaged if a.cell.error is None}
    frames, thin, empty = (
        sum(getattr(a, name) for a in scenes.values()) for name in ("frames", "thin_frames", "empty_frames")
    )
    sizes = dict.fromkeys((f.width_px, f.height_px) for a in scenes.values() for f in a.cell.frames)
    return Table(title, tuple(_row(name, averaged) for name in methods), frames, thin, empty, tuple(sizes))


def _row(method: str, averaged: Sequence[CellScores]) -> Row:
    own = [a for a in averaged if a.cell.key.method == method]
    done = [a for a in own if a.cell.error is None]
    gains = _gains(done, averaged)
    return Row(
        method=method,
        scores=mean_scores([a.scores for a in done]),
        over_reference=_mean(gains),
        below_reference=sum(gain < 0 for gain in gains),
        scenes=len(own),
        scored_scenes=sum(a.scores.psnr_holes is not None for a in done),
        failed=len(own) - len(done),
        vfid=vfid([a.cell for a in done]),
        speed=speed(done),
    )


def _overall(per_set: Sequence[Table], averaged: Sequence[CellScores], methods: Sequence[str]) -> Table:
    rows = []
    for n, name in enumerate(methods):
        parts = [table.rows[n] for table in per_set]
        rows.append(
            Row(
                method=name,
                scores=mean_scores([row.scores for row in parts]),
                over_reference=_mean(row.over_reference for row in parts),
                below_reference=sum(row.below_reference for row in parts),
                scenes=sum(row.scenes for row in parts),
                scored_scenes=sum(row.scored_scenes for row in parts),
                failed=sum(row.failed for row in parts),
                vfid=Vfid(**{kind: _mean(getattr(row.vfid, kind) for row in parts) for kind in KINDS}),
                speed=speed([a for a in averaged if a.cell.key.method == name and a.cell.error is None]),
            )
        )
    frames, thin, empty = (sum(getattr(t, name) for t in per_set) for name in ("frames", "thin_frames", "empty_frames"))
    sizes = dict.fromkeys(size for table in per_set for size in table.sizes_px)
    return Table("mean of the sets", tuple(rows), frames, thin, empty, tuple(sizes))


def _gains(done: Sequence[CellScores], averaged: Sequence[CellScores]) -> list[float]:
    """Scene by scene, the PSNR in the holes over that of the reference."""
    reference = {a.cell.key.scene: a.scores.psnr_holes for a in averaged if a.cell.key.method == REFERENCE}
    pairs = ((a.scores.psnr_holes, reference.get(a.cell.key.scene)) for a in done)
    return [own - other for own, other in pairs if own is not None and other is not None]


def vfid(cells: Sequence[Cell]) -> Vfid:
    """Between all videos of these cells and of their scenes' truths."""
    pairs = [(c.features, c.true_features) for c in cells if c.features is not None and c.true_features is not None]
    if not pairs:
        return Vfid(*[None] * len(KINDS))
    sides = {kind: [torch.from_numpy(np.concatenate([p[n][kind] for p in pairs])) for n in (0, 1)] for kind in KINDS}
    return Vfid(**{kind: frechet_distance(*side) for kind, side in sides.items()})


def speed(done: Sequence[CellScores]) -> Speed | None:
    """Speed of the steps in frames that have a hole."""
    taken = sorted(f.step_ms for a in done for f in a.cell.frames if f.hole_px)
    if not taken:
        return None
    p95 = taken[min(len(taken) - 1, int(0.95 * len(taken)))]
    return Speed(1000 / max(statistics.fmean(taken), 1e-6), statistics.median(taken), p95)


def _mean(values: Iterable[float | None]) -> float | None:
    there = [value for value in values if value is not None]
    return statistics.fmean(there) if there else None
