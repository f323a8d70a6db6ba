"""Training of the default model, `views`: its options, its views, its loss and its validation.

Colours give three labels per pixel. The studio also knows which sample along the ray is the
surface, which cameras see it, and how much of the pixel the subject covers. Captures have no true
depth; their views skip the terms that need it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from random import Random
from typing import Annotated, Literal

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor, nn
from torch.nn import functional as F

from viewmend.geometry.cameras import project, unproject
from viewmend.geometry.rim import rim_depth
from viewmend.geometry.sampling import in_view
from viewmend.metrics.image_quality import psnr
from viewmend.metrics.lpips import MIN_PX, load_lpips
from viewmend.models.checkpoint import load_inpainter, load_network
from viewmend.models.network import faster_dtype, set_compute_dtype
from viewmend.models.views.config import COLOUR, OFFSETS, ViewsConfig
from viewmend.models.views.grid import CELL_PX, nearest_depth, scatter_to_image
from viewmend.models.views.model import ViewSynthNet
from viewmend.models.views.prediction import ViewPrediction
from viewmend.models.views.pyramids import Pyramid, SceneScale, SourceCameras
from viewmend.models.views.ray_fill import RayFill
from viewmend.rendering.crop import Crop, subject_crop
from viewmend.rendering.error_mask import attenuate_background
from viewmend.training.config import ObjectiveConfig, SamplingConfig, SceneConfig, SceneSource, TrainConfig
from viewmend.training.objective import (
    MIN_SQUARE,
    ImageLoss,
    Objective,
    StepOutput,
    load_start,
    mean_loss,
    write_rows,
)
from viewmend.training.replay import first_samples
from viewmend.training.samples import Sample
from viewmend.training.scenes import rig_source, validation_scenes
from viewmend.training.shards import storable
from viewmend.training.stored_scenes import StoredSamples, StoredScene, StoredSceneMaker
from viewmend.types import IncompleteView
from viewmend.utils.options import HIDDEN
from viewmend.utils.tensors import to_device

Image = Float[Tensor, "3 height width"]
Mask = Bool[Tensor, "height width"]
CROP_PX = 112
"""Side of the square crops of a view that are trained on."""
MARGIN_PX = 16
"""Margin around the subject that is kept of a view."""
MIN_SUBJECT_PX = 200
"""Views of a smaller subject are skipped."""
MIN_VIEWS = 3
"""Smallest number of cameras after some were removed at random."""
FEWER_VIEWS = 0.6
"""This fraction of the crops has fewer cameras."""
SPARSE = 0.3
"""This fraction of the crops has some pixels that are not predicted."""
RECOLOURED = 0.7
"""This fraction of the views has changed colours."""
SMOOTH_FILL = 0.3
"""This fraction of the views has holes that are filled from their surroundings only."""
MIN_GAIN = 0.6
"""Smallest factor by which changed colours are darkened."""
WRONG_DIFFERENCE = 0.08
"""Crops are drawn around rendered pixels of which a channel, in [0, 1], is off by more than this."""
CORRECT_DIFFERENCE = 0.1
"""The confidence and error predictions count a pixel as correct if no channel is off by more than this."""
RIGHT_DIFFERENCE = 0.05
"""The term `damage` counts a rendered pixel as right if no channel is off by more than this."""
DAMAGE_DIFFERENCE = 0.08
"""The term `damage` penalises predictions of right pixels of which a channel is off by more than this."""
VISIBLE = 0.02
"""A camera sees a point if its true depth there differs by less, in subject sizes."""
GAIN_WEIGHT = 4.0
"""Weight of the cross-entropy of gains, which are small numbers."""
REFINED_FRACTION = 0.15
"""Fraction of the proxy's pixels that validation refines by predicted errors."""
for kind in (SourceCameras, SceneScale, Pyramid):
    storable(kind)  # parts of a `TrainingView`, which is written if a loss is not finite


@dataclass(frozen=True, kw_only=True)
class ViewsLossWeights:
    """Weights of the terms of the loss; 0 disables a term."""

    colour: Annotated[float, HIDDEN] = 1.0
    """L1 of colours on black."""
    perceptual: float = 0.7
    """Weight of LPIPS (AlexNet) on a crop, which keeps views sharp."""
    damage: Annotated[float, HIDDEN] = 1.0
    """Weight of errors beyond `DAMAGE_DIFFERENCE` where the rendered colour was right."""
    holes: Annotated[float, HIDDEN] = 4.0
    """Additional weight of pixels that no source view colours."""
    log_error: Annotated[float, HIDDEN] = 0.5
    """Weight of log10 of the squared error of a crop."""
    gradient: Annotated[float, HIDDEN] = 0.3
    """Weight of L1 of differences between neighbouring pixels, which keeps textures sharp."""
    cell_colour: Annotated[float, HIDDEN] = 0.5
    """L1 of the mean colour over the samples of a ray."""
    alpha: Annotated[float, HIDDEN] = 0.5
    """L1 of alpha, plus 0.3 of its cross-entropy."""
    depth: Annotated[float, HIDDEN] = 0.1
    """Cross-entropy of the surface's sample along the ray."""
    visibility: Annotated[float, HIDDEN] = 0.1
    """Negative log of the weight given to cameras that see the surface."""
    errors: Annotated[float, HIDDEN] = 0.5
    """Cross-entropies of the error predictor."""
    confidence: Annotated[float, HIDDEN] = 0.05
    """Cross-entropy of whether a pixel is correct."""


def initial_model(config: "ViewsObjectiveConfig", precision: str) -> ViewSynthNet:
    """The untrained model, with the ray fill of another one.

    Raises:
        WeightsError: the other model does not exist, or is damaged.
        ValueError: it has no ray fill, or one of other sizes.
    """
    net = ViewSynthNet(config.model)
    if isinstance(net.coarse, RayFill):
        source = load_network(config.coarse_from)
        fill = source.coarse if isinstance(source, ViewSynthNet) else source
        weights = fill.state_dict() if isinstance(fill, RayFill) else {}
        if {k: v.shape for k, v in weights.items()} != {
            k: v.shape for k, v in net.coarse.state_dict().items()
        }:
            raise ValueError(
                f"expected a model with a ray fill of the recipe's sizes, got '{config.coarse_from}'; name another "
                "one by --coarse-from"
            )
        net.coarse.load_state_dict(weights)
    set_compute_dtype(net, torch.bfloat16 if precision == "bfloat16" else torch.float32)
    return net


def filling_model(config: "ViewsObjectiveConfig", precision: str) -> ViewSynthNet:
    """`initial_model` for filling the holes of training views, on the CPU, also if the run is on a GPU.

    `precision` is that of the run; the CPU computes in bfloat16 only if that is faster.
    """
    is_faster = faster_dtype(torch.device("cpu")) == torch.bfloat16
    return initial_model(config, precision if is_faster else "float32")


@storable
@dataclass(frozen=True)
class TrainingView:
    """A rendered view around the subject, its cameras as image pyramids, and the ground truth."""

    view: IncompleteView
    sources: SourceCameras
    scale: SceneScale
    filled: Image
    """The image with holes filled by `ViewSynthNet.fill_holes`."""
    truth: UInt8[Tensor, "3 height width"]
    """F*, on black."""
    alpha: UInt8[Tensor, "height width"]
    """True coverage of each pixel by the subject, in 255ths."""
    depth: Float[Tensor, "height width"] | None
    """True z-depth in metres, 0 where there is no surface; None if unavailable."""

    @classmethod
    def of(cls, sample: Sample, net: ViewSynthNet, smooth_fill: bool = False) -> "TrainingView":
        """The view of a sample with alpha and `ray_views`.

        Holes are filled by `net`, or from their surroundings if `smooth_fill`.
        """
        assert sample.ray_views and sample.alpha is not None, "stored scenes have both"
        view = sample.view
        truth = sample.truth
        alpha = sample.alpha
        depth = sample.depth
        scale = SceneScale.of(view)
        sources = SourceCameras.of(sample.ray_views, view.silhouettes)
        crop = subject_crop(view, MARGIN_PX)
        view = crop.of_view(view)
        truth = crop.of_image(truth).contiguous()
        alpha = crop.of_image(alpha).contiguous()
        depth = None if depth is None else crop.of_image(depth).contiguous()
        return cls(view, sources, scale, net.fill_holes(view, sources, smooth_fill), truth, alpha, depth)

    def cropped(self, crop: Crop) -> "TrainingView":
        """A part of the view, with the same cameras."""
        filled, truth, alpha = (crop.of_image(image) for image in (self.filled, self.truth, self.alpha))
        depth = None if self.depth is None else crop.of_image(self.depth)
        return replace(
            self, view=crop.of_view(self.view), filled=filled, truth=truth, alpha=alpha, depth=depth
        )

    @property
    def wrong(self) -> Mask:
        """Pixels of the proxy and its rim with an erroneous colour."""
        is_off = (self.view.rgb - self.truth / 255).abs().amax(0) > WRONG_DIFFERENCE
        return is_off & (rim_depth(self.view.depth) > 0)


@dataclass(frozen=True)
class TrainingViews:
    """The samples of a source as `TrainingView`s, most of them recoloured."""

    scenes: SceneSource[Sample]
    seed: str
    net: ViewSynthNet
    smooth_fill: float = SMOOTH_FILL
    """Fraction of views whose holes are filled without `net`."""

    def scene(self, number: int) -> list[TrainingView]:
        """The views of scene `number` with a large enough subject."""
        random, fills = (Random(f"{self.seed}/{kind}/{number}") for kind in ("colours", "guesses"))
        samples = [s for s in self.scenes.scene(number) if int((s.view.mask > 0).sum()) >= MIN_SUBJECT_PX]
        samples = [recolour(s, random) if random.random() < RECOLOURED else s for s in samples]
        return [TrainingView.of(s, self.net, fills.random() < self.smooth_fill) for s in samples]


def recolour(sample: Sample, random: Random) -> Sample:
    """The sample with permuted colour channels, darkened by a random factor."""
    assert sample.ray_views is not None, "stored scenes have cameras"
    channels = random.sample(range(3), 3)
    gain = random.uniform(MIN_GAIN, 1)
    frame = sample.ray_views.frame
    images = frame.rgb[:, channels], sample.truth[channels]
    rgb, truth = ((gain * image.float()).round().to(torch.uint8) for image in images)
    view = replace(sample.view, rgb=gain * sample.view.rgb[channels])
    return replace(
        sample, view=view, ray_views=replace(sample.ray_views, frame=replace(frame, rgb=rgb)), truth=truth
    )


def random_crop(whole: TrainingView) -> TrainingView:
    """A crop of the view, half of the time around an erroneous pixel; mostly with fewer cameras."""
    wrong = torch.nonzero(whole.wrong & (whole.view.mask > 0))  # the rim may have no depth within the crop
    pixels = wrong if len(wrong) and bool(torch.rand(()) < 0.5) else torch.nonzero(whole.view.mask > 0)
    height, width = whole.view.mask.shape
    row, column = pixels[int(torch.randint(len(pixels), ()))].tolist()
    top, bottom = _crop_side(row, height)
    left, right = _crop_side(column, width)
    crop = whole.cropped(Crop(left, top, right, bottom))
    num_views = len(whole.sources.pyramids)
    if num_views > MIN_VIEWS and bool(torch.rand(()) < FEWER_VIEWS):
        crop = replace(crop, sources=whole.sources.first(int(torch.randint(MIN_VIEWS, num_views, ()))))
    return crop


def random_selection(crop: TrainingView) -> Mask | None:
    """Pixels to predict: sometimes only those around erroneous ones, as an error rule would select; None for all."""
    if float(torch.rand(())) > SPARSE:
        return None
    scattered = (torch.rand(crop.view.mask.shape) < 0.01 * float(torch.rand(()))).to(crop.view.mask.device)
    radius = int(torch.randint(5, ()))
    seeds = (crop.wrong | crop.view.holes | scattered).float()
    selected = (F.max_pool2d(seeds[None], 2 * radius + 1, 1, radius)[0] > 0) & (
        rim_depth(crop.view.depth) > 0
    )
    return selected if bool(selected.any()) else None


def _crop_side(center: int, size: int) -> tuple[int, int]:
    """First and last (exclusive) pixel of a crop that contains a pixel; even, and within the image."""
    if size <= CROP_PX:
        return 0, size
    first = center - int(torch.randint(CROP_PX - 1, ()))  # one less, as it is rounded down
    first = min(max(0, first), size - CROP_PX) // 2 * 2
    return first, first + CROP_PX


class ViewsObjective(Objective[ViewSynthNet]):
    """The loss of `ViewSynthNet` on a random crop of each view of a batch."""

    loss_summary = (
        "L1 of colours with terms of LPIPS, gradients, alpha, "
        "depth, visibility, confidence and predicted errors"
    )

    def __init__(self, config: TrainConfig, options: "ViewsObjectiveConfig", start: nn.Module | None) -> None:
        super().__init__(config, initial_model(options, config.precision))
        load_start(self.model, start, kept="coarse.", optional="errors.")
        self.options = options
        self.weights = options.loss
        # A tuple hides it from PyTorch: it is neither trained nor part of checkpoints
        self._perceptual = (load_lpips("alex"),) if options.loss.perceptual else ()
        self.validation = ViewsValidation(config, options)
        if options.train_params == "errors":
            if self.model.errors is None or start is None:
                raise ValueError(
                    "expected a model with an error predictor for --train-params errors; give --from MODEL"
                )
            self.model.requires_grad_(False)
            self.model.errors.requires_grad_(True)

    def training_scenes(self, seed: str) -> SceneSource[TrainingView]:
        """See `Objective.training_scenes`."""
        samples = StoredSamples(super().training_scenes(seed), self.options.sampling, seed)
        return TrainingViews(samples, seed, filling_model(self.options, self.config.precision))

    def forward(self, batch: Sequence[TrainingView]) -> StepOutput:
        """The mean terms of the batch."""
        outputs = [self._loss(random_crop(view)) for view in batch]
        image = mean_loss([output.image for output in outputs])
        return StepOutput(image, torch.stack([output.total for output in outputs]).mean())

    def _loss(self, crop: TrainingView) -> StepOutput:
        """The loss of one crop. Its `image.outside` is the L1 of all pixels."""
        prediction = self.model(crop.view, crop.sources, crop.scale, random_selection(crop), crop.filled)
        rows, columns = prediction.pixels.unbind(1)
        weights = self.weights
        truth = crop.truth / 255
        difference = prediction.rgb - truth[:, rows, columns].T

        # Colours: L1, logarithmic error, damage to pixels that were right, differences of neighbours
        hole = crop.view.holes[rows, columns].float()
        weight = 1 + weights.holes * hole
        colour = (weight * difference.abs().mean(1)).sum() / weight.sum()
        log_error = (difference.square().mean() + MIN_SQUARE).log10()
        total = weights.colour * colour + weights.log_error * log_error
        was_right = (crop.view.rgb - truth)[:, rows, columns].abs().amax(0) < RIGHT_DIFFERENCE
        damage = (was_right * F.relu(difference.abs().amax(1) - DAMAGE_DIFFERENCE)).mean()
        total = total + weights.damage * damage
        total = total + weights.gradient * _gradient_loss(prediction, difference, crop.view.mask.shape)

        # Alpha and confidence
        alpha = crop.alpha[rows, columns] / 255
        alpha_l1 = (prediction.alpha - alpha).abs().mean()
        total = total + weights.alpha * (alpha_l1 + 0.3 * _cross_entropy(prediction.alpha, alpha))
        is_correct = (difference.detach().abs().amax(1) < CORRECT_DIFFERENCE).float()
        total = total + weights.confidence * _cross_entropy(prediction.confidence, is_correct)

        # Cells, the whole crop, and predicted errors
        total = total + self._cell_terms(crop, prediction)
        total = total + weights.perceptual * self._perceptual_term(crop, prediction)
        total = total + weights.errors * self._error_terms(crop, prediction, difference)

        inside = (hole * difference.detach().abs().mean(1)).sum() / hole.sum().clamp_min(1)
        return StepOutput(ImageLoss(inside, colour.detach(), log_error.detach()), total)

    def _perceptual_term(self, crop: TrainingView, prediction: ViewPrediction) -> Float[Tensor, ""]:
        """LPIPS of the crop with the predicted pixels against the truth, in float32; 0 for crops that are too small."""
        truth = crop.truth / 255
        if not self._perceptual or min(truth.shape[1:]) < MIN_PX["alex"]:
            return truth.new_zeros(())
        at = tuple(prediction.pixels.T)
        image = truth.clone()
        image[:, at[0], at[1]] = prediction.rgb.T.float()
        return self._perceptual[0].to(truth.device)(image[None], truth[None])[0]

    def _error_terms(
        self, crop: TrainingView, prediction: ViewPrediction, difference: Float[Tensor, "pixel 3"]
    ) -> Float[Tensor, ""]:
        """Cross-entropies of the error predictor, at the pixels that were predicted."""
        if self.model.errors is None:
            return difference.new_zeros(())
        at = tuple(prediction.pixels.T)
        found = self.model.errors(crop.view, crop.sources, crop.scale)
        rendered = crop.view.rgb[:, *at].T
        predicted = prediction.rgb.detach()
        truth = predicted - difference.detach()
        wrong = ((rendered - truth).abs().amax(1) > CORRECT_DIFFERENCE).float()
        alpha = found.alpha[at]
        faded = alpha.detach()[:, None] * rendered
        gain = (rendered - predicted).square().mean(1)
        rest = (faded - predicted).square().mean(1)
        gains = _cross_entropy(found.gain[at], gain) + _cross_entropy(found.rest[at], rest)
        other = _cross_entropy(found.wrong[at], wrong) + _cross_entropy(alpha, prediction.alpha.detach())
        return other + GAIN_WEIGHT * gains

    def _cell_terms(self, crop: TrainingView, prediction: ViewPrediction) -> Float[Tensor, ""]:
        """The terms of cells: their mean colour and, where true depth is available, depth and visibility."""
        distribution = prediction.distribution
        weights = self.weights
        cells = tuple(distribution.cells.T)
        shares = distribution.logits.softmax(1)[..., None]
        truth = F.avg_pool2d(crop.truth[None] / 255, CELL_PX, ceil_mode=True)[0, :, cells[0], cells[1]].T
        colour = ((shares * distribution.samples.rgba[..., COLOUR]).sum(1) - truth).abs().mean()
        total = weights.cell_colour * colour
        return total if crop.depth is None else total + self._depth_terms(crop, prediction, crop.depth)

    def _depth_terms(
        self, crop: TrainingView, prediction: ViewPrediction, true_depth: Float[Tensor, "height width"]
    ) -> Float[Tensor, ""]:
        """The terms of cells where the true depth is known: the depth itself, and which cameras see the surface."""
        # The cells' true offsets behind the proxy, where these are in the range of the hypotheses
        distribution = prediction.distribution
        weights = self.weights
        cells = tuple(distribution.cells.T)
        alpha = F.avg_pool2d(crop.alpha[None] / 255, CELL_PX, ceil_mode=True)[0][cells]
        z = nearest_depth(true_depth)[cells]
        offsets = z.new_tensor(OFFSETS)
        offset = (z - distribution.proxy_depth[cells]) / crop.scale.size_m
        known = (z > 0) & (alpha > 0.5) & (offset > offsets[0] - VISIBLE) & (offset < offsets[-1] + 0.1)

        # Cross-entropy with the truth, which is shared between the two nearest hypotheses
        upper = torch.searchsorted(offsets, offset.contiguous()).clamp(1, len(OFFSETS) - 1)
        lower = upper - 1
        upper_share = ((offset - offsets[lower]) / (offsets[upper] - offsets[lower])).clamp(0, 1)
        log_probability = distribution.logits.log_softmax(1)
        lower_log = log_probability.gather(1, lower[:, None])[:, 0]
        upper_log = log_probability.gather(1, upper[:, None])[:, 0]
        depth = -_masked_mean((1 - upper_share) * lower_log + upper_share * upper_log, known)

        # The cameras that see the surface should have all the weight
        seen = visible_cameras(crop, prediction, z)
        nearest = torch.where(upper_share < 0.5, lower, upper)
        if distribution.cameras is not None:
            seen = seen.gather(1, distribution.cameras)
        trust = distribution.samples.trust[torch.arange(len(nearest)), nearest]
        visibility = -_masked_mean(((trust * seen).sum(1) + 1e-3).log(), known & seen.any(1))
        return weights.depth * depth + weights.visibility * visibility


@dataclass(frozen=True, kw_only=True)
class ViewsObjectiveConfig(ObjectiveConfig):
    """Trains `ViewSynthNet`."""

    model: Annotated[ViewsConfig, HIDDEN] = field(
        default_factory=lambda: ViewsConfig(coarse_fill="rays", error_features=24)
    )
    sampling: Annotated[SamplingConfig, HIDDEN] = field(
        default_factory=lambda: SamplingConfig(num_ray_views=8, depth_fraction=0.4)
    )
    train_params: Literal["all", "errors"] = "all"
    """'all': everything but the ray fill. 'errors': only the error predictor of the --from model."""
    coarse_from: str = "rays"
    """Name or folder of the model whose ray fill completes holes; its weights are copied and stay fixed."""
    fused_from: str = "views"
    """Name or folder of the model whose predicted depth is fused, if `fused_fraction` is above 0."""
    loss: ViewsLossWeights = field(default_factory=ViewsLossWeights)
    make_objective = ViewsObjective
    item = StoredScene
    whole_shards = False
    shard_size = 16

    def make_scenes(self, scenes: SceneConfig, seed: str) -> SceneSource[StoredScene]:
        """See `ObjectiveConfig.make_scenes`."""
        if scenes.protocols != ("strict",):
            found = " ".join(scenes.protocols)
            raise ValueError(f"expected --protocols strict for views, got {found}; leave --protocols out")
        depth_model = load_inpainter(self.fused_from) if scenes.fused_fraction > 0 else None
        return StoredSceneMaker(rig_source(scenes, self.sampling.frames, seed), scenes, depth_model)


def _gradient_loss(
    prediction: ViewPrediction, difference: Float[Tensor, "pixel 3"], shape: torch.Size
) -> Float[Tensor, ""]:
    """Mean difference between the errors of neighbouring predicted pixels."""
    image = scatter_to_image(F.pad(difference, (0, 1), value=1.0), prediction.pixels, shape)
    total = image.new_zeros(())
    number = image.new_zeros(())
    for axis in (1, 2):
        one = image.narrow(axis, 1, image.shape[axis] - 1)
        other = image.narrow(axis, 0, image.shape[axis] - 1)
        both = one[3] * other[3]
        total = total + (both * (one[:3] - other[:3]).abs().mean(0)).sum()
        number = number + both.sum()
    return total / number.clamp_min(1)


def visible_cameras(
    crop: TrainingView, prediction: ViewPrediction, z: Float[Tensor, "cell"]
) -> Bool[Tensor, "cell view"]:
    """Which cameras see the true surface of each cell, at z-depth `z` in metres."""
    centers = CELL_PX * (prediction.distribution.cells.flip(1).float() + 0.5)
    points = unproject(centers[None], z[None], crop.view.camera)[0]
    frame = crop.sources.views.frame
    assert frame.depth is not None, "scenes with true depth have it for all cameras"
    at, depth = project(points, frame.cameras)
    column, row = at.long().clamp_min(0).unbind(-1)
    height, width = frame.depth.shape[1:]
    there = frame.depth.flatten(1).gather(1, row.clamp_max(height - 1) * width + column.clamp_max(width - 1))
    near = (depth - there).abs() < VISIBLE * crop.scale.size_m
    return (in_view(at, depth, frame.cameras) & (there > 0) & near).T


def _cross_entropy(chance: Float[Tensor, "pixel"], truth: Float[Tensor, "pixel"]) -> Float[Tensor, ""]:
    return F.binary_cross_entropy(chance.clamp(1e-4, 1 - 1e-4), truth.clamp(0, 1))


def _masked_mean(values: Float[Tensor, "cell"], where: Bool[Tensor, "cell"]) -> Float[Tensor, ""]:
    """The mean of the values at `where`; 0 if there are none."""
    return (values * where).sum() / where.sum().clamp_min(1)


@dataclass
class ViewsValidation:
    """Views of procedural people that training never uses, made at the first validation.

    The scores are PSNR in the subject's box, on black: as rendered, with all pixels predicted
    ("completed"), the same on the true silhouette ("subject") and in holes ("holes"), and with only
    the `REFINED_FRACTION` of highest predicted gain ("refined").
    """

    config: TrainConfig
    options: "ViewsObjectiveConfig"
    _views: list[TrainingView] = field(default_factory=list)

    @torch.no_grad()
    def __call__(self, model: nn.Module, image: Path) -> dict[str, float | None]:
        """Score a model."""
        assert isinstance(model, ViewSynthNet)
        if not self._views:
            self._views = self._make_views()
        device = next(model.parameters()).device
        scores = []
        rows = []
        for view in self._views:
            view_scores, row = _score_view(model, to_device(view, device))
            scores.append(view_scores)
            rows.append(row)
        write_rows(rows, image)
        means = {name: float(torch.tensor([found[name] for found in scores]).nanmean()) for name in scores[0]}
        return {name: None if math.isnan(mean) else mean for name, mean in means.items()}

    def _make_views(self) -> list[TrainingView]:
        """The views, whose holes are filled by the ray fill."""
        scenes = validation_scenes(self.config.scenes, self.options.sampling)
        maker = StoredSceneMaker(scenes.rigs, scenes.config)
        samples = StoredSamples(maker, self.options.sampling, "validation")
        net = filling_model(self.options, self.config.precision)
        source = TrainingViews(samples, "validation", net, smooth_fill=0.0)
        return first_samples(source, self.config.validation_views)


def _score_view(
    model: ViewSynthNet, example: TrainingView
) -> tuple[dict[str, float], Float[Tensor, "3 _h _w"]]:
    """The scores of one view, and a row of images: as rendered, completed, and true."""
    view = example.view
    truth = example.truth / 255
    prediction = model(view, example.sources, example.scale, filled=example.filled)
    rgb = scatter_to_image(prediction.rgb, prediction.pixels, view.mask.shape)
    scores = {
        "rendered": _psnr(view.rgb, truth),
        "completed": _psnr(rgb, truth),
        "subject": _psnr(rgb, truth, example.alpha > 127),
        "holes": _psnr(rgb, truth, (view.mask > 0) & (view.weights.sum(0) == 0)),
    }
    if model.errors is not None:
        rim = replace(view, error=(rim_depth(view.depth) > 0).to(view.error))
        errors = model.errors(view, example.sources, example.scale)
        part = attenuate_background(rim, errors, REFINED_FRACTION)
        refined = torch.where(part.refine_mask, rgb, (1 - part.error) * view.rgb)
        scores["refined"] = _psnr(refined, truth)
    return scores, torch.cat([view.rgb, rgb, truth], 2).cpu()


def _psnr(image: Image, truth: Image, where: Mask | None = None) -> float:
    """NaN if there are no such pixels."""
    score = psnr(image, truth, torch.ones_like(truth[0], dtype=torch.bool) if where is None else where)
    return float("nan") if score is None else score
