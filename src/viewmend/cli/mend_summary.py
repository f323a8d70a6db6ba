"""The scores of a run of mended views, for programs and in words."""

from dataclasses import asdict
from statistics import mean, median

from viewmend.cli.mending import MendStep
from viewmend.metrics.view_scores import ViewScores, mean_over_frames
from viewmend.pipeline import StageMs


class MendSummary:
    """Gathers the steps of a run, without their images."""

    def __init__(self) -> None:
        self.frames = 0
        self._hull_px = self._holes_px = 0
        self._ours: list[ViewScores] = []
        self._telea: list[ViewScores] = []
        self._iou: dict[str, list[float]] = {}
        self._stages: list[StageMs] = []

    def add(self, step: MendStep) -> None:
        """Count one more view."""
        view = step.completed.view
        self.frames += 1
        self._hull_px += int((view.mask > 0.5).sum())
        self._holes_px += int((view.error > 0).sum())
        if step.ours is not None and step.telea is not None:
            self._ours.append(step.ours)
            self._telea.append(step.telea)
        for name, iou in step.hull_iou.items():
            self._iou.setdefault(name, []).append(iou)
        self._stages.append(step.stage_ms)

    def as_json(self) -> dict[str, object]:
        """The scores; null where there are no such pixels, or no truth. Times are medians, milliseconds."""
        return {
            "frames": self.frames,
            "hole_fraction": self._holes_px / self._hull_px if self._hull_px else None,
            "psnr_whole": mean_over_frames([s.psnr_whole for s in self._ours]),
            "psnr_valid": mean_over_frames([s.psnr_valid for s in self._ours]),
            "psnr_holes": _in_holes(self._ours),
            "psnr_holes_telea": _in_holes(self._telea),
            "psnr_holes_fg": _in_holes_fg(self._ours),
            "psnr_holes_fg_telea": _in_holes_fg(self._telea),
            "hull_iou": {name: mean(values) for name, values in self._iou.items()},
            "stage_ms": self._stage_ms(),
        }

    def _stage_ms(self) -> dict[str, float]:
        times = [asdict(stages) for stages in self._stages]
        return {stage: median(t[stage] for t in times) for stage in times[0]} if times else {}

    def in_words(self) -> list[str]:
        """The same for people, line by line."""
        stages, iou = self._stage_ms(), [value for values in self._iou.values() for value in values]
        share = 100 * self._holes_px / self._hull_px if self._hull_px else 0.0
        lines = [
            f"{self.frames} view{'s' if self.frames != 1 else ''}; holes {share:.2f} % of the hull's pixels; "
            f"hull IoU {mean(iou):.3f}, lowest {min(iou):.3f}",
            "a frame takes " + ", ".join(f"{name} {ms:.1f} ms" for name, ms in stages.items()),
        ]
        if self._ours:
            whole = mean_over_frames([s.psnr_whole for s in self._ours])
            valid = mean_over_frames([s.psnr_valid for s in self._ours])
            lines += [
                "PSNR, dB",
                f"  whole image           {_db(whole)}",
                f"  rendered pixels       {_db(valid)}",
                f"  holes                 {_db(_in_holes(self._ours))}   Telea {_db(_in_holes(self._telea))}",
                f"  holes on the subject  {_db(_in_holes_fg(self._ours))}   Telea {_db(_in_holes_fg(self._telea))}",
            ]
        return lines


def _in_holes(scores: list[ViewScores]) -> float | None:
    return mean_over_frames([s.psnr_holes for s in scores], [s.holes_px for s in scores])


def _in_holes_fg(scores: list[ViewScores]) -> float | None:
    return mean_over_frames([s.psnr_holes_fg for s in scores], [s.holes_fg_px for s in scores])


def _db(value: float | None) -> str:
    return "    -" if value is None else f"{value:5.2f}"
