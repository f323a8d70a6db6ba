"""Models on windows that they did not learn from: python benchmarks/windows.py SHARDS MODEL [MODEL ...] [--write].

SHARDS is a folder that `viewmend samples windows --matches` made, of scenes that no model saw. Means over its windows:
PSNR of what is missing, upon white, of each model and of Telea, also on the subject alone and on the background alone,
all windows' pixels together; how much attention, of 1, the guided block gives to
patches that truly show what is missing; and the ceiling, PSNR of the subject in the camera images when each patch
passes through its own token and back.
"""

import argparse
import math
from pathlib import Path
from statistics import fmean

import torch
from measure import write
from torch import Tensor

from viewmend.baselines.classical import Telea
from viewmend.inpainting.checkpoint import load_network
from viewmend.inpainting.images import context_images
from viewmend.inpainting.patch_transformer import PatchTransformer
from viewmend.inpainting.patches import STEP_PX, merge
from viewmend.inpainting.protocol import ContextProvider
from viewmend.inpainting.upon_white import UponWhite
from viewmend.metrics.image_quality import psnr
from viewmend.training.sample_files import read_shard, shards_of
from viewmend.training.samples import Sample
from viewmend.training.through_tokens import through_tokens
from viewmend.training.true_images import true_image


def missing_of(sample: Sample) -> Tensor:
    """What is judged: what is missing in the patches that count."""
    assert sample.view.part is not None, "samples are windows"
    return (sample.view.error > 0) & sample.view.part.inner[0]


def judged(net: PatchTransformer, samples: list[Sample]) -> dict[str, float]:
    """The means of one model."""
    images, ceilings, looked = [], [], []
    for sample in samples:
        made = net([sample.view], [list(sample.context)], matches=[sample.matches])[0]
        images.append(made.upon_own.float())
        if made.missed is not None:
            looked.append(math.exp(-float(made.missed)))
        stack = context_images(sample.context[0], net.config)
        patches, _ = through_tokens(net, [stack])
        views, height, width = stack.foreground.shape
        back, covered = merge(patches, stack.places, (views, height, width), STEP_PX)
        subject = torch.cat([*((covered > 0) & stack.foreground)], 1)
        beside = [torch.cat([*images], 2) for images in (back.clamp(0, 1), stack.channels[:, :3])]
        ceilings.append(psnr(beside[0], beside[1], subject) or 0.0)
    return scores(images, samples) | {
        "attention_on_it": fmean(looked or [math.nan]),
        "ceiling_db": fmean(ceilings),
    }


def by_telea(samples: list[Sample]) -> dict[str, float]:
    """What Telea makes of the same."""
    filled = UponWhite(Telea())
    images = []
    for sample in samples:
        context = ContextProvider(lambda tau, names: None)
        images.append(filled.step(sample.view, context, filled.initial_state())[0].rgb)
    return scores(images, samples)


def scores(images: list[Tensor], samples: list[Sample]) -> dict[str, float]:
    """PSNR of what is missing, upon white: the windows' mean, and that of all pixels on the subject, and off it."""
    means, squares = [], {"subject_db": [], "background_db": []}
    for rgb, sample in zip(images, samples, strict=True):
        truth, missing = true_image(sample, "white"), missing_of(sample)
        found = psnr(rgb.clamp(0, 1), truth, missing)
        assert found is not None and sample.alpha is not None, "something is missing, and the studio knows what"
        means.append(found)
        squared, subject = (rgb.clamp(0, 1) - truth).square().mean(0), sample.alpha > 127
        squares["subject_db"].append(squared[missing & subject])
        squares["background_db"].append(squared[missing & ~subject])
    pooled = {name: -10 * float(torch.cat(parts).mean().log10()) for name, parts in squares.items()}
    return {"holes_db": fmean(means)} | pooled


@torch.no_grad()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("shards", type=Path)
    parser.add_argument("models", nargs="+")
    parser.add_argument("--write", action="store_true", help="write the file in benchmarks/results")
    options = parser.parse_args()
    samples = [s for path in shards_of(options.shards) for s in read_shard(path) if isinstance(s, Sample)]
    samples = [s for s in samples if float(missing_of(s).sum()) >= 50]
    figures: dict[str, object] = {"telea": {key: round(value, 3) for key, value in by_telea(samples).items()}}
    print(f"{len(samples)} windows, Telea {figures['telea']}", flush=True)
    for name in options.models:
        net = load_network(name)
        assert isinstance(net, PatchTransformer), "no rays before its patches"
        figures[Path(name).name] = {key: round(value, 3) for key, value in judged(net.eval(), samples).items()}
        print(Path(name).name, figures[Path(name).name], flush=True)
    if options.write:
        print(write("windows", "cpu", {"windows": len(samples)}, figures))


if __name__ == "__main__":
    main()
