"""Score whole views: python benchmarks/whole_views.py [--models NAME ...] [--sets SET ...] [--background white].

One frame of scenes in which a camera is left out. Each model runs with its own error rule. NAME@0.15 restricts it with
the rule `predicted` to that share of the hull, NAME@0 samples no camera, as in a moving live view, and NAME! is not
calibrated to the rig. SET is P, Q:PERFORMERS, or CAPTURE:INPUTS, for example ../shared/captures/wd2:8.
"""

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import fmean

import cv2
import torch
from measure import write
from torch import Tensor

from viewmend.data.holdout.capture_scenes import capture_set
from viewmend.data.holdout.scenes import LeaveOneOutScene
from viewmend.data.holdout.studio_scenes import performer_set, procedural_set
from viewmend.evaluation.scores import Scorers, TrueView, ViewScores, score_view, true_view
from viewmend.models.base import RenderQuality
from viewmend.models.compositing import Background
from viewmend.models.registry import make_method
from viewmend.rendering.view import RenderConfig
from viewmend.stream import Stream, StreamConfig
from viewmend.types import CompletedView
from viewmend.utils.contact_sheet import Tile, contact_sheet, picture

SHOWN = ("psnr_whole", "ssim_whole", "psnr_subject", "psnr_holes", "alpha_iou")
PADDING_PX = 16


def main() -> None:
    """Score every model on every set, and print a table of means."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--models", nargs="+", default=["unfilled", "telea", "rays", "views"])
    parser.add_argument("--sets", nargs="+", default=["P"])
    parser.add_argument("--views", type=int, default=8, help="number of views per set, evenly spaced")
    parser.add_argument("--size", type=int, default=320, help="width and height of the views of P and Q")
    parser.add_argument(
        "--background", choices=("black", "white"), default="black", help="background of views and truth"
    )
    parser.add_argument("--sheets", type=Path, help="folder for a picture of each view by each model")
    parser.add_argument("--write", action="store_true", help="write the result to benchmarks/results")
    options = parser.parse_args()
    found = {name: judge(some(name, options.size, options.views), options) for name in options.sets}
    if options.write:
        config = {key: getattr(options, key) for key in ("models", "sets", "views", "size", "background")}
        print(write("whole_views", "cpu", config, found))


def some(name: str, size_px: int, count: int) -> Sequence[LeaveOneOutScene]:
    """The chosen scenes of a set."""
    kind, _, rest = name.partition(":")
    if kind == "P":
        scenes: Sequence[LeaveOneOutScene] = procedural_set(1, size_px)
    elif kind == "Q":
        scenes = performer_set(Path(rest), frames=1, size_px=size_px)
    else:
        scenes = capture_set(Path(kind), rest or "all", 1)
    return [scenes[len(scenes) * n // count] for n in range(min(count, len(scenes)))]


def judge(scenes: Sequence[LeaveOneOutScene], options: argparse.Namespace) -> dict[str, dict[str, float | None]]:
    """Print and return the mean scores of each model."""
    scores: dict[str, list[ViewScores]] = {model: [] for model in options.models}
    scorers = Scorers(options.background)
    for scene in scenes:
        shown = {}
        for model, completed, truth in completed_views(scene, options.models, options.background):
            scores[model].append(score_view(completed, truth, scorers))
            shown[f"{model} {scores[model][-1].psnr_whole:.2f} dB"] = completed.rgb
            shown["truth"] = shown.pop("truth", truth.rgb)  # at the end
        if options.sheets:
            save(shown, options.sheets / f"{scene.name}.png")
    means = {model: mean_scores(own) for model, own in scores.items()}
    print(f"{scenes[0].set}, {len(scenes)} views: {', '.join(SHOWN)}")
    for model, own in means.items():
        print(f"  {model:28s}", *(f"{own[key]:7.3f}" for key in SHOWN), flush=True)
    return means


def completed_views(
    scene: LeaveOneOutScene, models: Sequence[str], background: Background
) -> Iterator[tuple[str, CompletedView, TrueView]]:
    """The first frame of a scene by each model, and the truth."""
    frame = next(iter(scene.frames("cpu")))
    truth = true_view(frame.truth, background)
    for model in models:
        name, _, fraction = model.rstrip("!").partition("@")
        part = float(fraction or 0)
        rule = RenderConfig(error_rule="predicted", refine_fraction=part) if part else RenderConfig()
        config = StreamConfig(memory_mb=None, render=rule, background=background)
        stream = Stream(make_method(name), config, frame.bounds)
        if model[-1] != "!":
            stream.calibrate(frame.inputs)
        stream.add_frame(frame.inputs)
        quality = RenderQuality(refine_fraction=0.0 if fraction and not part else None)
        yield model, stream.view(frame.truth.cameras, quality=quality).completed, truth


def mean_scores(scores: Sequence[ViewScores]) -> dict[str, float | None]:
    """Means over the views that have a score."""
    found = {key: [v for s in scores if (v := getattr(s, key)) is not None] for key in SHOWN}
    return {key: round(fmean(values), 4) if values else None for key, values in found.items()}


def save(shown: dict[str, Tensor], path: Path) -> None:
    """Write the images side by side, cropped to the subject."""
    there = torch.stack([image.amax(0) > 0 for image in shown.values()]).any(0)
    (top, bottom), (left, right) = ((int(at.min()), int(at.max()) + 1) for at in torch.nonzero(there).T)
    part = slice(max(0, top - PADDING_PX), bottom + PADDING_PX), slice(max(0, left - PADDING_PX), right + PADDING_PX)
    path.parent.mkdir(parents=True, exist_ok=True)
    sheet = contact_sheet([[Tile(name, picture(image[:, *part])) for name, image in shown.items()]])
    cv2.imwrite(str(path), cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR))


if __name__ == "__main__":
    main()
