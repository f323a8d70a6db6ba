"""Scores as long records, one figure each: tables, pages and plots are queries of them."""

import statistics
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields

from viewmend.evaluation.cells import Cell
from viewmend.evaluation.frame_scores import FrameScores, Scores
from viewmend.metrics.view_scores import ENOUGH_HOLE_PX

REGIONS = ("holes_fg", "holes", "masked", "whole", "subject", "still", "past")
"""Pixels that a score is of: the end of its field's name."""
OTHERWISE = {"alpha_iou": ("alpha_iou", "whole"), "psnr_whole_rendered": ("psnr_rendered", "whole")}
"""Metric and region of fields that do not end so; others are of the holes."""


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
    """The mean over the frames that have one."""


@dataclass(frozen=True)
class Records:
    """Figures to ask for."""

    all: tuple[Record, ...]

    def __iter__(self) -> Iterator[Record]:
        return iter(self.all)

    def where(self, **facts: str) -> "Records":
        """The figures of one method, one set and so on, by the names of the records' fields."""
        return Records(tuple(r for r in self.all if all(getattr(r, name) == fact for name, fact in facts.items())))

    def by_scene(self, metric: str, region: str) -> dict[str, float]:
        """One method's figures, by the names of the scenes that have one."""
        return {r.scene: r.value for r in self.all if (r.metric, r.region) == (metric, region)}

    def mean(self, metric: str, region: str) -> float | None:
        """One method's mean over its scenes; None where none has a figure."""
        return mean(self.by_scene(metric, region).values())


def records(cells: Iterable[Cell]) -> Records:
    """What these cells scored; scores in the holes are of frames with enough pixels of the kind."""
    return Records(tuple(record for cell in cells for record in _of_cell(cell)))


def over_sets(per_set: Iterable[Records]) -> Records:
    """Each set's means as records again, with the set as their scene: their mean is the mean of the sets' means."""
    found: dict[tuple[str, str, str, str], list[float]] = {}
    for own in per_set:
        for r in own:
            found.setdefault((r.set, r.method, r.region, r.metric), []).append(r.value)
    return Records(
        tuple(
            Record(set_, set_, "", "", method, region, metric, statistics.fmean(values))
            for (set_, method, region, metric), values in found.items()
        )
    )


def mean(values: Iterable[float | None]) -> float | None:
    """Over those that are there; None without any."""
    there = [value for value in values if value is not None]
    return statistics.fmean(there) if there else None


def wide(frames: Sequence[FrameScores]) -> list[FrameScores]:
    """Frames with enough hole pixels to say something."""
    return [frame for frame in frames if frame.hole_px >= ENOUGH_HOLE_PX]


def _of_cell(cell: Cell) -> Iterator[Record]:
    facts = cell.key.scene, cell.set, cell.rig, cell.style, cell.key.method
    inside = [frame for frame in cell.frames if frame.hole_fg_px >= ENOUGH_HOLE_PX]
    past = [frame for frame in cell.frames if frame.past_px >= ENOUGH_HOLE_PX]
    holes = wide(cell.frames)
    enough = {"holes": holes, "masked": holes, "fg": inside, "past": past}  # by the last word of a name
    figures = {
        _place(f.name): mean(getattr(frame, f.name) for frame in enough.get(f.name.split("_")[-1], cell.frames))
        for f in fields(Scores)
    }
    figures["hole_fraction", "hull"] = mean(f.hole_px / f.hull_px if f.hull_px else 0.0 for f in cell.frames)
    figures["hole_fraction", "image"] = mean(f.hole_px / f.image_px for f in cell.frames)
    figures["hole_fraction", "only_past"] = mean(f.past_px / f.hole_fg_px for f in inside)
    for (metric, region), value in figures.items():
        if value is not None:
            yield Record(*facts, region, metric, value)


def _place(name: str) -> tuple[str, str]:
    """Metric and region of a field of `Scores`."""
    region = next((region for region in REGIONS if name.endswith(f"_{region}")), None)
    return OTHERWISE.get(name) or ((name, "holes") if region is None else (name.removesuffix(f"_{region}"), region))
