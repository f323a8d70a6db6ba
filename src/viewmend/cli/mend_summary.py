"""The scores of a run of mended views, for programs and in words."""

from dataclasses import asdict
from statistics import mean, median
from typing import Literal

from viewmend.cli.mending import MendStep, Scores
from viewmend.metrics.view_scores import ViewScores, mean_over_frames
from viewmend.timing import StageTimes

Fill = Literal["unfilled", "telea", "ours"]
Metric = Literal["psnr_whole", "psnr_valid", "psnr_holes", "psnr_holes_fg"]


class MendSummary:
    """Gathers the steps of a run, without their images."""

    def __init__(self) -> None:
        self.frames = 0
        self._hull_px = self._holes_px = 0
        self._scores: list[Scores] = []
        self._iou: dict[str, list[float]] = {}
        self._stages: list[StageTimes] = []

    def add(self, step: MendStep) -> None:
        """Count one more view."""
        view = step.completed.view
        self.frames += 1
        self._hull_px += int((view.mask > 0.5).sum())
        self._holes_px += int((view.error > 0).sum())
        if step.scores is not None:
            self._scores.append(step.scores)
        for name, iou in step.hull_iou.items():
            self._iou.setdefault(name, []).append(iou)
        self._stages.append(step.times)

    def as_json(self) -> dict[str, object]:
        """The scores; null where there are no such pixels, or no truth. Times are medians, milliseconds."""
        return {
            "frames": self.frames,
            "hole_fraction": self._holes_px / self._hull_px if self._hull_px else None,
            "psnr_whole": self.mean("ours", "psnr_whole"),
            "psnr_valid": self.mean("ours", "psnr_valid"),
            "psnr_holes": self.mean("ours", "psnr_holes"),
            "psnr_holes_telea": self.mean("telea", "psnr_holes"),
            "psnr_holes_fg": self.mean("ours", "psnr_holes_fg"),
            "psnr_holes_fg_telea": self.mean("telea", "psnr_holes_fg"),
            "hull_iou": {name: mean(values) for name, values in self._iou.items()},
            "stage_ms": self.stage_ms(),
        }

    def mean(self, fill: Fill, metric: Metric) -> float | None:
        """Mean over frames of one metric of one way to fill the holes; None where there are no such pixels."""
        scores: list[ViewScores] = [getattr(s, fill) for s in self._scores]
        pixels = {"psnr_holes": [s.holes_px for s in scores], "psnr_holes_fg": [s.holes_fg_px for s in scores]}
        return mean_over_frames([getattr(s, metric) for s in scores], pixels.get(metric))

    def stage_ms(self) -> dict[str, float]:
        """Median milliseconds of each stage."""
        times = [asdict(stages) for stages in self._stages]
        return {stage: median(t[stage] for t in times) for stage in times[0]} if times else {}

    def in_words(self) -> list[str]:
        """The same for people, line by line."""
        stages, iou = self.stage_ms(), [value for values in self._iou.values() for value in values]
        share = 100 * self._holes_px / self._hull_px if self._hull_px else 0.0
        lines = [
            f"{self.frames} view{'s' if self.frames != 1 else ''}; holes {share:.2f} % of the hull's pixels; "
            f"hull IoU {mean(iou):.3f}, lowest {min(iou):.3f}",
            "a frame takes " + ", ".join(f"{name} {ms:.1f} ms" for name, ms in stages.items()),
        ]
        if self._scores:
            lines += [
                "PSNR, dB",
                f"  whole image           {in_db(self.mean('ours', 'psnr_whole'))}",
                f"  rendered pixels       {in_db(self.mean('ours', 'psnr_valid'))}",
                f"  holes                 {self._ours_and_telea('psnr_holes')}",
                f"  holes on the subject  {self._ours_and_telea('psnr_holes_fg')}",
            ]
        return lines

    def _ours_and_telea(self, metric: Metric) -> str:
        return f"{in_db(self.mean('ours', metric))}   Telea {in_db(self.mean('telea', metric))}"


def in_db(value: float | None) -> str:
    """A figure of a table, five characters wide."""
    return "    -" if value is None else f"{value:5.2f}"
