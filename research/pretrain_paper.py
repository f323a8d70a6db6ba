"""The patch autoencoder from which the shipped `paper-small` starts.

    viewmend make-dataset paper-small --count 4000 --out SHARDS
    python research/pretrain_paper.py --shards SHARDS --out AUTOENCODER
    viewmend train paper-small --from AUTOENCODER --shards SHARDS --out RUN

Encoder and decoder learn to reproduce patches of camera images, each through its own token, without the transformer.
Small crops instead of whole images make five times as many steps in the same time.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

import torch
import tyro
from jaxtyping import Float
from torch import Tensor, nn

from viewmend.models.paper.config import PaperConfig, paper, paper_small
from viewmend.models.paper.patch_transformer import PatchTransformer
from viewmend.models.paper.patches import PATCH_CELLS, PATCH_PX, STEP_CELLS, STEP_PX, split
from viewmend.models.paper.tokenizer import build_context_input
from viewmend.training.config import ObjectiveConfig, SamplingConfig, SceneConfig, SceneSource, TrainConfig
from viewmend.training.loop import train
from viewmend.training.objective import MIN_SQUARE, ImageLoss, Objective, StepOutput, load_start
from viewmend.training.paper import SAMPLING
from viewmend.training.samples import Sample
from viewmend.training.scenes import sample_scenes
from viewmend.types import ContextViews
from viewmend.utils.options import HIDDEN

STEPS_A_SIDE = 6
CROP_PX = STEPS_A_SIDE * STEP_PX + PATCH_PX
"""Edge length of a crop: 7 x 7 patches."""
MASK_CHANNEL = 3


class AutoencoderObjective(Objective[PatchTransformer]):
    """L1, summed over the channels, between patches and the patches decoded from their own tokens."""

    loss_summary = "L1 of patches of camera images"

    def __init__(self, config: TrainConfig, options: "AutoencoderConfig", start: nn.Module | None) -> None:
        super().__init__(config, PatchTransformer(options.model))
        load_start(self.model, start)
        self.model.transformer.requires_grad_(False)

    def forward(self, batch: Sequence[Sample]) -> StepOutput:
        """The loss of a random crop of a random camera image of each sample."""
        crops = torch.stack([random_crop(sample, self.model.config) for sample in batch])
        decoded, patches = reproduce(self.model, crops)
        off = decoded - patches
        inside = off.abs().sum(1).mean()
        log_error = (off.square().mean() + MIN_SQUARE).log10()
        return StepOutput(ImageLoss(inside, torch.zeros_like(inside), log_error), inside)


@dataclass(frozen=True, kw_only=True)
class AutoencoderConfig(ObjectiveConfig):
    """Trains encoder and decoder of the paper's model."""

    model: Annotated[PaperConfig, HIDDEN] = field(default_factory=paper_small)
    sampling: Annotated[SamplingConfig, HIDDEN] = SAMPLING
    make_objective = AutoencoderObjective
    item = Sample

    def make_scenes(self, scenes: SceneConfig, seed: str) -> SceneSource[Sample]:
        """The samples of `paper-small`."""
        return sample_scenes(scenes, self.sampling, seed)


def random_crop(sample: Sample, config: PaperConfig) -> Float[Tensor, "channel crop crop"]:
    """Encoder input of a square of `CROP_PX` around a pixel of the subject, in a random image of the context."""
    views: ContextViews = sample.context[int(torch.randint(len(sample.context), ()))]
    image = build_context_input(views, config)
    number = int(torch.randint(len(image.channels), ()))
    pixels = torch.nonzero(image.foreground[number])
    row, col = pixels[int(torch.randint(len(pixels), ()))].tolist() if len(pixels) else (0, 0)
    height, width = image.foreground[number].shape
    top, left = (
        max(0, min(side - CROP_PX, at - int(torch.randint(CROP_PX, ()))))
        for side, at in zip((height, width), (row, col), strict=True)
    )
    return image.channels[number, :, top : top + CROP_PX, left : left + CROP_PX]


def reproduce(
    model: PatchTransformer, crops: Float[Tensor, "crop channel side side"]
) -> tuple[Tensor, Tensor]:
    """The patches (patch, 3, 28, 28) of crops that show the subject, decoded from their own tokens and as they are."""
    count = STEPS_A_SIDE + 1
    places = torch.cartesian_prod(torch.arange(len(crops)), torch.arange(count), torch.arange(count)).to(
        crops.device
    )
    patches = split(crops, places, PATCH_PX, STEP_PX)
    shown = (patches[:, MASK_CHANNEL] > 0).flatten(1).any(1)
    with model.autocast():
        features = split(model.tokeniser.encoder(crops), places[shown], PATCH_CELLS, STEP_CELLS)
        decoded = model.decoder(model.tokeniser.linear(features.flatten(1))).float()
    return decoded, patches[shown, :3]


RECIPE = TrainConfig(
    name="autoencoder",
    objective=AutoencoderConfig(),
    scenes=SceneConfig(sizes_px=(224, 320, 416), num_holdout_views=6, imperfect_fraction=0.5),
    steps=20_000,
    minutes=20.0,
    batch=12,
    new_per_batch=1,
    learning_rate=3e-3,
    ema=0.98,
    validate_every=0,
)
Config = Annotated[TrainConfig, tyro.conf.arg(name="")]


def main(out: Path, config: Config = RECIPE, size: Literal["paper-small", "paper"] = "paper-small") -> None:
    """Train the autoencoder.

    Args:
        out: folder of the run.
        config: the run.
        size: the model whose encoder and decoder are trained.
    """
    model = paper() if size == "paper" else paper_small()
    train(replace(config, objective=AutoencoderConfig(model=model)), out)


if __name__ == "__main__":
    tyro.cli(main, config=(tyro.conf.FlagCreatePairsOff,))
