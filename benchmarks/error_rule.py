"""How good the rule `wrong` is: python benchmarks/error_rule.py [--captures DIR ...] [--plot FILE] [--write].

Views of cameras that are left out, of P and of captures, one time of each: how well the predicted probability that a
pixel is wrong fits the truth, and what the whole view gains when at most a part of the proxy is read.
"""

import argparse
import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import fmean
from typing import Any

import torch
from measure import write
from torch import Tensor

from viewmend.evaluation.frame_scores import true_view
from viewmend.inpainting.checkpoint import load_network
from viewmend.inpainting.protocol import ContextProvider, RenderQuality
from viewmend.inpainting.sweep.cells import rim_depth
from viewmend.inpainting.sweep.sweep_net import SweepNet
from viewmend.leave_one_out.capture_scenes import capture_set
from viewmend.leave_one_out.scenes import LeaveOneOutScene
from viewmend.leave_one_out.studio_scenes import procedural_set
from viewmend.metrics.image_quality import psnr
from viewmend.stream import Stream, StreamConfig
from viewmend.views import IncompleteView

WRONG = 0.1
"""A pixel is wrong where a channel is off by more."""
FRACTIONS = (0.05, 0.1, 0.15, 0.25, 0.5)
BINS = 10


def main() -> None:
    """Measure, and print or write."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--model", default="views", help="a shipped model's name, or a folder")
    parser.add_argument("--captures", nargs="*", type=Path, default=[], help="each camera is left out, seen from eight")
    parser.add_argument("--every", type=int, default=4, help="only every n-th scene of each set")
    parser.add_argument("--plot", type=Path, help="draw the reliability diagram (needs viewmend[plots])")
    parser.add_argument("--write", action="store_true", help="keep the result under benchmarks/results")
    options = parser.parse_args()
    net = load_network(options.model)
    assert isinstance(net, SweepNet), "a model for whole views"
    sets: dict[str, list[LeaveOneOutScene]] = {"P": list(procedural_set(frames=1)[:: options.every])}
    for folder in options.captures:
        sets[folder.name] = list(capture_set(folder, "8", 1)[:: options.every])
    found = {name: judge(net, scenes) for name, scenes in sets.items()}
    if options.plot:
        draw(found, options.plot)
    if options.write:
        print(write("error_rule", "cpu", {"model": options.model, "every": options.every}, found))
    else:
        print(json.dumps(found, indent=1))


def judge(net: SweepNet, scenes: Sequence[LeaveOneOutScene]) -> dict[str, Any]:
    """Calibration over all pixels of the proxy and its rim, and mean PSNR of whole views by the part that is read."""
    told, true, curves = [], [], []
    for stream, view, truth in views(net, scenes):
        map_ = net.error_map(view, ContextProvider(lambda _, names, s=stream: s.observation().context(names)))
        assert map_ is not None
        there = rim_depth(view.depth) > 0
        told.append(map_.wrong[there])
        true.append(((view.rgb - truth).abs().amax(0) > WRONG)[there])
        read = {f: stream.mend(view, quality=RenderQuality(read_fraction=f)) for f in FRACTIONS}
        shown = {str(f): mended.completed.rgb for f, mended in read.items()}
        shown |= {"0": view.rgb, "all": stream.mend(view).completed.rgb}
        holes = stream.mend(replace(view, error=view.holes.to(view.error))).completed.rgb
        curves.append({part: score(rgb, truth) for part, rgb in (shown | {"holes": holes}).items()})
    chance, wrong = torch.cat(told), torch.cat(true).double()
    return calibration(chance, wrong) | {
        "views": len(curves),
        "psnr_whole_by_fraction": {part: round(fmean(c[part] for c in curves), 2) for part in curves[0]},
    }


def views(net: SweepNet, scenes: Sequence[LeaveOneOutScene]) -> Iterator[tuple[Stream, IncompleteView, Tensor]]:
    """A stream that has seen the time, the view as the rule `all` asks for it, and what it should look like."""
    for scene in scenes:
        frame = next(iter(scene.frames("cpu")))
        stream = Stream(net, StreamConfig(memory_mb=None), frame.bounds)
        stream.push(frame.inputs)
        yield stream, stream.render(frame.truth.cameras), true_view(frame.truth, None).rgb


def score(rgb: Tensor, truth: Tensor) -> float:
    """PSNR of the whole view, dB."""
    found = psnr(rgb, truth, torch.ones_like(truth[0], dtype=torch.bool))
    assert found is not None
    return found


def calibration(chance: Tensor, wrong: Tensor) -> dict[str, Any]:
    """The share of wrong pixels among those of each tenth of probability; precision and recall above one half."""
    bins = []
    for n in range(BINS):
        own = (chance >= n / BINS) & ((chance < (n + 1) / BINS) | (n == BINS - 1))
        if bool(own.any()):
            shares = float(chance[own].double().mean()), float(wrong[own].mean()), float(own.double().mean())
            bins.append(dict(zip(("predicted", "wrong", "share"), (round(v, 4) for v in shares), strict=True)))
    above = chance > 0.5
    return {
        "wrong_fraction": round(float(wrong.mean()), 4),
        "calibration_error": round(sum(b["share"] * abs(b["predicted"] - b["wrong"]) for b in bins), 4),
        "precision": round(float(wrong[above].mean()), 4),
        "recall": round(float(above[wrong > 0].double().mean()), 4),
        "bins": bins,
    }


def draw(found: dict[str, dict[str, Any]], path: Path) -> None:
    """The reliability diagram of all sets."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4, 4))
    axes = figure.subplots()
    axes.plot((0, 1), (0, 1), color="0.7", linewidth=1)
    for name, own in found.items():
        axes.plot([b["predicted"] for b in own["bins"]], [b["wrong"] for b in own["bins"]], marker="o", label=name)
    axes.set(xlabel="predicted probability that a pixel is wrong", ylabel="share that is wrong")
    axes.legend()
    figure.savefig(path, bbox_inches="tight")


if __name__ == "__main__":
    main()
