"""What a run trains: a model with its loss, data, optimiser and validation. The loop is in `viewmend.training.loop`."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, Literal, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from viewmend.data.images import write_image
from viewmend.metrics.image_quality import psnr
from viewmend.models.base import ContextProvider
from viewmend.models.checkpoint import save_inpainter
from viewmend.models.classical import Telea
from viewmend.models.compositing import Background, composite
from viewmend.models.network import set_compute_dtype
from viewmend.training.adversarial import Adversary, Judged
from viewmend.training.config import SceneSource, TrainConfig
from viewmend.training.replay import first_samples
from viewmend.training.samples import Sample, true_image
from viewmend.training.shards import ShardScenes
from viewmend.utils.tensors import to_device

Images = Sequence[Float[Tensor, "3 _h _w"]]
Planes = Sequence[Float[Tensor, "_h _w"]]
MIN_SQUARE = 1e-4
"""This is added to squared errors before the logarithm, so that nothing is gained beyond 40 dB."""
WEIGHT_DECAY = 0.01
"""The weight decay of AdamW."""
WARMUP_PROGRESS = 0.1
"""The share of a run after which the learning rate is no longer warmed up."""
TILE_PX = 256
"""Each image in the image of a validation has this height, pixels."""
SHOWN_VIEWS = 8
"""Views in the image of a validation."""
TRAINED_SCORE = "holes_seen"
"""A validation has this score for views that the run trains on."""
NEW_VIEWS_SCORE = "holes_alike"
"""A validation has this score for new views of the people that the run trains on."""
Model = TypeVar("Model", bound=nn.Module)
Validation = Callable[[nn.Module, Path], dict[str, float | None]]
"""Returns the averaged model's mean scores in dB, on fixed views that a run never trains on, and
writes an image of the first views to the path."""


@dataclass(frozen=True)
class ImageLoss:
    """The image terms of a batch; each is 0 if it has no pixels."""

    inside: Float[Tensor, ""]
    """L_in of section 8: L1 in the holes."""
    outside: Float[Tensor, ""]
    """L_out of section 8: L1 outside the holes."""
    log_error: Float[Tensor, ""]
    """log10 of the mean squared error in the holes, a tenth of -PSNR. Where a pixel may be subject
    or background, L1 settles for one of the two; squares do not."""


@dataclass(frozen=True)
class StepOutput:
    """The loss of one batch."""

    image: ImageLoss
    total: Float[Tensor, ""]
    """The weighted sum of all terms except L_adv."""
    judged: Judged | None = None
    """The batch for the discriminator, if the objective has one."""


class Objective(nn.Module, Generic[Model]):
    """A model and its loss; subclasses implement `forward`. The other methods have defaults."""

    loss_summary = ""
    """The loss in words, for the model card."""
    max_grad_norm = 1.0
    """Norm to which gradients are clipped."""
    adversary: Adversary | None = None
    """The discriminator, for objectives with an adversarial term."""
    validation: Validation | None = None
    scores_training_views = False
    """Whether the validation also has `TRAINED_SCORE` and `NEW_VIEWS_SCORE`. Then the starting weights are
    scored, too, to compare with."""

    def __init__(self, config: TrainConfig, model: Model) -> None:
        super().__init__()
        self.config = config
        self.model = model.train()
        set_compute_dtype(model, torch.bfloat16 if config.precision == "bfloat16" else torch.float32)

    def forward(self, batch: Sequence[Any]) -> StepOutput:
        """All terms of a batch, except L_adv."""
        raise NotImplementedError

    def training_scenes(self, seed: str) -> SceneSource[Any]:
        """The scenes of one stream of batches: those of shards if given, else generated ones.

        Raises:
            CaptureError, ShardError, WeightsError: the data cannot be used.
            ValueError: data reserved for tests is requested.
        """
        options = self.config.objective
        shards = self.config.shards
        if shards is None:
            return options.make_scenes(self.config.scenes, seed)
        return ShardScenes(shards, seed, options.item, options.whole_shards, options.sampling.clip_length)

    def make_optimizer(self, parameters: list[nn.Parameter], learning_rate: float) -> torch.optim.Optimizer:
        """The optimiser of the model's trained parameters."""
        return torch.optim.AdamW(parameters, lr=learning_rate, weight_decay=WEIGHT_DECAY)

    def learning_rate_factor(self, step: int, progress: float, warmup: int) -> float:
        """Factor of the peak learning rate: linear warm-up, then a cosine to 0 as `progress` goes from 0 to 1.

        Warm-up ends after `warmup` steps, or after a tenth of a shorter run.
        """
        warm = max((step + 1) / warmup, progress / WARMUP_PROGRESS)
        return min(warm, 1.0) * 0.5 * (1 + math.cos(math.pi * min(progress, 1.0)))

    def save(self, model: nn.Module, folder: Path, card: str) -> None:
        """Write a model of this objective, usually the averaged one, with its card."""
        save_inpainter(model, folder, card)  # pyrefly: ignore[bad-argument-type]


def load_start(model: nn.Module, start: nn.Module | None, kept: str = "", optional: str = "") -> None:
    """Copy the weights of a model to start from, if there is one.

    The model keeps its own weights with the prefix `kept`, and `start` may lack those with the
    prefix `optional`. Raises ValueError if it lacks others, or has them in other sizes.
    """
    if start is None:
        return
    own = model.state_dict()
    found = start.state_dict()
    own = {name: weight for name, weight in own.items() if not (kept and name.startswith(kept))}
    fitting = {
        name: found[name]
        for name, weight in own.items()
        if name in found and found[name].shape == weight.shape
    }
    missing = [name for name in own if name not in fitting and not (optional and name.startswith(optional))]
    if missing:
        raise ValueError(
            f"expected a {type(model).__name__} of the recipe's sizes to start from, got a {type(start).__name__} "
            f"without a fitting {missing[0]}; start from another model, or without --from"
        )
    model.load_state_dict(model.state_dict() | fitting)


def image_loss(
    predicted: Images,
    counted: Planes,
    error: Planes,
    truth: Images,
    channels: Literal["mean", "sum"] = "mean",
) -> ImageLoss:
    """The mean losses of a batch of images of any sizes: of Ftilde, given E, and F* on the same background.

    L_out includes pixels where `counted` is above 0. L_in and L_out take the mean over the
    `channels` or, as in the paper, the sum.
    """
    losses = []
    for image, included, E, target in zip(predicted, counted, error, truth, strict=True):
        off = image.float() - target
        l1 = off.abs().sum(0) if channels == "sum" else off.abs().mean(0)
        inside, outside = (_weighted_mean(l1, weight) for weight in (E, (1 - E) * (included > 0)))
        losses.append(
            ImageLoss(inside, outside, (_weighted_mean(off.square().mean(0), E) + MIN_SQUARE).log10())
        )
    return mean_loss(losses)


def _weighted_mean(
    values: Float[Tensor, "height width"], weight: Float[Tensor, "height width"]
) -> Float[Tensor, ""]:
    """0 if the weight is 0 everywhere."""
    return (weight * values).sum() / weight.sum().clamp_min(1e-6)


def mean_loss(losses: Sequence[ImageLoss]) -> ImageLoss:
    """The mean of each term."""
    terms = zip(*((loss.inside, loss.outside, loss.log_error) for loss in losses), strict=True)
    return ImageLoss(*(torch.stack(term).mean() for term in terms))


def write_rows(rows: Images, path: Path) -> None:
    """Write the first rows of input, output and ground truth as one image, all scaled to one size."""
    size = (TILE_PX, 3 * TILE_PX)
    scaled = [
        F.interpolate(row[None], size, mode="bilinear", antialias=True)[0] for row in rows[:SHOWN_VIEWS]
    ]
    image = (torch.cat(scaled, 1).clamp(0, 1) * 255).round().to(torch.uint8)
    write_image(path, image.permute(1, 2, 0).contiguous().numpy())


@dataclass
class HoleValidation:
    """PSNR in the holes of fixed views, of the model ("holes") and of OpenCV's Telea ("telea").

    Each of the `others` gets scores of its own, from as many views: "seen" has "holes_seen" and
    "telea_seen". The views are made at the first validation.
    """

    scenes: SceneSource[Sample]
    num_views: int
    complete: Callable[[nn.Module, Sample], Float[Tensor, "3 _h _w"]]
    """The model's completed view of a sample, on `background`."""
    background: Background
    others: Mapping[str, SceneSource[Sample]] = field(default_factory=dict)
    """Further scenes, by the suffix of their scores."""
    _samples: dict[str, list[Sample]] = field(default_factory=dict)

    @torch.no_grad()
    def __call__(self, model: nn.Module, image: Path) -> dict[str, float | None]:
        """Score a model."""
        sources = {"": self.scenes} | {f"_{name}": scenes for name, scenes in self.others.items()}
        training = model.training
        model.eval()
        scores: dict[str, float | None] = {}
        rows: list[Tensor] = []
        for suffix, source in sources.items():
            if suffix not in self._samples:
                self._samples[suffix] = first_samples(source, self.num_views)
            pairs = torch.tensor([self._score(model, sample, rows) for sample in self._samples[suffix]])
            scores[f"holes{suffix}"], scores[f"telea{suffix}"] = pairs.mean(0).tolist()
        model.train(training)
        write_rows(rows, image)
        return scores

    def _score(
        self, model: nn.Module, sample: Sample, rows: list[Tensor]
    ) -> tuple[float | None, float | None]:
        """PSNR in the holes of the model and of Telea; appends a row of images."""
        device = next(model.parameters()).device
        truth = true_image(sample, self.background)
        holes = sample.view.missing > 0
        completed = self.complete(model, to_device(sample, device)).float().clamp(0, 1).cpu()
        telea = Telea()
        filled, _ = telea.step_on(
            self.background, sample.view, ContextProvider(lambda *_: None), telea.initial_state()
        )
        classical = composite(self.background, filled.rgb, filled.opacity)
        rows.append(torch.cat([sample.view.rgb, completed, truth], 2))
        return psnr(completed, truth, holes), psnr(classical, truth, holes)
