"""Fills holes pixel by pixel from the source cameras: the model `rays`, and a part of the default model.

The true surface in a hole is at the proxy or behind it, and cameras that see it agree on its
colour. So each missing pixel becomes a convex mix of candidates: the colours that the cameras have
at points along its ray, a smooth fill, and background. The network only weighs the candidates.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from viewmend.geometry.threads import all_threads, one_thread
from viewmend.models.base import ContextProvider
from viewmend.models.network import Network
from viewmend.models.smooth_fill import (
    MARGIN_PX,
    Fill,
    fill,
    fill_thin,
    fill_wide,
    pull_push,
    wide_holes,
)
from viewmend.models.views.box_sums import BoxSums
from viewmend.models.views.config import CONTRAST, RaysConfig
from viewmend.models.views.grid import Pixels
from viewmend.models.views.pyramids import SceneScale, SourceCameras
from viewmend.models.views.sampler import (
    CAMERA_CHANNELS,
    CameraFeatures,
    Rays,
    RaySamples,
    RayStatistics,
    box_side_px,
    sample_fill_rays,
)
from viewmend.types import IncompleteView
from viewmend.utils.cancellation import stop_if_cancelled
from viewmend.utils.tensors import counts_of

Image = Float[Tensor, "3 height width"]
Features = Float[Tensor, "pixel point view 14"]
"""`CameraFeatures`, stacked, of points on the rays of pixels."""
Window = Float[Tensor, "pixel 8 11 11"]
SmallestMasks = Float[Tensor, "pixel point 4"]
"""The two smallest masks of the rig at a point, and the two smallest averaged masks."""
OFFSETS = (-0.015, 0.0, 0.008, 0.016, 0.03, 0.055, 0.09, 0.15, 0.24, 0.36, 0.55)
"""A ray is sampled at these z-depths behind the proxy, in subject sizes."""
RADIUS_PX = 5
"""The window around a pixel has this radius, pixels."""
WINDOW_CHANNELS = 8
"""A window has this many channels: RGB, M and E of the view, and RGB of the smooth fill."""
CELLS = (0.03, 0.06)
"""A pixel's wider neighbourhood is averaged over square cells of these sides, in subject sizes."""
CELLS_AROUND = 5
"""A neighbourhood has this many cells to each side of its own."""
CELL_CHANNELS = 6
"""A cell has this many channels: RGB of the smooth fill, M, E and depth."""
COLOUR_CHANNELS = 7
"""Cameras that see a point agree about this many channels: colour, mean colour and mean coverage."""
POINT_FEATURES = 16
"""The network keeps this many features of each point of a ray."""
PIXELS_AT_ONCE = 512
"""A chunk without gradients has this many pixels: the system allocates larger buffers page by page
each time, which takes longer than the computation."""
GPU_PIXELS_AT_ONCE = 8192
"""A chunk without gradients has this many pixels on a GPU, where memory is the limit."""
PIXELS_STEP = 64
"""Layers run on multiples of this many pixels on the CPU. PyTorch compiles and keeps convolutions and GELUs
for each number of pixels; for all numbers, that would be slow, and fragment the memory of a server."""


class RayInputs(NamedTuple):
    """Inputs of the network for some missing pixels."""

    features: Features
    smallest_masks: SmallestMasks
    window: Window
    """The view around each pixel: RGB, M, E, and RGB of the smooth fill."""
    neighbourhoods: Float[Tensor, "neighbourhood 12 11 11"]
    """Means over the cells around each cell with a missing pixel: `CELL_CHANNELS` for each size in `CELLS`."""
    neighbourhood_index: Int[Tensor, "pixel"]
    """Index of each pixel's neighbourhood; pixels of one cell share it."""

    @staticmethod
    def cat(parts: Sequence["RayInputs"]) -> "RayInputs":
        """Concatenation over pixels; missing cameras are padded as out of view."""
        most = max(part.features.shape[2] for part in parts)
        first = 0
        padded = []
        for part in parts:
            features = F.pad(part.features, (0, 0, 0, most - part.features.shape[2]))
            index = part.neighbourhood_index + first
            padded.append(part._replace(features=features, neighbourhood_index=index))
            first += len(part.neighbourhoods)
        return RayInputs(*(torch.cat(values) for values in zip(*padded, strict=True)))


class RayFill(Network, Fill):
    """Weighs the candidates of each missing pixel."""

    config: RaysConfig
    margin_px = MARGIN_PX

    def __init__(self, config: RaysConfig | None = None) -> None:
        super().__init__()
        config = config or RaysConfig()
        self.config = config
        width = config.width
        deep = 2 * width

        # Cameras at a point
        self.look = nn.Sequential(nn.Linear(sum(CAMERA_CHANNELS), width), nn.GELU())
        camera_inputs = width + sum(CAMERA_CHANNELS) + 2 * COLOUR_CHANNELS + 3
        self.compare = nn.Sequential(
            nn.Linear(camera_inputs, width),
            nn.GELU(),
            nn.Linear(width, width),
            nn.GELU(),
        )
        self.trust = nn.Linear(width, 1)
        point_inputs = width + 2 * COLOUR_CHANNELS + 5
        self.point = nn.Sequential(
            nn.Linear(point_inputs, width),
            nn.GELU(),
            nn.Linear(width, POINT_FEATURES),
        )

        # The surroundings of a pixel: a window, and wider neighbourhoods of two sizes
        self.around = nn.Sequential()
        for before, after in pairwise((WINDOW_CHANNELS, *(width,) * (RADIUS_PX - 1), deep)):
            self.around.extend([nn.Conv2d(before, after, 3), nn.GELU()])
        sizes = len(CELLS)
        self.far = nn.Sequential(
            nn.Conv2d(sizes * CELL_CHANNELS, sizes * 24, 3, groups=sizes),
            nn.GELU(),
            nn.Conv2d(sizes * 24, sizes * width, 3, stride=2, groups=sizes),
            nn.GELU(),
            nn.Conv2d(sizes * width, sizes * deep, 4, groups=sizes),
            nn.GELU(),
        )

        # The choice: it runs once per pixel, not once per point and camera, so width is cheap here.
        points = len(OFFSETS)
        inputs = points * POINT_FEATURES + (1 + sizes) * deep
        self.head = nn.Sequential(
            nn.Linear(inputs, 22 * width),
            nn.GELU(),
            nn.Linear(22 * width, 20 * width),
            nn.GELU(),
        )
        self.choose = nn.Linear(20 * width, points + 2)

    @one_thread()
    def forward(
        self, view: IncompleteView, sources: SourceCameras | None, scale: SceneScale | None = None
    ) -> Image:
        """The view's image with all of E filled; None for `sources` leaves the smooth fill.

        `scale` is the view's, if it is known.
        """
        missing = view.error > 0
        wide = wide_holes(missing)
        has_depth = view.depth > 0
        to_fill = missing & has_depth.any()
        count, num_wide, num_without_depth = counts_of(to_fill, wide, missing & ~has_depth)
        pixels = torch.nonzero_static(to_fill, size=count)
        if num_wide:
            smooth = fill_wide(view.rgb, missing, view.mask > 0, wide)
        else:
            smooth = fill_thin(view.rgb, missing)
        inputs = gather_ray_inputs(view, sources, pixels, smooth, scale, all_have_depth=not num_without_depth)
        colours = self.mix(inputs)
        return smooth.movedim(0, -1).index_put(tuple(pixels.unbind(1)), colours).movedim(-1, 0)

    def fill_view(self, view: IncompleteView, context: ContextProvider) -> Image:
        """The mixed colours."""
        return self(view, SourceCameras.closest_to(view, context, self.config.num_views)).float().clamp(0, 1)

    @all_threads()
    def mix(self, inputs: RayInputs) -> Float[Tensor, "pixel 3"]:
        """The mixed colour of each pixel."""
        features, smallest, window, neighbourhoods, index = inputs
        if torch.compiler.is_exporting():
            return self._mix(features, smallest, window, self.far(neighbourhoods).flatten(1)[index])
        size = PIXELS_AT_ONCE if features.device.type == "cpu" else GPU_PIXELS_AT_ONCE
        if torch.is_grad_enabled():
            size = max(1, len(index))
        with self.autocast():
            far = [self.far(_round_up(part)).flatten(1)[: len(part)] for part in neighbourhoods.split(size)]
            per_pixel = (features, smallest, window, torch.cat(far)[index])
            mixed = []
            for chunk in zip(*(values.split(size) for values in per_pixel), strict=True):
                stop_if_cancelled()
                mixed.append(self._mix(*map(_round_up, chunk))[: len(chunk[0])])
            return torch.cat(mixed)

    def _mix(
        self,
        features: Features,
        smallest_masks: SmallestMasks,
        window: Window,
        far: Float[Tensor, "pixel feature"],
    ) -> Float[Tensor, "pixel 3"]:
        """The mixed colour of some pixels; `far` are the features of their neighbourhoods."""
        colours, points = self._points(features, smallest_masks)
        hidden = self.head(torch.cat([points.flatten(1), self.around(window).flatten(1), far], 1))
        in_no_view = CameraFeatures.unstack(features).in_view.amax((2, 3)) == 0
        missing = F.pad(in_no_view, (0, 2), value=False)  # the smooth fill and background never are
        weights = self.choose(hidden).float().masked_fill(missing, -torch.inf).softmax(1)
        candidates = torch.cat([colours, window[:, None, -3:, RADIUS_PX, RADIUS_PX]], 1)
        return (weights[:, :-1, None] * candidates).sum(1)  # background is black

    def _points(
        self, features: Features, smallest_masks: SmallestMasks
    ) -> tuple[Float[Tensor, "pixel point 3"], Float[Tensor, "pixel point feature"]]:
        """Each point's colour, by the cameras that seem to see it, and evidence for the surface being there."""
        at = CameraFeatures.unstack(features)
        colours = torch.cat([at.colour, at.mean_colour, at.mean_coverage], -1)

        # Initial weights: cameras near the viewer that do not have the point far behind the proxy
        prior = at.in_view * (4 * at.viewing_cosine).exp() * (-4 * at.depth_difference).sigmoid()
        prior = prior / (prior.sum(2, keepdim=True) + 1e-6)
        compared = self._compare(at, colours, prior, smallest_masks)

        # What the trusted cameras show, and how much they agree
        scores = self.trust(compared).float() + (prior + 1e-4).log()
        trust = at.in_view * scores.masked_fill(at.in_view == 0, -1e4).softmax(2)
        agreed = _weighted_sum(trust, colours)
        spread = CONTRAST * _weighted_sum(trust, (colours - agreed[:, :, None]) ** 2)
        point = [_weighted_sum(trust, compared), agreed, spread, smallest_masks, _weighted_sum(trust, trust)]
        return agreed[..., :3], self.point(torch.cat(point, -1))

    def _compare(
        self,
        at: CameraFeatures,
        colours: Float[Tensor, "pixel point view colour"],
        prior: Float[Tensor, "pixel point view 1"],
        smallest_masks: SmallestMasks,
    ) -> Float[Tensor, "pixel point view feature"]:
        """Compares each camera with all of them, which are weighted by `prior`.

        The first layer runs once per point, instead of once per camera, on what the cameras share.
        """
        mean = _weighted_sum(prior, colours)
        variance = CONTRAST * _weighted_sum(prior, (colours - mean[:, :, None]) ** 2)

        # Shipped weights depend on the order of these channels
        ordered = torch.cat([*at[:7], at.mean_mask, at.mean_colour, at.mean_coverage], -1)
        looked = self.look(ordered)
        first = self.compare[0]
        assert isinstance(first, nn.Linear)
        widths = (ordered.shape[-1], COLOUR_CHANNELS, COLOUR_CHANNELS, looked.shape[-1], 2, 1)
        of_camera, *_, of_look, _, of_prior = first.weight.split(widths, 1)
        own = F.linear(torch.cat([ordered, looked, prior], -1), torch.cat([of_camera, of_look, of_prior], 1))
        together = _weighted_sum(prior, looked)
        shared = torch.cat([mean, variance, together, smallest_masks[:, :, ::2]], -1)
        added = F.linear(shared, first.weight[:, ordered.shape[-1] : -1], first.bias)
        return self.compare[1:](own + added[:, :, None])


def _weighted_sum(
    weights: Float[Tensor, "pixel point view 1"], values: Float[Tensor, "pixel point view value"]
) -> Float[Tensor, "pixel point value"]:
    """Sums over cameras, in the precision of the weights."""
    with torch.autocast(weights.device.type, enabled=False):  # colours need more than eight bits
        return (weights.mT @ values.to(weights)).squeeze(2)


def _round_up(values: Float[Tensor, "pixel *feature"]) -> Float[Tensor, "more_pixels *feature"]:
    """The values, on the CPU padded with zeros to a multiple of `PIXELS_STEP` pixels."""
    if values.device.type != "cpu":
        return values
    return F.pad(values, (0, 0) * (values.ndim - 1) + (0, -len(values) % PIXELS_STEP))


def gather_ray_inputs(
    view: IncompleteView,
    sources: SourceCameras | None,
    pixels: Pixels,
    smooth: Image | None = None,
    scale: SceneScale | None = None,
    all_have_depth: bool = False,
) -> RayInputs:
    """The network's inputs for pixels (row, column) of a view.

    `smooth` is the image with E filled smoothly, and `scale` that of the view, if the caller has them.
    `all_have_depth` says that all pixels are known to be on the proxy.
    """
    if smooth is None:
        smooth = fill(view.rgb, view.error > 0, view.mask > 0)
    if scale is None:
        scale = SceneScale.of(view)
    if sources is None:
        features = view.depth.new_zeros(len(pixels), len(OFFSETS), 1, sum(CAMERA_CHANNELS))
        smallest = view.depth.new_ones(len(pixels), len(OFFSETS), 4)
    else:
        samples = sample_behind_proxy(view, pixels, sources, scale=scale, all_have_depth=all_have_depth)
        features = samples.features
        smallest = RayStatistics.unstack(samples.statistics).smallest_masks
    window = windows(torch.cat([view.rgb, view.mask[None], view.error[None], smooth]), pixels, RADIUS_PX)
    return RayInputs(features, smallest, window, *multi_scale_context(view, smooth, pixels, scale))


def windows(
    image: Float[Tensor, "channel height width"], at: Int[Tensor, "point 2"], radius: int
) -> Float[Tensor, "point channel side side"]:
    """Squares around some pixels (row, column) of an image, which is 0 beyond its border."""
    padded = F.pad(image, (radius,) * 4)
    side = 2 * radius + 1
    if torch.compiler.is_exporting():
        reach = torch.arange(side)
        rows = at[:, 0, None] + reach
        columns = at[:, 1, None] + reach
        return padded[:, rows[:, :, None], columns[:, None, :]].movedim(0, 1).contiguous()
    everywhere = padded.movedim(0, 2).unfold(0, side, 1).unfold(1, side, 1)
    return everywhere[tuple(at.unbind(1))]


def sample_behind_proxy(
    view: IncompleteView,
    pixels: Pixels,
    sources: SourceCameras,
    offsets: Sequence[float] = OFFSETS,
    scale: SceneScale | None = None,
    all_have_depth: bool = False,
) -> RaySamples:
    """`sample_fill_rays` at points `offsets` behind the proxy, on the rays of pixels (row, column).

    A pixel without a depth takes it from its surroundings; the view must have a depth somewhere.
    `scale` is the view's, if it is known, and `all_have_depth` says that no pixel lacks one.
    """
    if scale is None:
        scale = SceneScale.of(view)
    depth = view.depth[pixels[:, 0], pixels[:, 1]]
    if torch.compiler.is_exporting():
        depth = torch.where(depth > 0, depth, scale.depth_m)
    elif not all_have_depth and not bool((depth > 0).all()):
        depth = pull_push(view.depth[None], view.depth > 0)[0][pixels[:, 0], pixels[:, 1]]
    return sample_fill_rays(Rays(view, scale, pixels, scale.depths_behind(depth, offsets)), sources)


def multi_scale_context(
    view: IncompleteView, smooth: Image, pixels: Pixels, scale: SceneScale | None = None
) -> tuple[Float[Tensor, "neighbourhood 12 11 11"], Int[Tensor, "pixel"]]:
    """`RayInputs.neighbourhoods` of pixels (row, column), and the index of each pixel's neighbourhood.

    Depth is relative: 0.5 at the subject's median, growing with distance, 0 where there is none.
    Cells meet at the principal point, so that a crop of a view has the same cells. `scale` is the
    view's, if it is known.
    """
    # The view
    if scale is None:
        scale = SceneScale.of(view)
    depth = ((view.depth - scale.depth_m) / (0.5 * scale.size_m)).sigmoid() * (view.depth > 0)
    image = torch.cat([smooth, view.mask[None], view.error[None], depth[None]])

    # The cells of each size that pixels are in, the first of which begin `before` pixels outside the view
    sides = torch.stack([box_side_px(size, scale.subject_px) for size in CELLS])[:, None]
    middle = (view.camera if torch.compiler.is_exporting() else view.camera.on_host).K[0, :2, 2]
    before = -middle.floor().long().flip(0) % sides
    if torch.compiler.is_exporting():
        cells = (pixels[:, None] + before) // sides
        firsts, index = _first_pixels(cells, sides, before, view.mask.shape)
        return _means_of_boxes(image, (firsts[:, None] + before) // sides, sides, before), index
    on_device = torch.cat([before, sides], 1).to(pixels.device)
    cells = (pixels[:, None] + on_device[:, :2]) // on_device[:, 2:]
    cells, index = cells.unique(dim=0, return_inverse=True)

    # The means of the cells around them
    around = []
    for size, (above, left, side) in enumerate(torch.cat([before, sides], 1).tolist()):
        from_first = F.pad(image, (left, 0, above, 0))
        means = F.avg_pool2d(from_first, side, ceil_mode=True, divisor_override=side**2)
        around.append(windows(means, cells[:, size], CELLS_AROUND))
    return torch.cat(around, 1), index


def _means_of_boxes(
    image: Float[Tensor, "6 height width"],
    cells: Int[Tensor, "neighbourhood size 2"],
    sides: Int[Tensor, "size 1"],
    before: Int[Tensor, "size 2"],
) -> Float[Tensor, "neighbourhood 12 11 11"]:
    """The means of the cells around some cells, for an exported model, where their sides depend on the inputs."""
    reach = torch.arange(-CELLS_AROUND, CELLS_AROUND + 2)
    corners = (cells[..., None] + reach) * sides[..., None] - before[..., None]
    rows, columns = corners.split(1, 2)
    means = (BoxSums.of(image[None]).boxes(rows, columns)[:, :, 0] / sides[..., None, None] ** 2).float()
    return means.movedim(-1, 2).flatten(1, 2)


def _first_pixels(
    cells: Int[Tensor, "pixel size 2"],
    sides: Int[Tensor, "size 1"],
    before: Int[Tensor, "size 2"],
    shape: torch.Size,
) -> tuple[Int[Tensor, "neighbourhood 2"], Int[Tensor, "pixel"]]:
    """The first pixel of each different element of `cells`, and the index of each element among them.

    An exported model has no `unique` over tensors. Cells of both sizes overlap in a rectangle, whose first pixel stands
    for them.
    """
    corner = (cells * sides - before).amax(1).clamp_min(0)
    number = corner[:, 0] * shape[1] + corner[:, 1]
    present = torch.zeros(shape[0] * shape[1], dtype=torch.long)
    present = present.index_put((number,), torch.ones_like(number))
    index = (present.cumsum(0) - 1)[number]
    return torch.nonzero(present.view(shape)), index
