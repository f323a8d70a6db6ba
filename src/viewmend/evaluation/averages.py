"""Turns the scores of frames into the tables of a report.

Scores are averaged over the frames of a scene first: a `Record` is one metric of one method on one
scene. Tables and files are queries of records.
"""

import statistics
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, fields, replace

import numpy as np
import torch

from viewmend.evaluation.result_cache import Cell
from viewmend.evaluation.scores import KINDS, MIN_HOLE_PX, ViewScores
from viewmend.metrics.vfid import frechet_distance
from viewmend.models.registry import REFERENCE

REGIONS = ("holes_fg", "holes", "masked", "whole", "subject", "valid", "still", "sources", "others", "past")
"""Pixels that a score covers: the last part of its field's name."""
MIN_ERROR_SCENES = 3
"""Fewest scenes whose scores have a standard error."""
ORIGINS = ("sources", "others", "past")
"""Regions by what shows the surface of a hole (`PixelOrigins`)."""
IRREGULAR = {
    "alpha_iou": ("alpha_iou", "whole"),
    "hull_iou": ("hull_iou", "whole"),
    "psnr_whole_rendered": ("psnr_rendered", "whole"),
}
"""Metric and region of fields whose name does not end with a region; all others refer to the holes."""


@dataclass(frozen=True)
class Record:
    """One metric of one region of the pixels, of one method on one scene."""

    scene: str
    set: str
    rig: str
    style: str
    method: str
    region: str
    metric: str
    value: float
    """Mean over the frames that have one."""


@dataclass(frozen=True)
class Records:
    """A set of records."""

    all: tuple[Record, ...]

    def __iter__(self) -> Iterator[Record]:
        return iter(self.all)

    def where(self, **facts: str) -> "Records":
        """The records whose fields have these values."""
        return Records(
            tuple(r for r in self.all if all(getattr(r, name) == fact for name, fact in facts.items()))
        )

    def by_scene(self, metric: str, region: str) -> dict[str, float]:
        """Values by scene, of the records of one method."""
        return {r.scene: r.value for r in self.all if (r.metric, r.region) == (metric, region)}

    def mean(self, metric: str, region: str) -> float | None:
        """Mean over scenes, of the records of one method; None without any."""
        return mean(self.by_scene(metric, region).values())

    def standard_error(self, metric: str, region: str) -> float | None:
        """Standard error of `mean` over scenes; None for means of sets, or below `MIN_ERROR_SCENES`."""
        scenes = Records(tuple(r for r in self.all if r.scene != r.set))
        values = list(scenes.by_scene(metric, region).values())
        if len(values) < MIN_ERROR_SCENES:
            return None
        return statistics.stdev(values) / len(values) ** 0.5


@dataclass(frozen=True)
class Speed:
    """Duration of an inpainter's steps."""

    fps: float
    """1000 / mean milliseconds."""
    ms_p50: float
    ms_p95: float


@dataclass(frozen=True)
class Row:
    """One method in a table."""

    method: str
    scores: Records = field(repr=False)
    """Its records: one per scene, or one per set in a table over all sets."""
    over_reference: float | None
    """Gain in PSNR in the holes over `REFERENCE`: mean over the scenes where both have a score."""
    below_reference: int
    """Number of scenes with a loss."""
    scenes: int
    scored_scenes: int
    """Scenes that have a frame with enough hole pixels."""
    failed: int
    vfid: dict[str, float | None]
    """VFID by `scores.KINDS`; None without I3D or with a single video."""
    speed: Speed | None
    """Speed over all frames with holes; None without any."""


@dataclass(frozen=True)
class Table:
    """Methods on a set of scenes."""

    title: str
    rows: tuple[Row, ...]
    frames: int
    """Number of frames of all scenes."""
    thin_frames: int
    """Frames with too few hole pixels for the scores in the holes."""
    empty_frames: int
    """Frames without holes; they count as thin, too."""
    sizes_px: tuple[tuple[int, int], ...]
    """Widths and heights of the views."""


def records(cells: Iterable[Cell]) -> Records:
    """The scores of these cells; scores in the holes are means over the frames with enough pixels."""
    return Records(tuple(record for cell in cells for record in _records_of_cell(cell)))


def tables(cells: Sequence[Cell], methods: Sequence[str]) -> list[Table]:
    """One table per set; with several sets, first one over all (the mean of the sets' means)."""
    sets = list(dict.fromkeys(cell.set for cell in cells))
    per_set = [_table(name, [c for c in cells if c.set == name], methods) for name in sets]
    return per_set if len(sets) < 2 else [_overall(per_set, cells), *per_set]


def gains(own: Records, other: Records) -> dict[str, float]:
    """Gain of one method's PSNR in the holes over another's, by scene, where both have a score."""
    reference = other.by_scene("psnr", "holes")
    return {
        scene: db - reference[scene]
        for scene, db in own.by_scene("psnr", "holes").items()
        if scene in reference
    }


def mean(values: Iterable[float | None]) -> float | None:
    """Mean of the values that are not None; None without any."""
    there = [value for value in values if value is not None]
    return statistics.fmean(there) if there else None


def vfid(cells: Sequence[Cell]) -> dict[str, float | None]:
    """The distance between the videos of these cells and the true videos."""
    pairs = [
        (c.features, c.true_features) for c in cells if c.features is not None and c.true_features is not None
    ]
    if not pairs:
        return dict.fromkeys(KINDS)
    sides = {
        kind: [torch.from_numpy(np.concatenate([p[n][kind] for p in pairs])) for n in (0, 1)]
        for kind in KINDS
    }
    return {kind: frechet_distance(*side) for kind, side in sides.items()}


def speed(cells: Sequence[Cell]) -> Speed | None:
    """Speed of the steps on frames with holes."""
    taken = sorted(ms for cell in cells for ms, f in zip(cell.step_ms, cell.frames, strict=True) if f.hole_px)
    if not taken:
        return None
    p95 = taken[min(len(taken) - 1, int(0.95 * len(taken)))]
    return Speed(1000 / max(statistics.fmean(taken), 1e-6), statistics.median(taken), p95)


def frames_with_holes(frames: Sequence[ViewScores]) -> list[ViewScores]:
    """Frames with enough hole pixels to be scored there."""
    return [frame for frame in frames if frame.hole_px >= MIN_HOLE_PX]


def _records_of_cell(cell: Cell) -> Iterator[Record]:
    facts = cell.key.scene, cell.set, cell.rig, cell.style, cell.key.method
    inside = [frame for frame in cell.frames if frame.hole_fg_px >= MIN_HOLE_PX]
    holes = frames_with_holes(cell.frames)
    enough = {"holes": holes, "masked": holes, "fg": inside}  # by the last word of a field's name
    for origin in ORIGINS:
        enough[origin] = [frame for frame in cell.frames if getattr(frame, f"{origin}_px") >= MIN_HOLE_PX]
    names = [f.name for f in fields(ViewScores) if f.name != "time" and not f.name.endswith("_px")]
    figures = {
        _metric_and_region(name): mean(
            getattr(frame, name) for frame in enough.get(name.split("_")[-1], cell.frames)
        )
        for name in names
    }
    figures["hole_fraction", "hull"] = mean(f.hole_px / f.hull_px if f.hull_px else 0.0 for f in cell.frames)
    figures["hole_fraction", "image"] = mean(f.hole_px / f.image_px for f in cell.frames)
    if _origins_are_known(cell.frames):
        figures["hole_fraction", "only_past"] = mean(f.past_px / f.hole_fg_px for f in inside)
    for kind, count in _composition(holes).items():
        figures["share_of_holes", kind] = count
    for (metric, region), value in figures.items():
        if value is not None:
            yield Record(*facts, region, metric, value)


def _composition(frames: Sequence[ViewScores]) -> dict[str, float | None]:
    """What the holes are made of: mean fractions over the frames; nothing if it is not known."""
    if not _origins_are_known(frames):
        return {}
    counts = {
        "phantom": lambda f: f.hole_px - f.hole_fg_px,
        "sources": lambda f: f.sources_px,
        "others": lambda f: f.others_px,
        "past": lambda f: f.only_past_px,
        "sources_past": lambda f: f.past_px,
    }
    return {kind: mean(count(f) / f.hole_px for f in frames) for kind, count in counts.items()}


def _origins_are_known(frames: Sequence[ViewScores]) -> bool:
    """Whether the scene says what shows the surface in its holes."""
    return any(f.sources_px or f.others_px or f.past_px for f in frames)


def _metric_and_region(name: str) -> tuple[str, str]:
    region = next((region for region in REGIONS if name.endswith(f"_{region}")), None)
    return IRREGULAR.get(name) or (
        (name, "holes") if region is None else (name.removesuffix(f"_{region}"), region)
    )


def _table(title: str, cells: Sequence[Cell], methods: Sequence[str]) -> Table:
    # All methods of a scene have the same frames: count them in any cell that did not fail.
    frames = [f for cell in {c.key.scene: c for c in cells if c.error is None}.values() for f in cell.frames]
    sizes = dict.fromkeys((f.width_px, f.height_px) for f in frames)
    thin = len(frames) - len(frames_with_holes(frames))
    empty = sum(f.hole_px == 0 for f in frames)
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
                scores=_average_sets(row.scores for row in parts),
                over_reference=mean(row.over_reference for row in parts),
                **{count: sum(getattr(row, count) for row in parts) for count in counts},
                vfid={kind: mean(row.vfid[kind] for row in parts) for kind in KINDS},
                speed=speed([c for c in cells if c.key.method == name and c.error is None]),
            )
        )
    frames, thin, empty = (
        sum(getattr(t, name) for t in per_set) for name in ("frames", "thin_frames", "empty_frames")
    )
    sizes = dict.fromkeys(size for table in per_set for size in table.sizes_px)
    return Table("mean of the sets", tuple(rows), frames, thin, empty, tuple(sizes))


def _average_sets(per_set: Iterable[Records]) -> Records:
    """Records of each set's means, with the set in place of the scene."""
    found: dict[Record, list[float]] = {}
    for r in (record for own in per_set for record in own):
        found.setdefault(replace(r, scene=r.set, rig="", style="", value=0.0), []).append(r.value)
    return Records(tuple(replace(record, value=statistics.fmean(values)) for record, values in found.items()))
