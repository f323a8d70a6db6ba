"""A report's tables: queries of the records, set by set and kind by kind."""

import statistics
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch

from viewmend.evaluation.cells import Cell
from viewmend.evaluation.records import Records, mean, over_sets, records, wide
from viewmend.evaluation.scorers import KINDS
from viewmend.methods import REFERENCE
from viewmend.metrics.vfid import frechet_distance


@dataclass(frozen=True)
class Row:
    """One method in a table."""

    method: str
    scores: Records = field(repr=False)
    """The method's figures, one of each scene; of each set in a table over all."""
    over_reference: float | None
    """PSNR in the holes over that of `REFERENCE`, mean over the scenes where both have it."""
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


def tables(cells: Sequence[Cell], methods: Sequence[str]) -> list[Table]:
    """One for each set, and one over all sets first if there are several (the mean of the sets' means)."""
    sets = list(dict.fromkeys(cell.set for cell in cells))
    per_set = [_table(name, [c for c in cells if c.set == name], methods) for name in sets]
    return per_set if len(sets) < 2 else [_overall(per_set, cells), *per_set]


def tables_by_kind(cells: Sequence[Cell], methods: Sequence[str]) -> list[Table]:
    """Tables of each set: one for each rig and each style that it has more than one of."""
    found = []
    for name in dict.fromkeys(cell.set for cell in cells):
        own = [c for c in cells if c.set == name]
        for kind in ("rig", "style"):
            values = list(dict.fromkeys(getattr(c, kind) for c in own))
            for value in values if len(values) > 1 else []:
                part = [c for c in own if getattr(c, kind) == value]
                found.append(_table(f"{name}, {value}", part, methods))
    return found


def gains(own: Records, other: Records) -> dict[str, float]:
    """Scene by scene, one method's PSNR in the holes over another's, where both have one."""
    reference = other.by_scene("psnr", "holes")
    return {scene: db - reference[scene] for scene, db in own.by_scene("psnr", "holes").items() if scene in reference}


def _table(title: str, cells: Sequence[Cell], methods: Sequence[str]) -> Table:
    # All methods of a scene saw the same frames: any cell that did not fail counts them.
    frames = [f for cell in {c.key.scene: c for c in cells if c.error is None}.values() for f in cell.frames]
    sizes = dict.fromkeys((f.width_px, f.height_px) for f in frames)
    thin, empty = len(frames) - len(wide(frames)), sum(f.hole_px == 0 for f in frames)
    scores = records(cells)
    rows = tuple(_row(name, [c for c in cells if c.key.method == name], scores) for name in methods)
    return Table(title, rows, len(frames), thin, empty, tuple(sizes))


def _row(method: str, cells: Sequence[Cell], scores: Records) -> Row:
    done = [cell for cell in cells if cell.error is None]
    own = scores.where(method=method)
    gained = gains(own, scores.where(method=REFERENCE)).values()
    return Row(
        method=method,
        scores=own,
        over_reference=mean(gained),
        below_reference=sum(gain < 0 for gain in gained),
        scenes=len(cells),
        scored_scenes=len(own.by_scene("psnr", "holes")),
        failed=len(cells) - len(done),
        vfid=vfid(done),
        speed=speed(done),
    )


def _overall(per_set: Sequence[Table], cells: Sequence[Cell]) -> Table:
    rows = []
    for parts in zip(*(table.rows for table in per_set), strict=True):
        name = parts[0].method
        counts = ("below_reference", "scenes", "scored_scenes", "failed")
        rows.append(
            Row(
                method=name,
                scores=over_sets(row.scores for row in parts),
                over_reference=mean(row.over_reference for row in parts),
                **{count: sum(getattr(row, count) for row in parts) for count in counts},
                vfid=Vfid(**{kind: mean(getattr(row.vfid, kind) for row in parts) for kind in KINDS}),
                speed=speed([c for c in cells if c.key.method == name and c.error is None]),
            )
        )
    frames, thin, empty = (sum(getattr(t, name) for t in per_set) for name in ("frames", "thin_frames", "empty_frames"))
    sizes = dict.fromkeys(size for table in per_set for size in table.sizes_px)
    return Table("mean of the sets", tuple(rows), frames, thin, empty, tuple(sizes))


def vfid(cells: Sequence[Cell]) -> Vfid:
    """Between all videos of these cells and of their scenes' truths."""
    pairs = [(c.features, c.true_features) for c in cells if c.features is not None and c.true_features is not None]
    if not pairs:
        return Vfid(*[None] * len(KINDS))
    sides = {kind: [torch.from_numpy(np.concatenate([p[n][kind] for p in pairs])) for n in (0, 1)] for kind in KINDS}
    return Vfid(**{kind: frechet_distance(*side) for kind, side in sides.items()})


def speed(cells: Sequence[Cell]) -> Speed | None:
    """Speed of the steps in frames that have a hole."""
    taken = sorted(f.step_ms for cell in cells for f in cell.frames if f.hole_px)
    if not taken:
        return None
    p95 = taken[min(len(taken) - 1, int(0.95 * len(taken)))]
    return Speed(1000 / max(statistics.fmean(taken), 1e-6), statistics.median(taken), p95)
