"""The default model: re-synthesises the whole subject from the source cameras, with alpha, confidence and depth.

    source cameras -> ray samples -> aggregation -> depth distribution -> blending -> prediction

At half the resolution, each cell of 2 x 2 pixels has one ray, with samples at fixed offsets behind
the proxy (the surface of the visual hull). The source cameras that see a ray best are sampled there
and aggregated. A U-Net over the view turns the samples into a distribution over depths, as networks
on cost volumes do (MVSNet, ENeRF).

At full resolution, the cameras are sampled again at the depth found, and blended. Blending softens
the image, so detail is added in two frequency bands. It is taken from the blended colours, from one
camera and from the rendered view, with learned gains for every pixel.
"""

from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional as F

from viewmend.geometry.rim import rim_depth
from viewmend.geometry.threads import all_threads, one_thread
from viewmend.models.base import ContextProvider, DepthMap, ErrorMap, RenderQuality, State
from viewmend.models.compositing import opaque_in_mask
from viewmend.models.network import Network
from viewmend.models.smooth_fill import fill
from viewmend.models.views.aggregation import AggregatedSamples, SampleAggregator
from viewmend.models.views.config import COLOUR, FEATURES, MASK, OFFSETS, RAY_VIEWS, RaysConfig, ViewsConfig
from viewmend.models.views.error_predictor import ErrorPredictor, fallback_view
from viewmend.models.views.grid import (
    BAND_PX,
    CELL_PX,
    LARGE_CELLS_FROM,
    Pixels,
    UNet,
    cell_means,
    concatenate_channels,
    crop_to,
    detail_bands,
    downsample2x,
    index_image,
    nearest_depth,
    run_tiled,
    scatter_to_image,
)
from viewmend.models.views.prediction import (
    DepthDistribution,
    SurfacePoints,
    ViewPrediction,
    surface_points,
    unpremultiply,
)
from viewmend.models.views.pyramids import SceneScale, SourceCameras
from viewmend.models.views.ray_fill import RayFill
from viewmend.models.views.sampler import Rays, RaySamples, RayStatistics, choose_cameras, sample_rays
from viewmend.models.views.steadying import steady
from viewmend.types import CompletedView, ContextViews, IncompleteView
from viewmend.utils.cancellation import stop_if_cancelled

Mask = Bool[Tensor, "height width"]
Image = Float[Tensor, "3 height width"]
IMAGE_CHANNELS = 7
"""`ViewImage` has this many channels."""
CHOOSING_OFFSETS = (0.0, 0.053, 0.19)
"""A ray's cameras are chosen by what they see at these z-depths behind the proxy, in subject sizes."""
CELL_CHANNELS = IMAGE_CHANNELS + 2
"""A cell of the U-Net has the channels of `ViewImage`, its relative depth, and whether it has a depth."""
NUM_CANDIDATES = 4
"""A pixel blends this many colours: those in `CandidateColours`."""
NUM_GAINS = 3 * len(BAND_PX)
"""A pixel's detail is multiplied by this many gains: three per band, for the blended colours, the
most trusted camera and the guess."""
INITIAL_GAIN = 0.3
"""The blended colours have this gain in the finest band before training; all other gains are 0."""
PIXEL_CHANNELS = 27
"""`pixel_inputs` has this many channels. The last convolutions also get features of the U-Net and
of the pixel's sample."""
OUTPUT_CHANNELS = (NUM_CANDIDATES, 1, 1, NUM_GAINS)
"""The last convolutions return scores of the candidate colours, alpha, confidence, and gains of detail."""
ALPHA_SLOPE = 4.0
"""The cameras' mean mask, minus 0.5, is multiplied by this factor and added to the logit of alpha."""
MIN_DETAIL_WEIGHT = 0.01
"""Detail is the difference from a local mean, in which every pixel has at least this weight."""
MARGIN_PX = 16
"""A crop with a margin of this many pixels around the subject gives the same prediction as the whole view."""


class ViewImage(NamedTuple):
    """What the network gets of the rendered view itself."""

    guess: Image
    """RGB on black, with holes filled by the coarse guess."""
    mask: Float[Tensor, "height width"]
    """M: 1 where the proxy covers the pixel."""
    coloured: Float[Tensor, "height width"]
    """1 where a source camera coloured the pixel."""
    largest_weight: Float[Tensor, "height width"]
    """The largest weight of a source camera in the pixel's colour."""
    predicted: Float[Tensor, "height width"]
    """1 where the pixel is to be predicted."""

    @classmethod
    def of(cls, view: IncompleteView, guess: Image, predicted: Mask) -> "ViewImage":
        """The inputs from a view whose holes are filled in `guess`."""
        coloured = view.weights.sum(0) > 0
        return cls(guess, view.mask, coloured.float(), view.weights.amax(0), predicted.float())

    def stacked(self) -> Float[Tensor, "7 height width"]:
        """All channels in one image."""
        planes = [self.mask, self.coloured, self.largest_weight, self.predicted]
        return torch.cat([self.guess, torch.stack(planes)])


class CandidateColours(NamedTuple):
    """The colours that a pixel blends: RGB in [0, 1], not multiplied by alpha."""

    trusted: Float[Tensor, "pixel 3"]
    """The mean of the cameras on the surface, weighted by trust."""
    single: Float[Tensor, "pixel 3"]
    """The colour of the most trusted camera."""
    soft: Float[Tensor, "pixel 3"]
    """The mean over all depth hypotheses, interpolated between cells."""
    guess: Float[Tensor, "pixel 3"]
    """The rendered view, or the coarse guess in holes."""
    soft_mask: Float[Tensor, "pixel 1"]
    """The mean mask, interpolated as `soft` is; an input of the last convolutions."""

    def stacked(self) -> Float[Tensor, "pixel 4 3"]:
        """The colours, in the order of their scores."""
        return torch.stack([self.trusted, self.single, self.soft, self.guess], 1)


class ViewSynthNet(Network):
    """Predicts colour, alpha, confidence and depth of pixels on the proxy and the rim around it."""

    config: ViewsConfig  # pyright: ignore
    trained_in_bfloat16 = True
    error_rule = "all"
    """The whole subject is predicted: the model learned to keep the pixels that are already correct."""
    predicts_depth = True

    def __init__(self, config: ViewsConfig | None = None) -> None:
        super().__init__()
        config = config or ViewsConfig()
        self.config = config  # pyright: ignore[reportIncompatibleVariableOverride]

        # The first guess for holes, and the predictor of errors
        self.coarse = None
        if config.coarse_fill == "rays":
            self.coarse = RayFill(RaysConfig(num_views=config.num_views)).requires_grad_(False)
        self.errors = ErrorPredictor(config.error_features) if config.error_features else None
        self.predicts_errors = self.errors is not None

        # Depth, at half the resolution
        self.sample_aggregator = SampleAggregator(config.width, config.sample_channels)
        self.unet = UNet(len(OFFSETS) * config.sample_channels + CELL_CHANNELS, config.features)
        self.depth_logits = nn.Conv2d(config.features, len(OFFSETS), 1)

        # Blending, at full resolution
        self.pixel_aggregator = SampleAggregator(config.width, config.sample_channels)
        inputs = config.features + PIXEL_CHANNELS + config.sample_channels
        fine = config.fine_features
        last = nn.Conv2d(fine, sum(OUTPUT_CHANNELS), 3, padding=1)

        # All gains of detail begin at 0, except that of the blended colours in the finest band
        all_gains = slice(-NUM_GAINS, None)
        finest_blended = -NUM_GAINS
        with torch.no_grad():
            assert last.bias is not None
            last.weight[all_gains] = 0
            last.bias[all_gains] = 0
            last.bias[finest_blended] = INITIAL_GAIN
        self.blending = nn.Sequential(
            nn.Conv2d(inputs, fine, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(fine, fine, 3, padding=1),
            nn.ReLU(),
            last,
        )

    def forward(
        self,
        view: IncompleteView,
        sources: SourceCameras,
        scale: SceneScale | None = None,
        where: Mask | None = None,
        guess: Image | None = None,
        allow_large_cells: bool = False,
    ) -> ViewPrediction:
        """Predicts pixels of a view. `where` selects them; the view's error mask E is ignored.

        Args:
            view: the rendered view, or a crop of it.
            sources: the cameras to sample.
            scale: the scale of the whole view, if `view` is a crop.
            where: pixels outside this mask are not predicted; None predicts the whole proxy and its rim.
            guess: the `coarse_guess` of the whole view, cropped as `view` is; computed if None.
            allow_large_cells: whether the cells of a magnified view are larger (`LARGE_CELLS_FROM`).
                Those of training and of exported models are not.
        """
        if guess is None:
            guess = self.coarse_guess(view, sources)
        if scale is None:
            scale = SceneScale.of(view)
        view = replace(view, depth=rim_depth(view.depth))
        on_proxy = view.depth > 0
        predicted = on_proxy if where is None else where & on_proxy
        image = ViewImage.of(view, guess, predicted)
        if allow_large_cells and sources.magnification(view.camera, scale) >= LARGE_CELLS_FROM:
            half_view, half_predicted, half_image = halve(view, predicted, image)
            distribution = self._depth_distribution(half_view, sources, scale, half_predicted, half_image)
            distribution = distribution._replace(cell_px=2 * CELL_PX)
        else:
            distribution = self._depth_distribution(view, sources, scale, predicted, image)
        return self._blend(view, sources, scale, torch.nonzero(predicted), image, distribution)

    @torch.no_grad()
    def coarse_guess(self, view: IncompleteView, sources: SourceCameras | None, quick: bool = False) -> Image:
        """The whole view with its holes filled by the coarse fill; `quick` fills them from their surroundings only."""
        if quick or self.coarse is None:
            return fill(view.rgb, view.holes, view.mask > 0)
        return self.coarse(replace(view, error=view.holes.to(view.error)), sources).float()

    def source_names(self, view: IncompleteView) -> tuple[str, ...]:
        """Names of the cameras that rays are sampled in, the closest first."""
        return view.closest_views(self.config.num_views)

    @torch.no_grad()
    @one_thread()
    def predict_errors(self, view: IncompleteView, context: ContextProvider) -> ErrorMap | None:
        """The predicted errors of a rendered view; None without an `ErrorPredictor` or cameras."""
        if self.errors is None:
            return None
        sources = SourceCameras.closest_to(view, context, self.config.num_views)
        if sources is None:
            return None
        return self.errors.predict(view, sources, context.quality)

    @torch.no_grad()
    @one_thread()
    def predict_depth(self, view: IncompleteView, context: ContextProvider) -> DepthMap | None:
        """The depth of the subject on the proxy and its rim, by the first half of the network: no colour is blended."""
        sources = SourceCameras.closest_to(view, context, self.config.num_views)
        if sources is None:
            return None
        guess = self.coarse_guess(view, sources, quick=True)
        scale = SceneScale.of(view)
        view = replace(view, depth=rim_depth(view.depth))
        predicted = view.depth > 0
        distribution = self._depth_distribution(
            view, sources, scale, predicted, ViewImage.of(view, guess, predicted)
        )
        pixels = torch.nonzero(predicted)
        surface = surface_points(view.depth, scale, pixels, distribution)
        found = torch.stack([surface.depth, surface.probability], 1)
        depth, confidence = scatter_to_image(found, pixels, view.mask.shape)
        return DepthMap(depth, confidence)

    def encode_cameras(self, views: ContextViews, context: ContextProvider) -> None:
        """Computes the image pyramids of these cameras."""
        SourceCameras.of(views, None, context)

    def crop_margin_px(self, quality: RenderQuality) -> int:
        """See `Inpainter.crop_margin_px`."""
        return MARGIN_PX

    @torch.no_grad()
    @one_thread()
    def step(
        self, view: IncompleteView, context: ContextProvider, state: State
    ) -> tuple[CompletedView, State]:
        """Predicts the pixels with E > 0 on the proxy and its rim.

        Pixels that `view.fade` marks as background are not predicted but attenuated. With a
        `RenderQuality.refine_fraction` of 0 nothing is predicted: holes are filled from their
        surroundings. Predictions are steadied by the viewer's last view, which is `state`.
        """
        fraction = context.quality.refine_fraction
        where = view.refine_mask & (rim_depth(view.depth) > 0)
        fades = torch.zeros_like(where) if view.fade is None else view.fade > 0

        # At the lowest quality, holes are filled without the cameras
        if fraction == 0 and bool((where | fades).any()):
            return fallback_view(view, fades, self.coarse_guess(view, None, quick=True)), state

        # Without a pixel to predict, or without a camera, the view is only attenuated
        sources = None
        if bool(where.any()):
            sources = SourceCameras.closest_to(view, context, self.config.num_views)
        if sources is None and view.fade is None:
            return CompletedView(view, view.rgb), state
        if sources is None:
            return fallback_view(view, fades), state

        # Otherwise, the subject or a part of it is predicted
        reduced_quality = fraction is not None
        guess = self.coarse_guess(view, sources, quick=reduced_quality)
        ray_fill = None if self.coarse is None or reduced_quality else guess
        prediction = self(view, sources, where=where, guess=guess, allow_large_cells=True)
        completed = prediction.composite_into(view, where, fades, ray_fill)
        completed, last = steady(completed, where, state)
        return opaque_in_mask(completed), last

    def _depth_distribution(
        self,
        view: IncompleteView,
        sources: SourceCameras,
        scale: SceneScale,
        predicted: Mask,
        image: ViewImage,
    ) -> DepthDistribution:
        """Samples the cameras on the rays of all cells, and judges the samples by a U-Net over the view."""
        # Cells with a pixel to predict, and the cameras and depth hypotheses of their rays
        predicted_depth = nearest_depth(view.depth * predicted)
        cells = torch.nonzero(predicted_depth > 0)
        rows, columns = cells.unbind(1)
        proxy_z = predicted_depth[rows, columns][:, None]
        uv_px = CELL_PX * (cells.flip(1).double() + 0.5)
        choosing_z = proxy_z + scale.size_m * proxy_z.new_tensor(CHOOSING_OFFSETS)
        cameras = choose_cameras(Rays(view, scale, uv_px, choosing_z), sources, RAY_VIEWS)
        rays = Rays(view, scale, uv_px, proxy_z + scale.size_m * proxy_z.new_tensor(OFFSETS), cameras)

        # Further inputs of the U-Net, in all cells: the rendered view, and the depth of the proxy
        proxy_depth = nearest_depth(view.depth)
        on_proxy = proxy_depth > 0
        relative = torch.where(on_proxy, ((proxy_depth - scale.depth_m) / scale.size_m).tanh(), 0.0)
        means = cell_means(image.stacked())
        cell_channels = torch.cat([means, relative[None], on_proxy[None].to(means)])

        # Scores of the hypotheses: one from each sample alone, and one from its neighbourhood
        with self.autocast():
            samples = self._aggregate(rays, sources)
            inputs = samples.features.flatten(1).to(self.compute_dtype)
            stop_if_cancelled()
            with all_threads():
                features = self.unet.forward_points(
                    inputs, cells, concatenate_channels(cell_channels.to(inputs))
                )
            logits = self.depth_logits(features)[0, :, rows, columns].T.float() + samples.score.float()
        cell_index = index_image(cells, predicted_depth.shape)
        return DepthDistribution(cells, cell_index, predicted_depth, logits, samples, cameras, features)

    def _aggregate(self, rays: Rays, sources: SourceCameras) -> AggregatedSamples:
        """The aggregated samples of the rays of cells, computed in chunks."""
        parts = []
        for chunk in rays.split(sources.rays_at_once):
            stop_if_cancelled()
            samples = sample_rays(chunk, sources, step_px=float(CELL_PX))
            parts.append(self.sample_aggregator(samples))
        return AggregatedSamples(*map(torch.cat, zip(*parts, strict=True)))

    def _blend(
        self,
        view: IncompleteView,
        sources: SourceCameras,
        scale: SceneScale,
        pixels: Pixels,
        image: ViewImage,
        distribution: DepthDistribution,
    ) -> ViewPrediction:
        """Samples the cameras on the surface that each pixel shows, and blends them."""
        # Sample the cameras at the depth found: each pixel's ray has one sample, with index 0
        stop_if_cancelled()
        surface = surface_points(view.depth, scale, pixels, distribution)
        cameras = None if distribution.cameras is None else distribution.cameras[surface.cell]
        rays = Rays(view, scale, pixels.flip(1).double() + 0.5, surface.depth.detach()[:, None], cameras)
        samples = sample_rays(rays, sources, step_px=1.0, cubic=True)

        # Weigh the cameras
        stop_if_cancelled()
        aggregated = self._aggregate_pixels(samples, surface, distribution)
        mask = aggregated.mask[:, 0]

        # Score the candidate colours and the gains of detail by the last convolutions
        colours = candidate_colours(samples.features[:, 0], aggregated, image, pixels, distribution)
        statistics = RayStatistics.unstack(samples.statistics[:, 0])
        inputs = pixel_inputs(colours, mask, statistics, surface, image, pixels)
        inputs = torch.cat([inputs, aggregated.features[:, 0]], 1)
        out = self._blending_layers(inputs, pixels, view.mask.shape, features_at_cells(distribution, view))
        scores, alpha_logit, confidence_logit, gains = out.split(OUTPUT_CHANNELS, 1)

        # Blend the colours, then add detail
        blended = (scores.softmax(1)[..., None] * colours.stacked()).sum(1)
        detailed = torch.stack([blended, colours.single, colours.guess], 1)
        magnification = sources.magnification(view.camera, scale)
        detail = amplify_detail(detailed, mask[:, 0], gains, pixels, view.mask.shape, magnification)

        # Composite on black
        alpha = (alpha_logit[:, 0] + ALPHA_SLOPE * (mask[:, 0] - 0.5)).sigmoid()
        rgb = alpha[:, None] * (blended + detail).clamp(0, 1)
        return ViewPrediction(
            pixels,
            rgb,
            alpha,
            confidence_logit[:, 0].sigmoid(),
            surface.depth,
            aggregated.trust[:, 0],
            distribution,
        )

    def _aggregate_pixels(
        self, samples: RaySamples, surface: SurfacePoints, distribution: DepthDistribution
    ) -> AggregatedSamples:
        """Weighs the cameras at each pixel, starting from the weights that its cell gave them."""
        prior = distribution.samples.trust[surface.cell, surface.hypothesis]
        with self.autocast():
            return self.pixel_aggregator(samples, prior[:, None])

    def _blending_layers(
        self,
        inputs: Float[Tensor, "pixel input"],
        pixels: Pixels,
        shape: torch.Size,
        features: Float[Tensor, "1 feature rows columns"],
    ) -> Float[Tensor, "pixel output"]:
        """The last convolutions, at these pixels of an image of this shape."""
        with self.autocast(), all_threads():
            if inputs.device.type == "cpu" and not torch.is_grad_enabled():
                return run_tiled(self.blending, features, inputs.to(features), pixels, shape).float()
            upsampled = F.interpolate(features, scale_factor=CELL_PX, mode="bilinear", align_corners=False)
            near = crop_to(upsampled[0], shape)
            out = self.blending(concatenate_channels(near, scatter_to_image(inputs.to(near), pixels, shape)))
        rows, columns = pixels.unbind(1)
        return out[0, :, rows, columns].T.float()


def halve(
    view: IncompleteView, predicted: Mask, image: ViewImage
) -> tuple[IncompleteView, Bool[Tensor, "rows columns"], ViewImage]:
    """A view at half its resolution, with its pixels to predict and its inputs: its cells are twice as large."""
    half_predicted = nearest_depth(view.depth * predicted) > 0
    guess = downsample2x(replace(view, rgb=image.guess)).rgb
    half_view = downsample2x(view)
    return half_view, half_predicted, ViewImage.of(half_view, guess, half_predicted)


def features_at_cells(
    distribution: DepthDistribution, view: IncompleteView
) -> Float[Tensor, "1 feature rows columns"]:
    """The U-Net's features in a view's cells of `CELL_PX`, between larger cells bilinearly."""
    larger = distribution.cell_px // CELL_PX
    if larger == 1:
        return distribution.features
    fine = F.interpolate(distribution.features, scale_factor=larger, mode="bilinear", align_corners=False)
    rows, columns = (-(-length // CELL_PX) for length in view.mask.shape)
    return fine[:, :, :rows, :columns]


def amplify_detail(
    colours: Float[Tensor, "pixel image 3"],
    mask: Float[Tensor, "pixel"],
    gains: Float[Tensor, "pixel gain"],
    pixels: Pixels,
    shape: torch.Size,
    magnification: float | Float[Tensor, ""],
) -> Float[Tensor, "pixel 3"]:
    """The detail of these images: their bands times the gains, summed over bands and images.

    Detail is the difference from a local mean, in which pixels are weighted by `mask`.
    """
    bands = detail_bands(colours, mask.clamp_min(MIN_DETAIL_WEIGHT), pixels, shape, magnification)
    gain_of_image = gains.unflatten(1, bands.shape[1:3])[..., None]  # [pixel, band, image, 1]
    return (gain_of_image * bands).sum((1, 2))


def candidate_colours(
    features: Float[Tensor, "pixel view feature"],
    aggregated: AggregatedSamples,
    image: ViewImage,
    pixels: Pixels,
    distribution: DepthDistribution,
) -> CandidateColours:
    """The colours that each pixel may have.

    Args:
        features: what every camera shows of each pixel's sample on the surface.
        aggregated: these samples after aggregation over cameras.
        image: the rendered view.
        pixels: row and column of each pixel.
        distribution: the depth hypotheses of the cells.
    """
    # On the surface: all cameras by their trust, and the most trusted one alone
    trusted = unpremultiply(aggregated.colour[:, 0], aggregated.mask[:, 0])
    best = aggregated.trust[:, 0].argmax(1)
    best_features = features.gather(1, best[:, None, None].expand(-1, 1, FEATURES))[:, 0]
    single = unpremultiply(best_features[:, COLOUR], best_features[:, MASK])

    # On the whole ray: the mean over depth hypotheses
    probability = distribution.logits.softmax(1)[..., None]
    mean_colour = (probability * distribution.samples.colour).sum(1)
    mean_mask = (probability * distribution.samples.mask).sum(1)
    means = distribution.interpolate(torch.cat([mean_colour, mean_mask], 1), pixels)
    soft_colour, soft_mask = means.split((3, 1), 1)
    soft = unpremultiply(soft_colour, soft_mask)

    rows, columns = pixels.unbind(1)
    return CandidateColours(trusted, single, soft, image.guess[:, rows, columns].T, soft_mask)


def pixel_inputs(
    colours: CandidateColours,
    mask: Float[Tensor, "pixel 1"],
    statistics: RayStatistics,
    surface: SurfacePoints,
    image: ViewImage,
    pixels: Pixels,
) -> Float[Tensor, "pixel 27"]:
    """Colours, masks and statistics of each pixel: inputs of the last convolutions.

    Their order is that of the shipped weights. `mask` is the cameras' mean mask on the surface, and
    `statistics` are those of the sample there.
    """
    rows, columns = pixels.unbind(1)
    inputs = [
        colours.trusted,
        colours.single,
        colours.soft,
        colours.guess,
        colours.trusted - colours.guess,
        mask,
        colours.soft_mask,
        image.coloured[rows, columns][:, None],
        image.largest_weight[rows, columns][:, None],
        statistics.colour_variance.mean(1, keepdim=True),
        statistics.smallest_masks,
        surface.probability[:, None],
        (colours.trusted - colours.single).abs().mean(1, keepdim=True),
        surface.offset[:, None],
    ]
    return torch.cat(inputs, 1)
