"""The pre-training stages of the shipped `paper-small`, which use the package's training loop.

    python research/pretrain_paper.py windows --out out/windows --count 3400
    python research/pretrain_paper.py autoencoder --shards out/windows --out out/autoencoder
    python research/pretrain_paper.py masked --shards out/windows --from out/autoencoder --out out/paper-small

`windows` writes training windows. `autoencoder` trains encoder and decoder on patches of their camera images, each
through its own token, without attention. `masked` trains the whole model to complete randomly masked camera images from
the unmasked images of all cameras: the masked image is its own ground truth, so one frame of a rig is enough.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

import torch
import tyro
from attention_loss import Correspondences, attention_losses
from jaxtyping import Bool, Float, Int
from paper_windows import WindowScenes
from torch import Tensor, nn

from viewmend.models.paper.config import PaperConfig, paper_small
from viewmend.models.paper.context import ContextFrame
from viewmend.models.paper.patch_transformer import PatchTransformer
from viewmend.models.paper.patches import PATCH_PX, STEP_PX, crop, grid_shape, padded_size, split
from viewmend.models.paper.tokenizer import EncoderInput, build_context_input, reference_depth
from viewmend.rendering.crop import Crop
from viewmend.training.config import HIDDEN, ObjectiveConfig, SamplingConfig, SceneConfig, SceneSource, TrainConfig
from viewmend.training.loop import train
from viewmend.training.objective import MIN_SQUARE, ImageLoss, StepOutput
from viewmend.training.paper import SAMPLING, PaperObjective, PaperObjectiveConfig, paper_image_loss
from viewmend.training.replay import samples_in_order
from viewmend.training.samples import Sample, true_image
from viewmend.training.scenes import sample_scenes
from viewmend.training.shards import write_shards
from viewmend.types import ContextViews, IncompleteView, WindowPart

MAX_DECODED = 6
"""Camera frames of a batch whose patches are decoded for the auxiliary autoencoder loss."""
MAX_MASKS = 3
MASK_RADIUS_PX = (6.0, 48.0)
"""Smallest and largest radius of a random mask along each of its axes."""
CALIBRATION_ERROR_PX = 4.0
"""Largest calibration error of a masked image along each axis, since real geometry is never exact."""
ATTENTION, AUTOENCODER = 0.1, 0.5
"""Weights of the attention loss, which falls to 0 during the run, and of the auxiliary autoencoder loss."""


class _PretrainObjective(PaperObjective):
    """What both stages share: no adversarial loss, and no validation."""

    def __init__(self, config: TrainConfig, options: "PretrainConfig", start: nn.Module | None) -> None:
        super().__init__(config, PaperObjectiveConfig(model=options.model, adversarial=0.0), start)
        self.validation = None


class AutoencoderObjective(_PretrainObjective):
    """L1 between patches of camera images and the patches decoded from their own tokens."""

    def __init__(self, config: TrainConfig, options: "PretrainConfig", start: nn.Module | None) -> None:
        super().__init__(config, options, start)
        self.loss_summary = "L1 of patches of camera images"
        self.model.transformer.requires_grad_(False)

    def forward(self, batch: Sequence[Sample]) -> StepOutput:
        """The loss of all cameras of each sample at a random frame."""
        views = [random_frame(sample) for sample in batch if sample.context]
        decoded, patches = through_tokens(self.model, [build_context_input(one, self.model.config) for one in views])
        inside = patch_loss(decoded, patches)
        log_error = ((decoded - patches).square().mean() + MIN_SQUARE).log10()
        return StepOutput(ImageLoss(inside, torch.zeros_like(inside), log_error), inside)


class MaskedObjective(_PretrainObjective):
    """L_in + L_out on masked camera images, attention to the true correspondences, and the autoencoder loss."""

    def __init__(self, config: TrainConfig, options: "PretrainConfig", start: nn.Module | None) -> None:
        super().__init__(config, options, start)
        self.loss_summary = f"L1 inside and outside of masks, {ATTENTION:g} x attention, {AUTOENCODER:g} x autoencoder"

    def forward(self, batch: Sequence[Sample]) -> StepOutput:
        """All terms of a masked camera image of each sample, at a random frame.

        Raises:
            ValueError: no camera image shows a subject.
        """
        views = [random_frame(sample) for sample in batch if sample.context]
        masked = [found for one in views if (found := mask_image(one)) is not None]
        if not masked:
            raise ValueError("expected images of a subject, got none; write other samples")
        samples, matches = [sample for sample, _ in masked], [own for _, own in masked]
        views = [s.view for s in samples]
        frames, autoencoder = encode_and_decode(self.model, [_window(self.model, s) for s in samples])
        predictions = self.model(views, frames)
        inner = [torch.ones_like(s.view.error) if s.view.part is None else s.view.part.inner[0] for s in samples]
        error = [s.view.error * own for s, own in zip(samples, inner, strict=True)]
        truth = [true_image(s, self.model.config.background) for s in samples]
        image = paper_image_loss(predictions, error, truth, [own.float() for own in inner])
        total = image.inside + image.outside + AUTOENCODER * autoencoder
        if missed := attention_losses(self.model, views, frames, matches):
            total = total + ATTENTION * (1 - self.progress) * torch.stack(missed).mean()
        return StepOutput(image, total)


@dataclass(frozen=True, kw_only=True)
class PretrainConfig(ObjectiveConfig):
    """A pre-training stage of the paper's model."""

    stage: Annotated[Literal["autoencoder", "masked"], HIDDEN]
    model: Annotated[PaperConfig, HIDDEN] = field(default_factory=paper_small)
    sampling: Annotated[SamplingConfig, HIDDEN] = SAMPLING
    item = Sample

    @staticmethod
    def objective(config: TrainConfig, options: "PretrainConfig", start: nn.Module | None) -> PaperObjective:
        """The objective of the stage."""
        return (AutoencoderObjective if options.stage == "autoencoder" else MaskedObjective)(config, options, start)

    def make_scenes(self, scenes: SceneConfig, seed: str) -> SceneSource[Sample]:
        """Windows of studio scenes."""
        return WindowScenes(sample_scenes(scenes, self.sampling, seed), seed)


def random_frame(sample: Sample) -> ContextViews:
    """The cameras of a sample at a random frame of its context."""
    return sample.context[int(torch.randint(len(sample.context), ()))]


def through_tokens(model: PatchTransformer, stacks: list[EncoderInput]) -> tuple[Tensor, Tensor]:
    """The kept patches (patch, 3, 28, 28) of images, decoded from their own tokens, and as they are.

    Raises:
        ValueError: no patch is kept.
    """
    if not sum(len(stack.places) for stack in stacks):
        raise ValueError("expected images of a subject, got none; write other samples")
    with model.autocast():
        return _decode(model, model.tokeniser(stacks), stacks)


def encode_and_decode(
    model: PatchTransformer, views: Sequence[ContextViews]
) -> tuple[list[list[ContextFrame]], Float[Tensor, ""]]:
    """The encoded cameras of each element, and the autoencoder loss of the patches of some elements."""
    encoded = [list(frames) for frames in model.encode_contexts(views)]
    chosen = torch.randperm(len(views))[:MAX_DECODED].tolist()
    tokens = [frame.tokens for n in chosen for frame in encoded[n]]
    if not sum(map(len, tokens)):
        return encoded, torch.zeros((), device=next(model.parameters()).device)
    stacks = [build_context_input(views[n], model.config) for n in chosen]
    with model.autocast():
        decoded, patches = _decode(model, torch.cat(tokens), stacks)
    return encoded, patch_loss(decoded, patches)


def _window(model: PatchTransformer, sample: Sample) -> ContextViews:
    """The cameras that the model uses as context of a masked image."""
    [views] = model.select_window(sample.view, sample.context)
    assert isinstance(views, ContextViews)
    return views


def patch_loss(decoded: Tensor, patches: Tensor) -> Float[Tensor, ""]:
    """L1 of patches (patch, 3, 28, 28), summed over the channels."""
    return (decoded - patches).abs().sum(1).mean()


def _decode(model: PatchTransformer, tokens: Tensor, stacks: Sequence[EncoderInput]) -> tuple[Tensor, Tensor]:
    """The patches decoded from the tokens of all kept patches, and these patches."""
    patches = []
    for stack in stacks:
        size = padded_size(*grid_shape(*stack.channels.shape[2:]))
        whole = torch.stack([crop(image, 0, 0, size) for image in stack.channels])
        patches.append(split(whole, stack.places, PATCH_PX, STEP_PX)[:, :3])
    return model.decoder(tokens).float(), torch.cat(patches)


def mask_image(views: ContextViews) -> tuple[Sample, Correspondences] | None:
    """A random camera's image with random masks as a view, whose context is all images, itself included.

    Its patches lie on a shifted grid, and its calibration is slightly wrong. None if it shows no subject. The
    correspondences of masked pixels are their own positions in that camera.
    """
    cameras = views.frame.cameras
    number = int(torch.randint(len(cameras), ()))
    own = views.select([cameras.names[number]])
    width, height = (int(side) for side in own.frame.cameras.size_px[0])
    left, top = (int(shift) for shift in torch.randint(STEP_PX, (2,)))
    if left >= width or top >= height:
        return None
    cut = Crop(left, top, width, height)
    rgb, depth = cut.of_image(own.frame.rgb[0]), cut.of_image(own.depth[0]).contiguous()
    mask = cut.of_image((own.depth[0] > 0).float() if own.frame.mask is None else own.frame.mask[0].float() / 255)
    part = own.part or WindowPart((width, height), reference_depth(own.depth), torch.ones_like(own.depth) > 0)
    inner = cut.of_image(part.inner)
    masked = _random_masks((mask > 0.5) & inner[0])
    if masked is None:
        return None
    error = masked.float()
    truth = (rgb * mask).round().to(torch.uint8)
    shift_px = (torch.rand(2) * 2 - 1) * CALIBRATION_ERROR_PX
    view = IncompleteView(
        camera=cut.of_camera(own.frame.cameras).moved(*shift_px.tolist()),
        rgb=truth.float() / 255 * (1 - error),
        mask=torch.maximum(mask, error),
        error=error,
        depth=depth,
        source_views=cameras.names,
        weights=((mask > 0) * (1 - error)).expand(len(cameras), -1, -1) / len(cameras),
        time=views.frame.time,
        part=WindowPart(part.whole_size_px, part.reference_m, inner.contiguous()),
    )
    pixels = torch.nonzero(masked & (mask > 0.5))
    index = torch.full_like(pixels[:, 0], number)
    uv_px = pixels.flip(1) + 0.5 + pixels.new_tensor([left, top])
    matches = Correspondences(cameras.names, pixels, index, torch.full_like(index, views.frame.time), uv_px)
    return Sample(view, (views,), None, truth, alpha=(mask * 255).round().to(torch.uint8)), matches


def _random_masks(subject: Bool[Tensor, "height width"]) -> Bool[Tensor, "height width"] | None:
    """Some ellipses around pixels of the subject; None if there are no such pixels."""
    centers = torch.nonzero(subject)
    if not len(centers):
        return None
    masks = torch.zeros_like(subject)
    for _ in range(int(torch.randint(1, MAX_MASKS + 1, ()))):
        masks |= _random_ellipse(centers[int(torch.randint(len(centers), ()))], subject)
    return masks


def _random_ellipse(center: Int[Tensor, "2"], like: Bool[Tensor, "height width"]) -> Bool[Tensor, "height width"]:
    """An ellipse of random size and orientation around a row and column."""
    smallest, largest = MASK_RADIUS_PX
    radii = smallest * (largest / smallest) ** torch.rand(2)
    angle = math.pi * float(torch.rand(()))
    rows, columns = (torch.arange(size, device=like.device) - at for size, at in zip(like.shape, center, strict=True))
    along = columns * math.cos(angle) + rows[:, None] * math.sin(angle)
    across = rows[:, None] * math.cos(angle) - columns * math.sin(angle)
    return (along / radii[0]) ** 2 + (across / radii[1]) ** 2 < 1


SCENES = SceneConfig(sizes_px=(320, 512), num_holdout_views=2, imperfect_fraction=0.3)


def recipe(stage: Literal["autoencoder", "masked"]) -> TrainConfig:
    """The run of a stage."""
    autoencoder = TrainConfig(
        name=stage,
        objective=PretrainConfig(stage=stage),
        scenes=SCENES,
        steps=20_000,
        minutes=15.0,
        new_per_batch=2,
        replay_size=300,
        learning_rate=1e-3,
        ema=0.98,
        validate_every=0,
    )
    if stage == "autoencoder":
        return autoencoder
    return replace(autoencoder, minutes=45.0, new_per_batch=4, learning_rate=8e-4, ema=0.99)


def windows(out: Path, count: int = 3400, workers: int = 1, seed: int = 0, scenes: SceneConfig = SCENES) -> None:
    """Write training windows as shards.

    Args:
        out: folder of the shards.
        count: number of windows.
        workers: processes that make them.
        seed: seed of the scenes.
        scenes: the scenes.
    """
    source = PretrainConfig(stage="masked").make_scenes(scenes, f"{seed}/0")
    samples = (sample for (_, _, sample), _ in zip(samples_in_order(source, 0, workers), range(count), strict=False))
    for path in write_shards(samples, out):
        print(path)


AUTOENCODER_RUN, MASKED_RUN = recipe("autoencoder"), recipe("masked")
Config = Annotated[TrainConfig, tyro.conf.arg(name="")]


def autoencoder(out: Path, config: Config = AUTOENCODER_RUN) -> None:
    """Train the encoder and the decoder; `out` is the folder of the run."""
    train(config, out)


def masked(out: Path, config: Config = MASKED_RUN) -> None:
    """Train the whole model on masked camera images; `out` is the folder of the run."""
    train(config, out)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a stage."""
    stages = {"windows": windows, "autoencoder": autoencoder, "masked": masked}
    flags = (tyro.conf.FlagCreatePairsOff, tyro.conf.AvoidSubcommands)
    tyro.extras.subcommand_cli_from_dict(stages, args=arguments, config=flags)


if __name__ == "__main__":
    main()
