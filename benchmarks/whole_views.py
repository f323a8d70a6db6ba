"""How good whole views are: python benchmarks/whole_views.py [--models NAME ...] [--sets SET ...] [--sheets DIR].

One time of scenes in which a camera is left out. Each model is asked for what it is made for; NAME@0.15 is the model
asked by the rule `wrong` for at most that part of the proxy, NAME@0 the model as it moves live, when nothing is read,
and NAME! the model that is not fitted to the rig. SET is P, Q:PERFORMERS, or CAPTURE:INPUTS, e.g.
../shared/captures/wd2:8.
"""

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import fmean

import cv2
import torch
from measure import write
from torch import Tensor

from viewmend.contact_sheet import Tile, contact_sheet, picture
from viewmend.evaluation.frame_scores import FrameScores, TrueView, score_frame, true_view
from viewmend.inpainting.protocol import RenderQuality
from viewmend.leave_one_out.capture_scenes import capture_set
from viewmend.leave_one_out.scenes import LeaveOneOutScene
from viewmend.leave_one_out.studio_scenes import performer_set, procedural_set
from viewmend.methods import make_method
from viewmend.rendering.view import RenderConfig
from viewmend.stream import Stream, StreamConfig
from viewmend.views import CompletedView

SHOWN = ("psnr_whole", "ssim_whole", "psnr_subject", "psnr_holes", "alpha_iou")
PADDING_PX = 16


def main() -> None:
    """Score every model on every set, and print a table of means."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--models", nargs="+", default=["unfilled", "small", "views", "views@0.15"])
    parser.add_argument("--sets", nargs="+", default=["P"])
    parser.add_argument("--views", type=int, default=8, help="so many of each set, evenly taken")
    parser.add_argument("--size", type=int, default=320, help="width and height of the views of P and Q")
    parser.add_argument("--sheets", type=Path, help="folder for a picture of each view: each model, and the truth")
    parser.add_argument("--write", action="store_true", help="keep the result under benchmarks/results")
    options = parser.parse_args()
    found = {
        name: judge(some(name, options.size, options.views), options.models, options.sheets) for name in options.sets
    }
    if options.write:
        config = {key: getattr(options, key) for key in ("models", "sets", "views", "size")}
        print(write("whole_views", "cpu", config, found))


def some(name: str, size_px: int, count: int) -> Sequence[LeaveOneOutScene]:
    """The scenes of a set that are looked at."""
    kind, _, rest = name.partition(":")
    if kind == "P":
        scenes: Sequence[LeaveOneOutScene] = procedural_set(1, size_px)
    elif kind == "Q":
        scenes = performer_set(Path(rest), frames=1, size_px=size_px)
    else:
        scenes = capture_set(Path(kind), rest or "all", 1)
    return [scenes[len(scenes) * n // count] for n in range(min(count, len(scenes)))]


def judge(
    scenes: Sequence[LeaveOneOutScene], models: Sequence[str], sheets: Path | None
) -> dict[str, dict[str, float | None]]:
    """Mean scores by model, which are also printed."""
    scores: dict[str, list[FrameScores]] = {model: [] for model in models}
    for scene in scenes:
        shown = {}
        for model, completed, truth in mended(scene, models):
            scores[model].append(score_frame(completed, truth, None, 0.0))
            shown[f"{model} {scores[model][-1].psnr_whole:.2f} dB"] = completed.rgb
            shown["truth"] = shown.pop("truth", truth.rgb)  # at the end
        if sheets:
            save(shown, sheets / f"{scene.name}.png")
    means = {model: mean_scores(own) for model, own in scores.items()}
    print(f"{scenes[0].set}, {len(scenes)} views: {', '.join(SHOWN)}")
    for model, own in means.items():
        print(f"  {model:28s}", *(f"{own[key]:7.3f}" for key in SHOWN), flush=True)
    return means


def mended(scene: LeaveOneOutScene, models: Sequence[str]) -> Iterator[tuple[str, CompletedView, TrueView]]:
    """The first time of a scene by each model, and what it should look like."""
    frame = next(iter(scene.frames("cpu")))
    truth = true_view(frame.truth, None)
    for model in models:
        name, _, fraction = model.rstrip("!").partition("@")
        part = float(fraction or 0)
        rule = RenderConfig(error_rule="wrong", wrong_fraction=part) if part else RenderConfig()
        stream = Stream(
            make_method(name), StreamConfig(memory_mb=None, render=rule, fit_rig=model[-1] != "!"), frame.bounds
        )
        stream.push(frame.inputs)
        quality = RenderQuality(read_fraction=0.0 if fraction and not part else None)
        yield model, stream.view(frame.truth.cameras, quality=quality).completed, truth


def mean_scores(scores: Sequence[FrameScores]) -> dict[str, float | None]:
    """Means over the views that have the score."""
    found = {key: [v for s in scores if (v := getattr(s, key)) is not None] for key in SHOWN}
    return {key: round(fmean(values), 4) if values else None for key, values in found.items()}


def save(shown: dict[str, Tensor], path: Path) -> None:
    """The pictures side by side, cut to where any of them shows something."""
    there = torch.stack([image.amax(0) > 0 for image in shown.values()]).any(0)
    (top, bottom), (left, right) = ((int(at.min()), int(at.max()) + 1) for at in torch.nonzero(there).T)
    part = slice(max(0, top - PADDING_PX), bottom + PADDING_PX), slice(max(0, left - PADDING_PX), right + PADDING_PX)
    path.parent.mkdir(parents=True, exist_ok=True)
    sheet = contact_sheet([[Tile(name, picture(image[:, *part])) for name, image in shown.items()]])
    cv2.imwrite(str(path), cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR))


if __name__ == "__main__":
    main()
