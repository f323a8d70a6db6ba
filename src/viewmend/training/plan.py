"""What a training run is: model, data and schedule."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from viewmend.inpainting.config import InpainterConfig
from viewmend.inpainting.sweep.config import SweepConfig

FLAT = tyro.conf.arg(name="")
"""On the command line, the fields are options without a prefix."""
TAUGHT: dict[str, tuple[str, ...]] = {"autoencoder": ("tokeniser", "decoder"), "tokens": ("transformer",)}
"""The modules of a `PatchTransformer` that learn, where not all do, by `Recipe.part`."""


@dataclass(frozen=True, kw_only=True)
class DataPlan:
    """Which scenes a run sees, and how much of each."""

    sizes_px: tuple[int, ...] = (224, 256, 320)
    """Edge lengths of the studio's square images; each scene takes one."""
    cameras: tuple[int, int] = (5, 20)
    """Fewest and most cameras of a rig."""
    times: tuple[int, ...] = (0, 10, 11, 12, 13)
    """Frames of a scene that are drawn; every one is a target whose past is the window's part of the earlier ones."""
    held_cameras: int = 4
    """Cameras of a scene that are left out in turn."""
    targets_per_camera: int = 3
    """Times at which a camera that is left out gives a sample."""
    clip_length: int = 1
    """Consecutive times in a sample, for a discriminator of clips; `times` must have that many."""
    context_cameras: tuple[int, ...] = (2, 3, 4, 5)
    """How many cameras colour a view and are its context: each view takes one of these numbers."""
    context_weights: tuple[int, ...] = (2, 8, 2, 1)
    """How often each of `context_cameras` is taken, relative to the others."""
    past: tuple[int, ...] = (0, 0, 0, 1, 99)
    """How many of the earlier times are context; each target takes one of these."""
    least_past: int = 0
    """So many earlier times a target has at least; 6 of `times` make a whole window of the paper's."""
    windows: int = 0
    """So many windows of a sample are learned from, each around something that is missing; 0: whole views."""
    search_px: int = 16
    """How far around where a window reprojects to its context reaches, beyond what the encoder sees."""
    matches: bool = False
    """Whether samples of the studio say where their context truly shows what they miss, for `LossWeights.attention`."""
    context: bool = True
    """Whether samples have context; rays alone need none, and are smaller without."""
    least_context: int = 0
    """So many cameras are context at least, whatever number coloured the view: for models that look at so many."""
    ray_views: int = 0
    """How many cameras close to a view `RayBlendNet` is given."""
    imperfect_fraction: float = 0.6
    """Share of the scenes whose cameras have noise, differ in colour, and have wrong masks and calibration."""
    rough_fraction: float = 0.0
    """Share of the imperfect scenes whose calibration and outlines are worse still, as those of older stages are."""
    staged: bool = False
    """Whether a stage stands behind the people of every scene; else behind half of those that are imperfect, and black
    behind the others, which tells the background as well as a mask does."""
    dropped_fraction: float = 0.0
    """Share of the times at which one or two cameras have no frame."""
    widened_fraction: float = 0.0
    """Share of the views in which more is missing than the cameras could not see: holes are a few pixels wider."""
    min_hole_px: int = 50
    """Views that miss less are passed over."""
    hull_resolution: int = 96
    """Voxels along the hull's longest side (coarser than in production: it is done once for each left-out camera)."""
    performers: Path | None = None
    """Folder of glTF characters; without it all are procedural."""
    motions: Path | None = None
    """Folder of BVH motions for them."""
    performers_fraction: float = 0.5
    """Share of the studio's scenes whose performers come from these folders, where they are given."""
    cloth_variety: tuple[float, float] = (0.0, 1.0)
    """Least and largest share of these performers' garments that are dyed or made of another cloth."""
    captures: tuple[Path, ...] = ()
    """Folders of real captures, or `viewmend splits` files: what they train with, truth being what they leave out."""
    captures_fraction: float = 0.75
    """Share of the scenes that come from them, where they are given."""
    shards: Path | None = None
    """Folder of tar files that `viewmend samples` wrote: samples come from there alone."""
    data_device: str = "cpu"
    """Where the studio draws, hulls are carved and views rendered."""


@dataclass(frozen=True, kw_only=True)
class LossWeights:
    """The objective's terms (section 8) and ours. A weight of 0 switches a term off."""

    image: float = 1.0
    """lambda_img, of L_in + L_out."""
    channels: Literal["mean", "sum"] = "mean"
    """L_in and L_out of the channels' mean (ours), or of their sum, as the paper's norms read."""
    outside: Literal["covered", "image"] = "covered"
    """L_out over what decoded patches cover (ours), or over the whole image, where Ftilde is F else (the paper's)."""
    log_error: float = 0.0
    """Weight of log10 of the squared error in the holes, a tenth of -PSNR. Ours."""
    adversarial: float = 0.0
    """lambda_adv, of L_adv; the paper's is 0.01."""
    adversarial_kind: Literal["gan", "hinge"] = "gan"
    """The paper's objective, or the hinge."""
    discriminator: Literal["image", "clip"] = "image"
    """Whether D judges single images or clips of `DataPlan.clip_length` of them."""
    attention: float = 0.0
    """Weight, at the start, of how far one block's attention is from true correspondences, nats; it falls linearly, to
    nothing at the end. Ours."""
    wide_first: float = 0.0
    """Share of the run, from its start, in which slivers count for nothing: only holes that a square of 9 pixels fits
    into (`losses.WIDE_PX`). Ours."""
    autoencoder: float = 0.0
    """Weight of L1 between patches of the context and what the decoder makes of their tokens alone. Ours."""


@dataclass(frozen=True, kw_only=True)
class ViewLossWeights:
    """The terms that the reader of whole views is taught by. A weight of 0 switches a term off. Ours."""

    colour: float = 1.0
    """L1 of colours upon black."""
    holes: float = 2.0
    """How much more pixels count that no source view coloured."""
    log_error: float = 0.15
    """Weight of log10 of a window's squared error."""
    gradient: float = 0.5
    """L1 of the differences between neighbours, which keeps textures sharp."""
    cell_colour: float = 0.5
    """L1 of the mean over places."""
    alpha: float = 0.5
    """L1 of alpha, and a third of its cross-entropy."""
    place: float = 0.1
    """Cross-entropy of the surface's place."""
    visible: float = 0.1
    """What is lost by trusting cameras that do not see the surface."""
    errors: float = 0.5
    """Cross-entropies of the `ErrorNet`: which pixels are wrong, and by how much the reader changes them."""
    confidence: float = 0.05
    """Cross-entropy of whether a pixel is right."""


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """A named training run."""

    name: Annotated[str, tyro.conf.Suppress]
    model: InpainterConfig
    data: Annotated[DataPlan, FLAT] = field(default_factory=DataPlan)
    loss: Annotated[LossWeights, FLAT] = field(default_factory=LossWeights)
    steps: int
    minutes: float | None = None
    """Ends the run by then, whatever its steps: the learning rate follows whichever is further along."""
    batch: int = 8
    """Samples a step and stream."""
    new_per_batch: int = 3
    """New samples among them, at most all; the others are replayed."""
    replay_size: int = 600
    """How many of a stream's last samples are seen again."""
    streams: int = 1
    """Batches whose gradients are averaged in a step. As many processes share them as torchrun starts, and there is
    at least one for each."""
    learning_rate: float = 8e-4
    discriminator_rate: float = 1e-4
    """Learning rate of D's own optimiser."""
    warmup: int = 60
    weight_decay: float = 0.01
    max_grad_norm: float = 1.0
    ema: float = 0.995
    """Decay of the averaged weights, which are what is shipped."""
    workers: int = 1
    """Processes that make samples, for each that trains."""
    part: Literal["rays", "patches", "all", "autoencoder", "copies", "tokens"] = "all"
    """What is trained: `RayBlendNet` alone, on the fill that it makes; all but it; both; the encoder and the decoder
    alone, on patches of the cameras' images; all but the rays, on copies of these images; or the transformer alone, on
    windows that are encoded already."""
    anew: tuple[Literal["tokeniser", "transformer", "decoder"], ...] = ()
    """Modules that begin at random whatever the run begins with: a transformer upon an encoder that was taught."""
    pixels_per_view: int = 300
    """For the rays alone: missing pixels that are read of each view, at most."""
    augment: bool = False
    """For the rays alone: what was looked up is augmented each time it is seen, so that few samples last longer."""
    bfloat16: bool = True
    """Run the networks under autocast."""
    context_gradients: float = 1.0
    """Share of the context images through whose encoding gradients flow; chance takes them, and they count for all."""
    checkpoint_every: int = 100
    """Steps after which the run is written down, to go on from there."""
    validate_every: int = 500
    """Steps after which the averaged weights are judged on fixed scenes; 0: never."""
    validation_views: int = 24
    """How many views of these scenes."""
    seed: int = 0

    def __post_init__(self) -> None:
        least = {"steps": 1, "batch": 1, "streams": 1, "checkpoint_every": 1, "workers": 0, "validate_every": 0}
        least |= {"new_per_batch": 1}
        wrong = [f"{name} of {getattr(self, name)}" for name, low in least.items() if getattr(self, name) < low]
        wrong += [f"minutes of {self.minutes}"] if self.minutes is not None and not self.minutes > 0 else []
        wrong += [] if 0 < self.context_gradients <= 1 else [f"context_gradients of {self.context_gradients} (up to 1)"]
        wrong += [] if 0 < self.learning_rate < math.inf else [f"learning_rate of {self.learning_rate}"]
        wrong += [] if self.data.clip_length > 0 else [f"clip_length of {self.data.clip_length}"]
        if wrong:
            raise ValueError(f"expected positive numbers (workers and validate_every may be 0), got {', '.join(wrong)}")
        if self.loss.adversarial and self.loss.discriminator == "clip" and self.data.clip_length < 2:
            raise ValueError(
                f"expected clips of 2 or more to judge, got {self.data.clip_length}; give --clip-length 2 or more"
            )
        if self.part in ("rays", "autoencoder", "copies") and self.loss.adversarial:
            raise ValueError(f"expected no adversarial loss for {self.part} alone, whose pixels are no image")
        if self.part == "autoencoder" and self.validate_every:
            raise ValueError("expected --validate-every 0 for an autoencoder, which fills nothing")


@dataclass(frozen=True, kw_only=True)
class WholeViewRecipe(Recipe):
    """A run that trains a `SweepNet` on stored scenes. Its `loss` says nothing."""

    model: SweepConfig = field(default_factory=SweepConfig)  # pyright: ignore[reportIncompatibleVariableOverride]
    part: Literal["all", "errors"] = "all"  # pyright: ignore[reportIncompatibleVariableOverride]
    """What is trained: all, or the `ErrorNet` alone."""
    coarse_from: str = "small"
    """The model whose `RayBlendNet` fills what no source view coloured, where the net has such a coarse fill."""
    view_loss: Annotated[ViewLossWeights, tyro.conf.arg(name="loss")] = field(default_factory=ViewLossWeights)
