"""Training of the published baselines on our samples, with their authors' losses and parameters.

Clips are framed as `OnlineInpainter` frames a stream: the whole view resized ("def"), or a window
around holes without ("win") or with ("mul") images of other cameras.
"""

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn.functional import l1_loss

from viewmend.contrib.baselines.e2fgvi import E2FGVI, LocalFlows
from viewmend.contrib.baselines.framing import (
    DILATION_PX,
    Window,
    aim,
    camera_windows,
    dilated,
    foreground,
    resized_canvas,
    window_canvas,
    windows_over,
)
from viewmend.contrib.baselines.layers import SLOPE
from viewmend.contrib.baselines.online import OnlineConfig, OnlineInpainter
from viewmend.contrib.baselines.published import NETWORKS, TRAINED, load_baseline
from viewmend.contrib.baselines.token_transformers import NATIVE_PX, TokenTransformer
from viewmend.models.base import ContextProvider
from viewmend.models.compositing import Background, composite, to_background
from viewmend.training.adversarial import BETAS, HINGE, Adversary, Discriminator, Judged
from viewmend.training.config import ObjectiveConfig, SamplingConfig, SceneConfig, SceneSource, TrainConfig
from viewmend.training.objective import HoleValidation, ImageLoss, Objective, StepOutput, load_start
from viewmend.training.samples import Sample, true_image
from viewmend.training.scenes import sample_scenes, validation_scenes
from viewmend.utils.atomic_writes import write_text
from viewmend.utils.options import HIDDEN
from viewmend.utils.weight_files import write_tensors

Framing = Literal["def", "win", "mul"]
FRAMINGS: tuple[Framing, ...] = ("def", "win", "mul")
MAX_REFERENCES = 3
"""Frames of other cameras in a clip."""
CLIP_LENGTH = 5
"""Consecutive views in the authors' training clips."""
FULL_RATE = 0.8
"""Fraction of a run at the full learning rate, as in the authors' training; the rest is at a tenth of it."""
ADVERSARIAL = 0.01
"""Weight of the hinge loss of T-PatchGAN, as in the authors' training."""
DISCRIMINATOR_RATE = 1e-4
"""The discriminator's learning rate, as in the authors' training."""
SAMPLING = SamplingConfig(
    frames=(0, *range(10, 10 + CLIP_LENGTH)), clip_length=CLIP_LENGTH, num_target_frames=3, with_context=True
)


@dataclass(frozen=True)
class TrainingClip:
    """Consecutive views of one camera, oldest first, and images of other cameras."""

    frames: Float[Tensor, "time 3 height width"]
    """Colours in [-1, 1], 0 in the holes."""
    holes: Bool[Tensor, "time height width"]
    """Dilated holes, in which frames are 0."""
    truth: Float[Tensor, "time 3 height width"]
    """F*, in [-1, 1]."""
    references: Float[Tensor, "reference 3 height width"]
    """Whole images of other cameras; none except in the framing mul."""


def training_clip(
    sample: Sample,
    size_px: tuple[int, int],
    framing: Framing,
    background: Background = "black",
    length: int = CLIP_LENGTH,
) -> TrainingClip:
    """The clip that ends in `sample`; window and references are drawn at random.

    Args:
        sample: with the samples before it.
        size_px: height and width of the network's frames.
        framing: how the clip is cut from the views.
        background: background of views and ground truth; images of other cameras are on
            black, as on a stream.
        length: number of views, as far as there are samples before.
    """
    samples = sample.clip[-length:]
    make = resized_canvas if framing == "def" else window_canvas
    views = [to_background(background, s.view) for s in samples]
    canvases = [make(view.rgb, view.error > 0, size_px, DILATION_PX) for view in views]
    nowhere = torch.zeros_like(sample.view.error, dtype=torch.bool)
    truths = [make(true_image(s, background), nowhere, size_px, 0).image for s in samples]
    window = Window(0, 0)
    if framing != "def":
        windows = windows_over(canvases[-1].holes, size_px, OnlineConfig(size_px=size_px).overlap_px)
        window = windows[int(torch.randint(len(windows), ()))] if windows else window
    references = torch.zeros(0, 3, *size_px, device=sample.view.rgb.device)
    if framing == "mul":
        images = [
            camera_windows(foreground(s.context[0]), s.context[0], aim(s.view, window, size_px), size_px)
            for s in samples
        ]
        candidates = torch.cat(images).to(references)
        references = candidates[torch.randperm(len(candidates))[:MAX_REFERENCES]]
    return TrainingClip(
        frames=torch.stack([window.of(c.image, size_px) for c in canvases]),
        holes=torch.stack([window.of(dilated(c.holes, DILATION_PX), size_px) for c in canvases]),
        truth=torch.stack([window.of(image, size_px) for image in truths]),
        references=references,
    )


class BaselineObjective(Objective[TokenTransformer | E2FGVI]):
    """L1 in the holes plus L1 outside of them, each over its own pixels, and the hinge loss on completed clips.

    E2FGVI also has L1 of its completed flows against those of the true frames by a fixed SPyNet:
    the starting model's, so this term is left out without a starting model.
    """

    loss_summary = f"L1 inside and outside the holes, {ADVERSARIAL:g} x hinge loss of T-PatchGAN"
    max_grad_norm = 1e6

    def __init__(
        self, config: TrainConfig, options: "BaselineObjectiveConfig", start: nn.Module | None
    ) -> None:
        if not 1 <= options.clip_length <= CLIP_LENGTH:
            raise ValueError(f"expected --clip-length of 1 to {CLIP_LENGTH}, got {options.clip_length}")
        network = NETWORKS[options.network]()
        network.check_size(*options.size_px)
        _initialise(network)
        load_start(network, start)
        super().__init__(config, network)
        self.options = options
        self.validation = HoleValidation(
            validation_scenes(config.scenes, options.sampling),
            config.validation_views,
            self._complete_view,
            options.background,
        )
        self.adversary = Adversary(Discriminator("clip", layers=6), HINGE, ADVERSARIAL, DISCRIMINATOR_RATE)
        self.flow_teacher = (
            deepcopy(start).requires_grad_(False).eval() if isinstance(start, E2FGVI) else None
        )

    def make_optimizer(self, parameters: list[nn.Parameter], learning_rate: float) -> torch.optim.Optimizer:
        """See `Objective.make_optimizer`."""
        return torch.optim.Adam(parameters, lr=learning_rate, betas=BETAS)

    def learning_rate_factor(self, step: int, progress: float, warmup: int) -> float:
        """See `Objective.learning_rate_factor`; constant, and a tenth at the end."""
        return 1.0 if progress < FULL_RATE else 0.1

    def save(self, model: nn.Module, folder: Path, card: str) -> None:
        """Write the weights with the authors' keys, as a file that methods like dstt-o-def@FOLDER load."""
        network = self.options.network
        write_tensors(folder / TRAINED, model.state_dict(), {"format": "pt", "network": network})
        licence = " Weights derived from a checkpoint keep its licence." if self.config.start else ""
        usage = f"Views on {self.options.background}. Use as the method `{network}-o-def@FOLDER`.{licence}"
        write_text(folder / "README.md", f"{card}\n{usage}\n")

    def forward(self, batch: Sequence[Sample]) -> StepOutput:
        """The terms of a batch, each sample in a random framing."""
        options = self.options
        framings: list[Framing] = [FRAMINGS[int(torch.randint(len(FRAMINGS), ()))] for _ in batch]
        clips = [
            training_clip(sample, options.size_px, framing, options.background, options.clip_length)
            for sample, framing in zip(batch, framings, strict=True)
        ]
        made, flow_terms = zip(*(self._complete(clip) for clip in clips), strict=True)
        terms = [clip_terms(frames, clip) for frames, clip in zip(made, clips, strict=True)]
        inside, outside = (torch.stack(parts).mean() for parts in zip(*terms, strict=True))
        composed = [
            torch.where(c.holes[:, None], frames, c.frames) for frames, c in zip(made, clips, strict=True)
        ]
        judged = Judged(
            [(clip.truth.transpose(0, 1) + 1) / 2 for clip in clips],
            [(frames.transpose(0, 1) + 1) / 2 for frames in composed],
            [clip.holes.float() for clip in clips],
        )
        loss = ImageLoss(inside, outside, torch.zeros_like(inside))
        return StepOutput(loss, inside + outside + torch.stack(flow_terms).mean(), judged)

    def _complete_view(self, model: nn.Module, sample: Sample) -> Float[Tensor, "3 height width"]:
        """A view as a stream of one frame."""
        assert isinstance(model, TokenTransformer | E2FGVI)
        inpainter = OnlineInpainter(model, OnlineConfig(framing="def", size_px=self.options.size_px))
        nothing = ContextProvider(lambda *_: None)
        background = self.options.background
        made, _ = inpainter.step_on(background, sample.view, nothing, inpainter.initial_state())
        return composite(background, made.rgb, made.opacity)

    def _complete(self, clip: TrainingClip) -> tuple[Float[Tensor, "time 3 height width"], Float[Tensor, ""]]:
        """The network's views of a clip, and the term of its flows, 0 without a teacher."""
        frames = torch.cat([clip.frames, clip.references])[None]
        count = len(clip.frames)
        with torch.autocast(frames.device.type, torch.bfloat16, enabled=self.config.precision == "bfloat16"):
            if not isinstance(self.model, E2FGVI):
                return self.model(frames)[0, :count].float(), frames.new_zeros(())
            made, flows = self.model.with_flows(frames, count)
            if self.flow_teacher is None:
                return made[0, :count].float(), frames.new_zeros(())
            with torch.no_grad():
                true = self.flow_teacher.flows(clip.truth[None])
            return made[0, :count].float(), flow_term(flows, true)


@dataclass(frozen=True, kw_only=True)
class BaselineObjectiveConfig(ObjectiveConfig):
    """Trains a published network."""

    network: Annotated[str, HIDDEN]
    """One of `published.NETWORKS`."""
    make_objective = BaselineObjective
    item = Sample
    sampling: Annotated[SamplingConfig, HIDDEN] = SAMPLING
    size_px: tuple[int, int] = NATIVE_PX
    """Height and width of the frames."""
    clip_length: int = CLIP_LENGTH
    """Consecutive views in a clip, up to 5."""
    background: Background = "black"
    """Background of views and ground truth; the paper's is white."""

    def load_start(self, name: str) -> nn.Module:
        """The weights of a file or a run's folder, or with `pretrained` the authors'.

        Raises:
            MissingWeightsError: the authors' weights are not on this machine.
            WeightsError: there is no such file, or it is damaged.
        """
        return load_baseline(self.network, "" if name == "pretrained" else f"@{name}")

    def make_scenes(self, scenes: SceneConfig, seed: str) -> SceneSource[Sample]:
        """See `ObjectiveConfig.make_scenes`."""
        return sample_scenes(scenes, self.sampling, seed)


def recipe(network: str) -> TrainConfig:
    """Training of one of `published.NETWORKS` with the authors' parameters, but for the number of steps.

    There is no warm-up, and weights are not averaged.
    """
    return TrainConfig(
        name=network,
        objective=BaselineObjectiveConfig(network=network),
        steps=2000,
        minutes=40.0,
        new_per_batch=1,
        replay_size=32,
        learning_rate=1e-4,
        warmup=1,
        ema=0.0,
        precision="float32",
        validate_every=0,
    )


def clip_terms(
    made: Float[Tensor, "time 3 height width"], clip: TrainingClip
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """L1 in the holes over their number of pixels, and the same outside of them; 0 if there are none."""
    difference = (made - clip.truth).abs().mean(1)
    holes = clip.holes.float()
    inside, outside = ((difference * part).sum() / part.sum().clamp_min(1) for part in (holes, 1 - holes))
    return inside, outside


def flow_term(flows: LocalFlows, true: LocalFlows) -> Float[Tensor, ""]:
    """The sum of the mean L1 of both directions; 0 for a clip of one view, which has no flow."""
    if not flows.to_next.numel():
        return flows.to_next.sum()
    return l1_loss(flows.to_next, true.to_next) + l1_loss(flows.to_previous, true.to_previous)


def _initialise(network: TokenTransformer | E2FGVI) -> None:
    """Draw the convolutions of encoder and decoder, except for the last, by their fan-in (He et al. 2015).

    With the authors' N(0, 0.02) and frames that are mostly black, outputs become black within tens
    of steps, where tanh has no slope, and stay so for hundreds.
    """
    parts = [child for name, child in network.named_children() if name in ("encoder", "hier_enc", "decoder")]
    convolutions = [m for part in parts for m in part.modules() if isinstance(m, nn.Conv2d)]
    for layer in convolutions[:-1]:
        nn.init.kaiming_normal_(layer.weight, SLOPE)
