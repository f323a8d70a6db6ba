"""The default model: re-synthesises the whole subject from the source cameras, with alpha, confidence and depth.

    source cameras -> ray samples -> aggregation -> depth distribution -> blending -> prediction

At half the resolution, each cell of 2 x 2 pixels has one ray, with samples at fixed offsets, from just
in front of the proxy (the surface of the visual hull) to well behind it. The source cameras that see
a ray best are sampled there and aggregated. A U-Net over the view turns the samples into a
distribution over depths, as networks on cost volumes do (MVSNet, ENeRF).

At full resolution, the cameras are sampled again at the depth found, and their colours are blended.
Blending softens the image, so detail is added in two frequency bands: the detail of the blended
colours, of the most trusted camera and of the rendered view, each times a gain that the network
predicts for every pixel.
"""

import math
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from viewmend.geometry.threads import all_threads, one_thread
from viewmend.models.base import ContextProvider, DepthMap, ErrorMap, RenderQuality, State
from viewmend.models.compositing import opaque_in_mask
from viewmend.models.network import Network
from viewmend.models.smooth_fill import fill
from viewmend.models.views.aggregation import AggregatedSamples, SampleAggregator
from viewmend.models.views.config import (
    OFFSETS,
    RAY_VIEWS,
    RGBA,
    RaysConfig,
    ViewsConfig,
)
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
    HypothesisMeans,
    SurfacePoints,
    ViewPrediction,
    surface_points,
    unpremultiply,
)
from viewmend.models.views.pyramids import SceneScale, SourceCameras
from viewmend.models.views.ray_fill import RayFill
from viewmend.models.views.sampler import CameraChoice, Rays, RaySamples, RayStatistics, sample_rays
from viewmend.models.views.steadying import steady
from viewmend.types import CompletedView, ContextViews, IncompleteView
from viewmend.utils.cancellation import stop_if_cancelled
from viewmend.utils.tensors import nonzero_of

Mask = Bool[Tensor, "height width"]
Image = Float[Tensor, "3 height width"]
IMAGE_CHANNELS = 7
"""`ViewImage` has this many channels."""
CHOOSING_SAMPLES = tuple(OFFSETS.index(offset) for offset in (0.0, 0.053, 0.19))
"""Indices of three samples of a ray: on the proxy, and 0.053 and 0.19 subject sizes behind it (`OFFSETS`). The
cameras that see these three best are sampled along the whole ray."""
CELL_CHANNELS = IMAGE_CHANNELS + 2
"""The U-Net gets this many channels of a cell, apart from its ray samples: those of `ViewImage`, the depth
of the proxy relative to the subject's median depth, and whether the proxy or its rim covers the cell."""
NUM_CANDIDATES = 4
"""A pixel blends this many colours: those in `CandidateColours`."""
NUM_GAINS = 3 * len(BAND_PX)
"""A pixel's detail is multiplied by this many gains: three per band, for the blended colours, the
most trusted camera and the rendered view."""
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
"""A crop with a margin of this many pixels around the subject gives nearly the same prediction as the whole view."""


class ViewImage(NamedTuple):
    """The rendered view, as an input of the network."""

    filled: Image
    """RGB on black, with holes filled by `ViewSynthNet.fill_holes`."""
    mask: Float[Tensor, "height width"]
    """M: 1 where the proxy covers the pixel."""
    coloured: Float[Tensor, "height width"]
    """1 where a source camera coloured the pixel."""
    largest_weight: Float[Tensor, "height width"]
    """The largest weight of a source camera in the pixel's colour."""
    predicted: Float[Tensor, "height width"]
    """1 where the pixel is to be predicted."""

    @classmethod
    def of(cls, view: IncompleteView, filled: Image, predicted: Mask) -> "ViewImage":
        """The channels of a rendered view, given its image with filled holes and its pixels to predict."""
        return cls(filled, view.mask, view.coloured.float(), view.weights.amax(0), predicted.float())

    def stacked(self) -> Float[Tensor, "7 height width"]:
        """All channels in one image."""
        planes = [self.mask, self.coloured, self.largest_weight, self.predicted]
        return torch.cat([self.filled, *(plane[None] for plane in planes)])


class CandidateColours(NamedTuple):
    """The colours that a pixel blends: RGB in [0, 1], not multiplied by alpha."""

    trusted: Float[Tensor, "pixel 3"]
    """The mean of the cameras on the surface, weighted by trust."""
    single: Float[Tensor, "pixel 3"]
    """The colour of the most trusted camera."""
    soft: Float[Tensor, "pixel 3"]
    """The mean over all depth hypotheses, interpolated between cells."""
    rendered: Float[Tensor, "pixel 3"]
    """The rendered view, with holes filled by `ViewSynthNet.fill_holes`."""

    @classmethod
    def unstack(cls, stacked: Float[Tensor, "pixel 4 3"]) -> "CandidateColours":
        """The fields, from all candidates in one tensor. The network scores them in the order of the fields."""
        return cls(*stacked.unbind(1))


class CellInputs(NamedTuple):
    """The inputs of the depth distribution."""

    view: IncompleteView
    """The rendered view, with depth on the rim, too."""
    predicted: Mask
    """Its pixels to predict."""
    image: ViewImage
    """Its channels as inputs of the network."""


class CellDepth(NamedTuple):
    """The nearest z-depth in each cell, metres; 0 in cells without depth."""

    predicted: Float[Tensor, "rows columns"]
    """The nearest among the pixels to predict."""
    all_pixels: Float[Tensor, "rows columns"]
    """The nearest among all pixels of the proxy and its rim."""


class ViewSynthNet(Network):
    """Predicts colour, alpha, confidence and depth of pixels on the proxy and its rim.

    The rim is a band of few pixels around the proxy that the subject may also cover (`geometry.rim`).
    """

    config: ViewsConfig
    trained_in_bfloat16 = True
    error_rule = "all"
    """The default error mask selects the whole subject: the model learned to keep pixels that are already correct."""
    predicts_depth = True

    def __init__(self, config: ViewsConfig | None = None) -> None:
        super().__init__()
        config = config or ViewsConfig()
        self.config = config

        # The coarse fill of holes, and the predictor of errors
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

        # All gains of detail begin at 0, except the first: that of the blended colours in the finest band
        with torch.no_grad():
            assert last.bias is not None
            gain_biases = last.bias[-NUM_GAINS:]
            gain_biases[:] = 0
            gain_biases[0] = INITIAL_GAIN
            last.weight[-NUM_GAINS:] = 0
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
        filled: Image | None = None,
        allow_large_cells: bool = False,
    ) -> ViewPrediction:
        """Predicts the pixels of a view that `where` selects. `step` derives it from the error mask E.

        Args:
            view: the rendered view, or a crop of it.
            sources: the cameras to sample.
            scale: size and depth of the subject in the whole view, if `view` is a crop; computed if None.
            where: pixels outside this mask are not predicted; None predicts the whole proxy and its rim.
            filled: the result of `fill_holes` for the whole view, cropped as `view` is; computed if None.
            allow_large_cells: whether cells are larger in a view that magnifies the cameras' images
                (`LARGE_CELLS_FROM`). Training and exported models do not use them.
        """
        if scale is None:
            scale = SceneScale.of(view)
        if filled is None:
            filled = self.fill_holes(view, sources)
        with_rim = replace(view, depth=view.depth_with_rim)
        has_depth = with_rim.depth > 0
        predicted = has_depth if where is None else where & has_depth
        image = ViewImage.of(view, filled, predicted)

        # The depth distribution, in cells of 2 x 2 pixels. For large cells, the view is halved first, so that a
        # cell covers 4 x 4 pixels of the view itself
        large_cells = allow_large_cells and sources.magnification(view.camera, scale) >= LARGE_CELLS_FROM
        full_size = CellInputs(with_rim, predicted, image)
        inputs = halve(full_size) if large_cells else full_size
        cell_depth = depth_of_cells(inputs.view, inputs.predicted)
        pixels, cells = nonzero_of(predicted, cell_depth.predicted > 0)
        distribution = self._depth_distribution(inputs.view, inputs.image, sources, scale, cells, cell_depth)
        if large_cells:
            distribution = distribution._replace(cell_px=2 * CELL_PX)
        return self._blend(with_rim, sources, scale, pixels, image, distribution)

    @torch.no_grad()
    def fill_holes(
        self,
        view: IncompleteView,
        sources: SourceCameras | None,
        quick: bool = False,
        scale: SceneScale | None = None,
    ) -> Image:
        """The image of the whole view, with holes filled coarsely.

        `RayFill` fills them from the cameras. If `quick`, or if the model has no `RayFill`, they are
        filled from the pixels around them. `scale` is that of the view; it is computed if None.
        """
        if quick or self.coarse is None:
            return fill(view.rgb, view.holes, view.mask > 0)
        only_holes = replace(view, error=view.holes.to(view.error))  # `RayFill` fills where E > 0
        return self.coarse(only_holes, sources, scale).float()

    def source_names(self, view: IncompleteView) -> tuple[str, ...]:
        """Names of the source cameras that are sampled for a view, the closest first."""
        return view.closest_views(self.config.num_views)

    @torch.no_grad()
    @one_thread()
    def predict_errors(self, view: IncompleteView, context: ContextProvider) -> ErrorMap | None:
        """The predicted errors of a rendered view; None if the model has no `ErrorPredictor` or no camera is used."""
        if self.errors is None:
            return None
        sources = SourceCameras.closest_to(view, context, self.config.num_views)
        if sources is None:
            return None
        return self.errors.predict(view, sources, context.quality)

    @torch.no_grad()
    @one_thread()
    def predict_depth(self, view: IncompleteView, context: ContextProvider) -> DepthMap | None:
        """The depth of the subject on the proxy and its rim. Runs the network up to the depth distribution."""
        sources = SourceCameras.closest_to(view, context, self.config.num_views)
        if sources is None:
            return None
        filled = self.fill_holes(view, sources, quick=True)
        scale = SceneScale.of(view)
        with_rim = replace(view, depth=view.depth_with_rim)
        predicted = with_rim.depth > 0
        image = ViewImage.of(view, filled, predicted)
        cell_depth = depth_of_cells(with_rim, predicted)
        pixels, cells = nonzero_of(predicted, cell_depth.predicted > 0)
        distribution = self._depth_distribution(with_rim, image, sources, scale, cells, cell_depth)
        probability = distribution.interpolate(distribution.logits.softmax(1), pixels)
        surface = surface_points(with_rim.depth, scale, pixels, distribution, probability)
        found = torch.stack([surface.depth, surface.probability], 1)
        depth, confidence = scatter_to_image(found, pixels, view.mask.shape)
        return DepthMap(depth, confidence)

    def encode_cameras(self, views: ContextViews, context: ContextProvider) -> None:
        """Computes the image pyramids of these cameras, which `context` keeps for later views."""
        SourceCameras.of(views, silhouettes=None, context=context)  # `context` keeps what this computes

    def crop_margin_px(self, quality: RenderQuality) -> int:
        """See `Inpainter.crop_margin_px`."""
        return MARGIN_PX

    @torch.no_grad()
    @one_thread()
    def step(
        self, view: IncompleteView, context: ContextProvider, state: State
    ) -> tuple[CompletedView, State]:
        """Predicts the pixels of the proxy and its rim that the error mask selects (E > 0).

        Pixels that `view.fade` marks as background are not predicted but attenuated. With a
        `RenderQuality.refine_fraction` of 0 nothing is predicted: holes are filled from their
        surroundings. To reduce flicker, small differences from the viewer's last view (`state`) are
        partly undone (`steadying`). Small operations run on one thread, which is faster; convolutions
        use all.
        """
        fraction = context.quality.refine_fraction
        where = view.refine_mask & (view.depth_with_rim > 0)
        faded = torch.zeros_like(where) if view.fade is None else view.fade > 0

        # At the lowest quality, `where` contains only holes. They are filled from the pixels around them, and faded
        # pixels are attenuated
        if fraction == 0 and bool((where | faded).any()):
            return fallback_view(view, faded, self.fill_holes(view, None, quick=True)), state

        # Without a pixel to predict, or without a camera, faded pixels are attenuated, and all others stay
        sources = None
        scale, count = SceneScale.with_count(view, where)
        if count:
            sources = SourceCameras.closest_to(view, context, self.config.num_views)
        if sources is None:
            completed = CompletedView(view, view.rgb) if view.fade is None else fallback_view(view, faded)
            return completed, state

        # Otherwise, `where` is predicted. At reduced quality, E and hence `where` are already limited to a
        # fraction of the subject
        reduced_quality = fraction is not None
        filled = self.fill_holes(view, sources, quick=reduced_quality, scale=scale)
        prediction = self(view, sources, scale, where=where, filled=filled, allow_large_cells=True)

        # In holes, the prediction is blended with the coarse fill, if `RayFill` has made it
        used_ray_fill = self.coarse is not None and not reduced_quality
        completed = prediction.composite_into(view, where, faded, filled if used_ray_fill else None)
        steadied, new_state = steady(completed, where, state, float(scale.depth_m))
        return opaque_in_mask(steadied), new_state

    def _depth_distribution(
        self,
        view: IncompleteView,
        image: ViewImage,
        sources: SourceCameras,
        scale: SceneScale,
        cells: Pixels,
        cell_depth: CellDepth,
    ) -> DepthDistribution:
        """Samples the cameras on the rays of `cells`, those with a pixel to predict, and scores the samples.

        `view` has depth on the rim, too; `cell_depth` is its `depth_of_cells`.
        """
        # The depth hypotheses of the cells' rays
        rows, columns = cells.unbind(1)
        z_m = scale.depths_behind(cell_depth.predicted[rows, columns], OFFSETS)
        rays = Rays(view, scale, cells, z_m, cell_px=CELL_PX)

        # Further inputs of the U-Net: the rendered view and the depth, also in cells without a pixel to predict
        depth = cell_depth.all_pixels
        has_depth = depth > 0
        relative = ((depth - scale.depth_m) / scale.size_m).tanh() * has_depth
        means = cell_means(image.stacked())
        cell_channels = concatenate_channels(means, relative[None], has_depth[None].to(means))

        # A hypothesis has two scores, which are summed: one from its sample alone, one from the U-Net
        with self.autocast():
            samples, cameras = self._aggregate(rays, sources)
            inputs = samples.features.flatten(1).to(self.compute_dtype)
            stop_if_cancelled()
            with all_threads():
                features = self.unet.forward_points(inputs, cells, cell_channels.to(inputs))
            logits = self.depth_logits(features)[0][:, rows, columns].T.float() + samples.score.float()
        cell_index = index_image(cells, depth.shape)
        return DepthDistribution(cells, cell_index, cell_depth.predicted, logits, samples, cameras, features)

    def _aggregate(
        self, rays: Rays, sources: SourceCameras
    ) -> tuple[AggregatedSamples, Int[Tensor, "cell view"] | None]:
        """The aggregated samples of the rays of cells, and the cameras chosen for each; computed in chunks."""
        parts = []
        chosen: list[Int[Tensor, "cell view"]] = []
        for chunk in rays.split(sources.rays_at_once):
            stop_if_cancelled()
            choice = CameraChoice(CHOOSING_SAMPLES, RAY_VIEWS)
            samples = sample_rays(chunk, sources, step_px=float(CELL_PX), choice=choice)
            parts.append(self.sample_aggregator(samples))
            if samples.cameras is not None:
                chosen.append(samples.cameras)
        aggregated = AggregatedSamples.cat(parts)
        if not chosen:  # all rays are sampled in all cameras
            return aggregated, None
        return aggregated, torch.cat(chosen) if len(chosen) > 1 else chosen[0]

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
        # Sample the cameras at the depth found: each pixel's ray has one sample, which is [:, 0] below
        stop_if_cancelled()
        means = HypothesisMeans.of(distribution, pixels)
        surface = surface_points(view.depth, scale, pixels, distribution, means.probability)
        rays = surface_rays(view, scale, pixels, surface, distribution)
        samples = sample_rays(rays, sources, step_px=1.0, cubic=True)

        # Weigh the cameras
        stop_if_cancelled()
        aggregated = self._aggregate_pixels(samples, surface, distribution)
        mask = aggregated.rgba[:, 0, 3]

        # The last convolutions score the candidate colours, and predict alpha, confidence and gains
        candidates = candidate_colours(samples.features[:, 0], aggregated, means, image, pixels)
        statistics = RayStatistics.unstack(samples.statistics[:, 0])
        inputs = pixel_inputs(candidates, mask, means.rgba[:, 3:], statistics, surface, image, pixels)
        inputs = torch.cat([inputs, aggregated.features[:, 0]], 1)
        out = self._blending_layers(inputs, pixels, view.mask.shape, features_at_cells(distribution, view))
        scores, alpha_logit, confidence_logit, gains = out.split(OUTPUT_CHANNELS, 1)

        # Blend the colours: per pixel, (1, 4) weights @ (4, 3) colours
        blended = (scores.softmax(1)[:, None] @ candidates)[:, 0]

        # Add detail
        detail_sources = sources_of_detail(blended, candidates)
        magnification = sources.magnification(view.camera, scale)
        detail = amplify_detail(detail_sources, mask, gains, pixels, view.mask.shape, magnification)

        # Composite on black
        alpha = (alpha_logit[:, 0] + ALPHA_SLOPE * (mask - 0.5)).sigmoid()
        rgb = alpha[:, None] * (blended + detail).clamp(0, 1)
        return ViewPrediction(
            pixels=pixels,
            rgb=rgb,
            alpha=alpha,
            confidence=confidence_logit[:, 0].sigmoid(),
            depth=surface.depth,
            trust=aggregated.trust[:, 0],
            distribution=distribution,
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
        """Applies the last convolutions to an image of this height and width; returns their output at `pixels`."""
        with self.autocast(), all_threads():
            # Inference on a CPU leaves out the parts of the image that contain none of the pixels
            if inputs.device.type == "cpu" and not torch.is_grad_enabled():
                return run_tiled(self.blending, features, inputs.to(features), pixels, shape).float()

            upsampled = F.interpolate(features, scale_factor=CELL_PX, mode="bilinear", align_corners=False)
            feature_image = crop_to(upsampled[0], shape)
            input_image = scatter_to_image(inputs.to(feature_image), pixels, shape)
            out = self.blending(concatenate_channels(feature_image, input_image))
        rows, columns = pixels.unbind(1)
        return out[0][:, rows, columns].T.float()


def depth_of_cells(view: IncompleteView, predicted: Mask) -> CellDepth:
    """The depth of each cell of a view, given its pixels to predict."""
    return CellDepth(*nearest_depth(torch.stack([view.depth * predicted, view.depth])))


def halve(inputs: CellInputs) -> CellInputs:
    """The inputs at half the resolution. One of their cells covers 4 x 4 pixels of the full resolution."""
    # Depths of pixels that are not predicted become 0, and `nearest_depth` ignores zeros. So the nearest depth of
    # four pixels is above 0 if any of them is predicted
    predicted = nearest_depth(inputs.view.depth * inputs.predicted) > 0
    filled = downsample2x(replace(inputs.view, rgb=inputs.image.filled)).rgb
    view = downsample2x(inputs.view)
    return CellInputs(view, predicted, ViewImage.of(view, filled, predicted))


def surface_rays(
    view: IncompleteView,
    scale: SceneScale,
    pixels: Pixels,
    surface: SurfacePoints,
    distribution: DepthDistribution,
) -> Rays:
    """The rays of some pixels, each with one sample on the surface and the cameras of the pixel's cell."""
    cameras = None if distribution.cameras is None else distribution.cameras[surface.cell]
    return Rays(view, scale, pixels, surface.depth.detach()[:, None], cameras)


def features_at_cells(
    distribution: DepthDistribution, view: IncompleteView
) -> Float[Tensor, "1 feature rows columns"]:
    """The U-Net's features in cells of `CELL_PX`; those of larger cells are interpolated bilinearly."""
    factor = distribution.cell_px // CELL_PX
    if factor == 1:
        return distribution.features
    fine = F.interpolate(distribution.features, scale_factor=factor, mode="bilinear", align_corners=False)
    rows, columns = (math.ceil(length / CELL_PX) for length in view.mask.shape)
    return fine[:, :, :rows, :columns]


def sources_of_detail(
    blended: Float[Tensor, "pixel 3"], candidates: Float[Tensor, "pixel 4 3"]
) -> Float[Tensor, "pixel 3 3"]:
    """The colours whose detail is added: blended, of the most trusted camera, and of the rendered view."""
    colours = CandidateColours.unstack(candidates)
    return torch.stack([blended, colours.single, colours.rendered], 1)


def amplify_detail(
    colours: Float[Tensor, "pixel image 3"],
    mask: Float[Tensor, "pixel"],
    gains: Float[Tensor, "pixel gain"],
    pixels: Pixels,
    shape: torch.Size,
    magnification: float | Float[Tensor, ""],
) -> Float[Tensor, "pixel 3"]:
    """The detail to add to some pixels: bands of several images, multiplied by gains and summed.

    Detail is the difference from a local mean, in which pixels are weighted by `mask`.

    Args:
        colours: the colour of each pixel in each image.
        mask: the cameras' mean mask at each pixel.
        gains: the gains of each pixel: those of all images for the first band, then for the second.
        pixels: row and column of each pixel.
        shape: height and width of the images.
        magnification: that of the images (`SourceCameras.magnification`).
    """
    bands = detail_bands(colours, mask.clamp_min(MIN_DETAIL_WEIGHT), pixels, shape, magnification)

    # The axes band and image become one, in the order of the gains: per pixel, (1, gain) @ (gain, 3)
    return (gains[:, None] @ bands.flatten(1, 2))[:, 0]


def candidate_colours(
    features: Float[Tensor, "pixel view feature"],
    aggregated: AggregatedSamples,
    means: HypothesisMeans,
    image: ViewImage,
    pixels: Pixels,
) -> Float[Tensor, "pixel 4 3"]:
    """The `CandidateColours` that each pixel may blend, stacked.

    Args:
        features: features of each pixel's sample on the surface, in each camera.
        aggregated: these samples after aggregation over cameras, one per pixel.
        means: the means over the depth hypotheses of each pixel's ray.
        image: the rendered view.
        pixels: row and column of each pixel.
    """
    best = aggregated.trust[:, 0].argmax(1)
    single = features[..., RGBA].gather(1, best[:, None, None].expand(-1, 1, 4))
    of_cameras = unpremultiply(torch.cat([aggregated.rgba, single, means.rgba[:, None]], 1))
    rows, columns = pixels.unbind(1)
    rendered = image.filled[:, rows, columns].T
    return torch.cat([of_cameras, rendered[:, None]], 1)


def pixel_inputs(
    candidates: Float[Tensor, "pixel 4 3"],
    mask: Float[Tensor, "pixel"],
    soft_mask: Float[Tensor, "pixel 1"],
    statistics: RayStatistics,
    surface: SurfacePoints,
    image: ViewImage,
    pixels: Pixels,
) -> Float[Tensor, "pixel 27"]:
    """Colours, masks and statistics of each pixel: inputs of the last convolutions.

    Trained weights depend on the order of these channels.

    Args:
        candidates: the candidate colours, stacked.
        mask: the cameras' mean mask on the surface.
        soft_mask: the mean mask over the depth hypotheses.
        statistics: how the cameras' colours and masks differ at the sample on the surface.
        surface: the points that the pixels show.
        image: the rendered view.
        pixels: row and column of each pixel.
    """
    rows, columns = pixels.unbind(1)
    colours = CandidateColours.unstack(candidates)
    inputs = [
        candidates.flatten(1),
        colours.trusted - colours.rendered,
        mask[:, None],
        soft_mask,
        image.coloured[rows, columns][:, None],
        image.largest_weight[rows, columns][:, None],
        statistics.colour_variance.mean(1, keepdim=True),
        statistics.smallest_masks,
        surface.probability[:, None],
        (colours.trusted - colours.single).abs().mean(1, keepdim=True),
        surface.offset[:, None],
    ]
    return torch.cat(inputs, 1)
