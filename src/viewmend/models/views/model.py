"""The default model: re-synthesises the whole subject from the source cameras, with alpha, confidence and depth.

    source cameras -> ray samples -> aggregation -> depth distribution -> blending -> prediction

At half the resolution, samples at fixed offsets behind the proxy are taken from the source cameras along every ray and
aggregated over cameras. A U-Net over the view turns them into a distribution over depths, as networks on cost volumes
do (MVSNet, ENeRF). At full resolution, the cameras are sampled again at the depth found, and blended. What blending
softens comes back as two bands of detail, each from the blended colours, one camera or the rendered view, with a
learned gain for every pixel.
"""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from viewmend.geometry.threads import heavy_operations, light_operations
from viewmend.models.base import ContextProvider, ErrorMap, RenderQuality, State
from viewmend.models.compositing import opaque_in_mask
from viewmend.models.network import Network
from viewmend.models.smooth_fill import fill
from viewmend.models.views.aggregation import AggregatedSamples, SampleAggregator
from viewmend.models.views.config import COLOUR, FEATURES, MASK, OFFSETS, RaysConfig, ViewsConfig
from viewmend.models.views.error_predictor import ErrorPredictor, fallback_view
from viewmend.models.views.grid import (
    CELL_PX,
    Pixels,
    UNet,
    cell_means,
    concatenate_channels,
    crop_to,
    detail_bands,
    index_image,
    nearest_depth,
    rim_depth,
    run_tiled,
    scatter_to_image,
)
from viewmend.models.views.prediction import DepthDistribution, ViewPrediction, unpremultiply
from viewmend.models.views.pyramids import SceneScale, SourceCameras
from viewmend.models.views.ray_fill import RayFill
from viewmend.models.views.sampler import Rays, sample_rays
from viewmend.types import CompletedView, ContextViews, IncompleteView
from viewmend.utils.cancellation import stop_if_cancelled

Mask = Bool[Tensor, "height width"]
Image = Float[Tensor, "3 height width"]
Inputs = Float[Tensor, "7 height width"]
IMAGE_CHANNELS = 7
"""RGB of the first guess, M, whether a pixel is coloured, its largest source weight, and whether it is predicted."""
CHOICES = 4
"""Colours that a pixel blends: trusted cameras at its depth, the most trusted one, the mean over depths, the guess."""
DETAILS = 6
"""Gains of detail: in two bands, of the blended colours, the most trusted camera's, and the guess."""
INITIAL_GAIN = 0.3
"""Of the finest details of the blended colours, before training."""
PIXEL_CHANNELS = 27
"""Inputs of a pixel at full resolution: the colours of the choices, two differences and two masks of them, statistics
of its ray sample, and the certainty of its depth."""
JOINT = 0.03
"""A pixel belongs to the surface of its cell if their depths differ by less than this, in subject sizes."""
LEAST_WEIGHT = 0.01
"""Of pixels outside the subject in the local means around which there is detail."""
MARGIN_PX = 16


class ViewSynthNet(Network):
    """Predicts colour, alpha, confidence and depth of the pixels in E, on the proxy and the rim around it."""

    config: ViewsConfig  # pyright: ignore
    trained_in_bfloat16 = True
    error_rule = "all"
    """It keeps pixels that are correct by itself."""

    def __init__(self, config: ViewsConfig | None = None) -> None:
        super().__init__()
        config = config or ViewsConfig()
        self.config = config  # pyright: ignore[reportIncompatibleVariableOverride]
        self.coarse = None
        if config.coarse_fill == "rays":
            self.coarse = RayFill(RaysConfig(num_views=config.num_views)).requires_grad_(False)
        self.errors = ErrorPredictor(config.error_features) if config.error_features else None
        self.predicts_errors = self.errors is not None
        self.sample_aggregator = SampleAggregator(config.width, config.sample_channels)
        self.unet = UNet(len(OFFSETS) * config.sample_channels + IMAGE_CHANNELS + 2, config.features)
        self.depth_logits = nn.Conv2d(config.features, len(OFFSETS), 1)
        self.pixel_aggregator = SampleAggregator(config.width, config.sample_channels)
        inputs, fine = config.features + PIXEL_CHANNELS + config.sample_channels, config.fine_features
        last = nn.Conv2d(fine, CHOICES + 2 + DETAILS, 3, padding=1)
        with torch.no_grad():
            last.weight[-DETAILS:], last.bias[-DETAILS:] = 0, torch.eye(DETAILS)[0] * INITIAL_GAIN  # pyright: ignore
        self.blending = nn.Sequential(
            *(nn.Conv2d(inputs, fine, 3, padding=1), nn.ReLU(), nn.Conv2d(fine, fine, 3, padding=1), nn.ReLU()), last
        )

    def forward(
        self,
        view: IncompleteView,
        sources: SourceCameras,
        scale: SceneScale | None = None,
        where: Mask | None = None,
        guess: Image | None = None,
    ) -> ViewPrediction:
        """The prediction for pixels of a view; its E is not used.

        For a crop, `scale` is that of the whole view, and `guess` the `coarse_guess` of the whole view, cropped. Pixels
        are predicted `where` they are on the proxy or its rim; None for all of these.
        """
        guess = self.coarse_guess(view, sources) if guess is None else guess
        scale = scale or SceneScale.of(view)
        depth, coloured = rim_depth(view.depth), view.weights.sum(0) > 0
        where = depth > 0 if where is None else where & (depth > 0)
        image = torch.cat([guess, torch.stack([view.mask, coloured.float(), view.weights.amax(0), where.float()])])
        view = replace(view, depth=depth)
        distribution = self._depth_distribution(view, sources, scale, where, image)
        return self._blend(view, sources, scale, torch.nonzero(where), image, distribution)

    @torch.no_grad()
    def coarse_guess(self, view: IncompleteView, sources: SourceCameras | None, quick: bool = False) -> Image:
        """The whole view with its holes filled by the coarse fill; `quick` fills them from their surroundings only."""
        if quick or self.coarse is None:
            return fill(view.rgb, view.holes, view.mask > 0)
        return self.coarse(replace(view, error=view.holes.to(view.error)), sources).float()

    @torch.no_grad()
    @light_operations()
    def predict_errors(self, view: IncompleteView, context: ContextProvider) -> ErrorMap | None:
        """The predicted errors of a rendered view; None without an `ErrorPredictor` or cameras."""
        sources = SourceCameras.closest_to(view, context, self.config.num_views) if self.errors is not None else None
        if self.errors is None or sources is None:
            return None
        return self.errors.predict(view, sources, context.quality)

    def encode_cameras(self, views: ContextViews, context: ContextProvider) -> None:
        """Computes the image pyramids of these cameras."""
        SourceCameras.of(views, None, context)

    def crop_margin_px(self, quality: RenderQuality) -> int:
        """The surroundings of the subject show where its outline is."""
        return MARGIN_PX

    @torch.no_grad()
    @light_operations()
    def step(self, view: IncompleteView, context: ContextProvider, state: State) -> tuple[CompletedView, State]:
        """Predicts all of E on the proxy and its rim, or attenuates it where `view.fade` says so.

        With a `RenderQuality.refine_fraction` of 0 nothing is predicted: holes are filled from their surroundings.
        """
        where = view.refine_mask & (rim_depth(view.depth) > 0)
        fades = torch.zeros_like(where) if view.fade is None else view.fade > 0
        if context.quality.refine_fraction == 0 and bool((where | fades).any()):
            return fallback_view(view, fades, self.coarse_guess(view, None, quick=True)), state
        sources = SourceCameras.closest_to(view, context, self.config.num_views) if bool(where.any()) else None
        if sources is None:
            return (CompletedView(view, view.rgb) if view.fade is None else fallback_view(view, fades)), state
        quick = context.quality.refine_fraction is not None
        guess = self.coarse_guess(view, sources, quick)
        ray_fill = guess if not quick and self.coarse is not None else None
        completed = self(view, sources, where=where, guess=guess).composite_into(view, where, fades, ray_fill)
        return opaque_in_mask(completed), state

    def _depth_distribution(
        self, view: IncompleteView, sources: SourceCameras, scale: SceneScale, where: Mask, image: Inputs
    ) -> DepthDistribution:
        """Samples on the rays of all cells, judged by a U-Net over the view."""
        depth = nearest_depth(view.depth * where)
        cells = torch.nonzero(depth > 0)
        z = depth[tuple(cells.T)][:, None] + scale.size_m * depth.new_tensor(OFFSETS)
        rays = Rays(view, scale, CELL_PX * (cells.flip(1).double() + 0.5), z).split(sources.rays_at_once)
        front = nearest_depth(view.depth)
        beyond = torch.where(front > 0, ((front - scale.depth_m) / scale.size_m).tanh(), 0.0)
        means = cell_means(image)
        with self.autocast():
            parts = []
            for part in rays:
                stop_if_cancelled()
                parts.append(self.sample_aggregator(sample_rays(part, sources, float(CELL_PX))))
            samples = AggregatedSamples(*map(torch.cat, zip(*parts, strict=True)))
            inputs = samples.features.flatten(1).to(self.compute_dtype)
            images = torch.cat([means, beyond[None], (front > 0)[None].to(means)]).to(inputs)
            stop_if_cancelled()
            with heavy_operations():
                features = self.unet.forward_points(inputs, cells, concatenate_channels(images))
            logits = self.depth_logits(features)[0, :, cells[:, 0], cells[:, 1]].T.float() + samples.score.float()
        return DepthDistribution(cells, index_image(cells, depth.shape), depth, logits, samples, features)

    def _blend(
        self,
        view: IncompleteView,
        sources: SourceCameras,
        scale: SceneScale,
        pixels: Pixels,
        image: Inputs,
        distribution: DepthDistribution,
    ) -> ViewPrediction:
        """Samples the cameras at the depth of each pixel, and blends them."""
        stop_if_cancelled()
        hypothesis, offset, certainty = self._depth_offset(pixels, distribution)
        cell = distribution.cell_index[tuple((pixels // CELL_PX).T)]
        own, front = view.depth[tuple(pixels.T)], distribution.depth[tuple(distribution.cells.T)][cell]
        front = torch.where((own - front).abs() < JOINT * scale.size_m, own, front)
        depth = front + scale.size_m * offset
        rays = Rays(view, scale, pixels.flip(1).double() + 0.5, depth.detach()[:, None])
        samples = sample_rays(rays, sources, 1.0, cubic=True)
        stop_if_cancelled()
        with self.autocast():
            blended = self.pixel_aggregator(samples, distribution.samples.trust[cell, hypothesis][:, None])
        sharp = unpremultiply(blended.colour[:, 0], blended.mask[:, 0])
        best = blended.trust[:, 0].argmax(1)[:, None, None].expand(-1, 1, FEATURES)
        best = samples.features[:, 0].gather(1, best)[:, 0]
        single = unpremultiply(best[:, COLOUR], best[:, MASK])
        shares = distribution.logits.softmax(1)[..., None]
        means = [(shares * part).sum(1) for part in (distribution.samples.colour, distribution.samples.mask)]
        means = distribution.interpolate(torch.cat(means, 1), pixels)
        soft = unpremultiply(means[:, :3], means[:, 3:])
        here = image[:, pixels[:, 0], pixels[:, 1]].T
        guess = here[:, :3]
        inputs = [sharp, single, soft, guess, sharp - guess, blended.mask[:, 0], means[:, 3:], here[:, 4:6]]
        inputs += [samples.statistics[:, 0, 3:6].mean(1, keepdim=True), samples.statistics[:, 0, 6:]]
        inputs += [certainty[:, None], (sharp - single).abs().mean(1, keepdim=True), offset[:, None]]
        inputs += [blended.features[:, 0]]
        out = self._blending_layers(torch.cat(inputs, 1), pixels, view.mask.shape, distribution.features)
        choice = out[:, :CHOICES].softmax(1)
        straight = (choice[..., None] * torch.stack([sharp, single, soft, guess], 1)).sum(1)
        alpha = (out[:, CHOICES] + 4 * (blended.mask[:, 0, 0] - 0.5)).sigmoid()
        confidence = out[:, CHOICES + 1].sigmoid()
        weight = blended.mask[:, 0, 0].clamp_min(LEAST_WEIGHT)
        bands = detail_bands(torch.stack([straight, single, guess], 1), weight, pixels, view.mask.shape)
        gains = out[:, CHOICES + 2 :].unflatten(1, bands.shape[1:3])
        sharp = (straight + (gains[..., None] * bands).sum((1, 2))).clamp(0, 1)
        rgb, trust = alpha[:, None] * sharp, blended.trust[:, 0]
        return ViewPrediction(pixels, rgb, alpha, confidence, depth, trust, distribution)

    def _depth_offset(
        self, pixels: Pixels, distribution: DepthDistribution
    ) -> tuple[Int[Tensor, "pixel"], Float[Tensor, "pixel"], Float[Tensor, "pixel"]]:
        """Each pixel's most probable hypothesis, the mean offset around it in subject sizes, and its probability."""
        shares = distribution.interpolate(distribution.logits.softmax(1), pixels)
        best = shares.argmax(1)
        around = torch.stack([best - 1, best, best + 1], 1).clamp(0, len(OFFSETS) - 1)
        weight = shares.gather(1, around) + 1e-6
        offset = (weight * weight.new_tensor(OFFSETS)[around]).sum(1) / weight.sum(1)
        return best, offset, shares.amax(1)

    def _blending_layers(
        self,
        inputs: Float[Tensor, "pixel input"],
        pixels: Pixels,
        shape: torch.Size,
        features: Float[Tensor, "1 feature rows columns"],
    ) -> Float[Tensor, "pixel output"]:
        """The last convolutions, at these pixels."""
        with self.autocast(), heavy_operations():
            if inputs.device.type == "cpu" and not torch.is_grad_enabled():
                return run_tiled(self.blending, features, inputs.to(features), pixels, shape).float()
            near = F.interpolate(features, scale_factor=CELL_PX, mode="bilinear", align_corners=False)
            near = crop_to(near[0], shape)
            out = self.blending(concatenate_channels(near, scatter_to_image(inputs.to(near), pixels, shape)))
        return out[0, :, pixels[:, 0], pixels[:, 1]].T.float()
