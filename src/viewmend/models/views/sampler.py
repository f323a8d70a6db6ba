"""Samples the source cameras at points on the rays of a novel view, as IBRNet does (Wang et al., CVPR 2021).

Both networks of the default model take their inputs from here: `ViewSynthNet` by `sample_rays`,
from image pyramids; `RayFill` by `sample_fill_rays`, from full images and box means. The code in
PyTorch is the reference for any device, and what `torch.export` traces. On the CPU, compiled
kernels replace it (`_sampler_numba.py`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Shaped, UInt8
from torch import Tensor
from torch.nn import functional as F

from viewmend.geometry.cameras import Cameras, concatenate_cameras
from viewmend.geometry.threads import parallel_for
from viewmend.models.views.box_sums import BoxSums
from viewmend.models.views.config import AROUND, CONTRAST, FAR, NEAR, NUM_FEATURES, NUM_STATISTICS
from viewmend.models.views.pyramids import MipLevels, Pyramid, SceneScale, SourceCameras
from viewmend.types import IncompleteView

CameraImages = Sequence[tuple]
"""One pair for each camera: its images to sample, and the scale from its pixels to those of each image."""
RGB_MASK = 4
"""This is the number of a camera image's first channels: RGB on black, and the mask."""
RGB_MASK_COVERAGE = 5
"""This is the number of all channels of a camera image: the fifth is 1 where the proxy covers the pixel."""
CAMERA_CHANNELS = (3, 1, 1, 1, 1, 1, 1, 3, 1, 1)
"""The fields of `CameraFeatures` have these numbers of channels."""
STATISTICS_CHANNELS = (3, 3, 4)
"""The fields of `RayStatistics` have these numbers of channels."""
PATCH = 0.08
"""`RayFill` averages colours over squares of this side, in subject sizes: single pixels agree by chance."""
MIN_COVERAGE = 0.3
"""`RayFill` measures the distance behind the proxy where the proxy covers at least this share of a pixel."""
CATMULL_ROM = ((0.0, 1.0, 0.0, 0.0), (-0.5, 0.0, 0.5, 0.0), (1.0, -2.5, 2.0, -0.5), (-0.5, 1.5, -1.5, 0.5))
"""Cubic interpolation weighs four values by polynomials of s, the share of the way from the second to
the third. Row n has the coefficients of s^n."""
TIE = 1e-7
"""Each camera's score is lowered by this much for every camera before it, so that the first of equal ones is chosen.
Cameras that have a sample in view have scores above 1e-5, so they are still chosen before all others."""
BAND = 2048
"""A thread takes about this many samples at a time."""


@dataclass(frozen=True)
class Rays:
    """Rays of a novel view, and sample positions on them."""

    view: IncompleteView
    """The novel view, or a crop of it."""
    scale: SceneScale
    """The scale of the whole view."""
    cells: Int[Tensor, "ray 2"]
    """Row and column of the square through whose middle each ray goes."""
    z_m: Float[Tensor, "ray sample"]
    """z-depth; a sample at 0 is in no view."""
    cameras: Int[Tensor, "ray view"] | None = None
    """Indices of the source cameras that are sampled on each ray; None for all. An index beyond the
    last camera stands for no camera."""
    cell_px: int = 1
    """Side of a square, pixels."""

    def split(self, size: int | None) -> "list[Rays]":
        """Chunks of `size` rays; None gives one chunk."""
        if size is None:
            return [self]
        parts: list[Rays] = []
        for first in range(0, max(1, len(self.cells)), size):
            own = slice(first, first + size)
            cameras = None if self.cameras is None else self.cameras[own]
            parts.append(replace(self, cells=self.cells[own], z_m=self.z_m[own], cameras=cameras))
        return parts

    @property
    def origin(self) -> Float[Tensor, "3"]:
        """The viewer's position, metres, on the CPU."""
        return _on_host(self.view.camera).centers[0].double()

    @property
    def world_from_pixel(self) -> Float[Tensor, "3 3"]:
        """R K^-1, which turns (u, v, 1) into the step along a pixel's ray per metre of z-depth; on the CPU.

        K^-1 is written out, because ONNX has no inverse.
        """
        camera = _on_host(self.view.camera)
        K = camera.K[0].double()
        world_from_camera = camera.camera_from_world[0, :3, :3].double().T
        (fx, skew, cx), (_, fy, cy), _ = K
        zero = torch.zeros_like(fx)
        inverse = [
            torch.stack([1 / fx, -skew / (fx * fy), (skew * cy - cx * fy) / (fx * fy)]),
            torch.stack([zero, 1 / fy, -cy / fy]),
            torch.stack([zero, zero, torch.ones_like(fx)]),
        ]
        return world_from_camera @ torch.stack(inverse)

    @cached_property
    def directions(self) -> Float[Tensor, "ray 3"]:
        """The step along each ray per metre of z-depth, world coordinates."""
        along_u, along_v, start = self.world_from_pixel.unbind(1)
        rows = self.cell_px * along_v
        columns = self.cell_px * along_u
        from_cell = torch.stack([rows, columns, start + 0.5 * (rows + columns)], 1).to(self.cells.device)
        return F.linear(self.cells.double(), from_cell[:, :2], from_cell[:, 2])


class RaySamples(NamedTuple):
    """Samples on rays."""

    features: Float[Tensor, "ray sample view feature"]
    """`CameraFeatures`, stacked; `sample_rays` appends the rest of `config.NUM_FEATURES`."""
    prior: Float[Tensor, "ray sample view"]
    """Initial weights of the cameras: high near the viewer, and where the sample is not far behind
    the proxy. The sum is 1, or 0 where no camera has the sample in view. `sample_fill_rays` sets 0."""
    statistics: Float[Tensor, "ray sample 10"]
    """`RayStatistics`, stacked; `sample_fill_rays` computes only the masks."""
    cameras: Int[Tensor, "ray view"] | None = None
    """Indices of the source cameras, as `Rays.cameras`."""


class CameraChoice(NamedTuple):
    """How the source cameras of a ray are chosen: the `views` cameras that see some of its samples best."""

    samples: tuple[int, ...]
    """Indices of these samples."""
    views: int


class CameraFeatures(NamedTuple):
    """What each source camera shows of ray samples; zeros where the sample is not in view."""

    colour: Float[Tensor, "ray sample view 3"]
    """RGB in [0, 1] on black."""
    mask: Float[Tensor, "ray sample view 1"]
    depth_difference: Float[Tensor, "ray sample view 1"]
    """Distance behind the proxy in that camera, in subject sizes; -1 to 1, saturating at `NEAR`."""
    coarse_depth_difference: Float[Tensor, "ray sample view 1"]
    """The same, saturating at `FAR`."""
    viewing_cosine: Float[Tensor, "ray sample view 1"]
    """Cosine of the angle between the camera's ray and the novel view's."""
    is_source: Float[Tensor, "ray sample view 1"]
    """1 for a camera that coloured the view."""
    in_view: Float[Tensor, "ray sample view 1"]
    """1 where the camera has the sample in view."""
    mean_colour: Float[Tensor, "ray sample view 3"]
    """RGB averaged around the sample: over `AROUND`, for `RayFill` over `PATCH`."""
    mean_mask: Float[Tensor, "ray sample view 1"]
    """Mask averaged over `AROUND`: low near an outline. Hulls are too large where outlines of two
    cameras meet."""
    mean_coverage: Float[Tensor, "ray sample view 1"]
    """Coverage by the proxy averaged over `AROUND`: above `mean_mask` where the proxy is too large."""

    @classmethod
    def unstack(cls, stacked: Float[Tensor, "ray sample view 14"]) -> "CameraFeatures":
        """The fields as views of stacked features."""
        return cls(*stacked.split(CAMERA_CHANNELS, -1))


class RayStatistics(NamedTuple):
    """Statistics of samples over all cameras."""

    mean_colour: Float[Tensor, "*sample 3"]
    """Mean RGB by the prior weights."""
    colour_variance: Float[Tensor, "*sample 3"]
    """Variance of RGB by the prior weights, times `CONTRAST`."""
    smallest_masks: Float[Tensor, "*sample 4"]
    """The two smallest masks of the rig, and the two smallest masks averaged around the sample."""

    @classmethod
    def unstack(cls, stacked: Float[Tensor, "*sample 10"]) -> "RayStatistics":
        """The fields as views of stacked statistics."""
        return cls(*stacked.split(STATISTICS_CHANNELS, -1))


class Projections(NamedTuple):
    """Where cameras see samples on rays; zeros where a sample is not in view."""

    uv_px: Float[Tensor, "ray sample view 2"]
    z_m: Float[Tensor, "ray sample view"]
    """z-depth in the camera."""
    in_view: Bool[Tensor, "ray sample view"]


class _InImages(NamedTuple):
    """Where the samples of rays lie in the source cameras."""

    projected: Projections
    cosines: Float[Tensor, "ray sample view"]
    """Cosine of the angle at the sample between viewer and camera."""
    behind: Float[Tensor, "ray sample view"]
    """Distance behind the proxy in the camera's view, metres."""

    def of_cameras(self, chosen: Int[Tensor, "ray view"]) -> "_InImages":
        """The same in the cameras chosen for each ray; gathered together."""
        columns, rows = self.projected.uv_px.unbind(-1)
        all_values = torch.stack([columns, rows, self.projected.z_m, self.behind, self.cosines], -1)
        index = chosen[:, None, :, None].expand(-1, all_values.shape[1], -1, all_values.shape[3])
        values = all_values.gather(2, index)
        z_of_chosen = values[..., 2]
        projected = Projections(values[..., :2], z_of_chosen, z_of_chosen > 0)
        return _InImages(projected, values[..., 4], values[..., 3])


class _Comparison(NamedTuple):
    """How the cameras agree in a sample."""

    prior: Float[Tensor, "ray sample view 1"]
    """Weight of each camera before it is learned."""
    mean: Float[Tensor, "ray sample 1 3"]
    """Mean colour by these weights."""
    difference: Float[Tensor, "ray sample view 3"]
    """Each camera's colour minus the mean; 0 where the sample is not in view."""
    variance: Float[Tensor, "ray sample 1 3"]
    """Variance of the colour by these weights, times `CONTRAST`."""


class _Boxes(NamedTuple):
    """Boxes over which some channels of an image with a border are averaged; see `_sampler_numba.average_boxes`."""

    image: UInt8[Tensor, "rows columns channel"]
    first: int
    """The first channel."""
    channels: int
    """Number of channels."""
    step: int
    """1 to average every pixel, 2 for every second row and column."""
    side: int
    """Pixels to average per row and column."""

    def means(self) -> Float[np.ndarray, "box_rows box_columns mean"]:
        """The mean of each box, with a border of zeros."""
        from viewmend.models.views._sampler_numba import average_boxes

        # The image and the means have borders of one pixel; boxes at the right and below may be incomplete
        box_px = self.step * self.side
        rows, columns = (2 + -(-(length - 2) // box_px) for length in self.image.shape[:2])
        found = np.zeros((rows, columns, self.channels), np.float32)
        average_boxes(self.image.numpy(), self.first, self.step, self.side, found)
        return found


def sample_rays(
    rays: Rays,
    sources: SourceCameras,
    step_px: float,
    cubic: bool = False,
    choice: CameraChoice | None = None,
) -> RaySamples:
    """Samples the source cameras, at the pyramid levels that match rays with a spacing of `step_px`.

    With `cubic`, colours and masks are interpolated by Catmull-Rom splines, which are sharper than
    bilinear ones. With `choice`, a ray is sampled in the cameras that are chosen for it.
    """
    if torch.compiler.is_exporting():
        return sample_rays_torch(with_cameras(rays, sources, choice), sources, step_px, cubic)
    with torch.autocast(rays.z_m.device.type, enabled=False):  # positions need more than eight bits
        if not sources.use_kernels:
            return sample_rays_torch(rays, sources, step_px, cubic, choice)
        rays = with_cameras(rays, sources, choice)
        image_levels, silhouette_levels = sources.levels(rays.view.camera, step_px, rays.scale)
        images = _at_levels(sources.pyramids, image_levels)
        silhouettes = _at_levels(sources.silhouette_pyramids, silhouette_levels)
        return _sample_numba(rays, sources, images, silhouettes, min_coverage=0.0, cubic=cubic)


def sample_rays_torch(
    rays: Rays,
    sources: SourceCameras,
    step_px: float,
    cubic: bool = False,
    choice: CameraChoice | None = None,
) -> RaySamples:
    """The reference of `sample_rays`. It chooses cameras by samples that it takes anyway."""
    # The cameras chosen for each ray. In an exported model, an index that stands for no camera becomes
    # that of the last one, which then has no sample in view.
    chosen = None
    last = sources.cameras.K.shape[0] - 1
    if rays.cameras is not None:
        chosen = rays.cameras.clamp_max(last) if torch.compiler.is_exporting() else rays.cameras

    # Positions in the cameras, and distances behind the proxy there
    into_all, cosines, in_silhouettes = _project_into_all(rays, sources, chosen)
    if rays.cameras is not None and torch.compiler.is_exporting():
        into_all = into_all._replace(in_view=into_all.in_view & (rays.cameras <= last)[:, None])
    in_images = _InImages(into_all, cosines, _distance_behind(sources, into_all, chosen))
    if choice is not None and choice.views <= last:
        weights = _weights(rays, in_images)
        chosen = _highest(weights[:, list(choice.samples)].sum(1).float(), choice.views)
        in_images = in_images.of_cameras(chosen)

    # What each camera shows
    levels, silhouettes = sources.mips(rays.view.camera, step_px, rays.scale)
    levels = levels if chosen is None else levels.of_cameras(chosen)
    if cubic:
        fine = sample_level_cubic(levels.at(0), in_images.projected, RGB_MASK)
        wide = sample_level(levels.at(1), in_images.projected, RGB_MASK_COVERAGE)
    else:
        fine_with_coverage, wide = sample_level(levels, in_images.projected, RGB_MASK_COVERAGE)
        fine = fine_with_coverage[..., :RGB_MASK]
    features = _camera_features(rays, sources, in_images, fine, wide, F.softsign, chosen)

    # How the cameras differ, and the silhouettes of the whole rig
    comparison = _compare(CameraFeatures.unstack(features))
    smallest = _smallest_masks(in_silhouettes, sample_level(silhouettes, in_silhouettes, 1)[..., 0])
    statistics = torch.cat([comparison.mean.squeeze(2), comparison.variance.squeeze(2), *smallest], -1)
    cameras = chosen if rays.cameras is None else rays.cameras
    prior = comparison.prior
    return RaySamples(
        torch.cat([features, comparison.difference, prior], -1), prior[..., 0], statistics, cameras
    )


def _compare(features: CameraFeatures) -> _Comparison:
    """Prior weights of the cameras, and how their colours differ by them."""
    weights = features.in_view * _closeness(features.viewing_cosine, features.depth_difference)
    prior = weights / (weights.sum(2, keepdim=True) + 1e-6)
    mean = prior.mT @ features.colour
    difference = features.in_view * (features.colour - mean)
    return _Comparison(prior, mean, difference, CONTRAST * (prior.mT @ difference.square()))


def sample_fill_rays(rays: Rays, sources: SourceCameras) -> RaySamples:
    """Samples the source cameras at full resolution, with means over boxes."""
    if not sources.use_kernels:
        return _sample_fill_rays_torch(rays, sources)
    images = [pyramid.levels[0] for pyramid in sources.pyramids]
    masks = [pyramid.levels[0] for pyramid in sources.silhouette_pyramids]
    shape_side, half_colour_side, silhouette_side = map(int, _box_sides(*sources.mask_sums))

    # Means over boxes: colours of every second pixel, shapes (mask and coverage), and silhouettes
    colour_boxes = [_Boxes(image, first=0, channels=3, step=2, side=half_colour_side) for image in images]
    shape_boxes = [_Boxes(image, first=3, channels=2, step=1, side=shape_side) for image in images]
    silhouette_boxes = [_Boxes(mask, first=0, channels=1, step=1, side=silhouette_side) for mask in masks]
    colours, shapes, rig_masks = _average_all(colour_boxes, shape_boxes, silhouette_boxes)

    # Images and means of each camera, with the scales from its pixels to theirs
    scales = (1.0, 0.5 / half_colour_side, 1 / shape_side)
    silhouette_scales = (1.0, 1 / silhouette_side)
    views = [
        ((image.numpy(), colour_means, shape_means), scales)
        for image, colour_means, shape_means in zip(images, colours, shapes, strict=True)
    ]
    silhouettes = [
        ((mask.numpy(), means), silhouette_scales) for mask, means in zip(masks, rig_masks, strict=True)
    ]
    return _sample_numba(rays, sources, views, silhouettes, MIN_COVERAGE)


def _average_all(*groups: Sequence[_Boxes]) -> list[list[np.ndarray]]:
    """The means of the boxes of each group, computed on all threads."""
    boxes = [image_boxes for group in groups for image_boxes in group]
    means: dict[int, np.ndarray] = {}

    def work(number: int) -> None:
        means[number] = boxes[number].means()

    parallel_for(work, len(boxes))
    in_order = iter([means[number] for number in range(len(boxes))])
    return [[next(in_order) for _ in group] for group in groups]


def _sample_fill_rays_torch(rays: Rays, sources: SourceCameras) -> RaySamples:
    """The reference of `sample_fill_rays`."""
    shape_side, half_colour_side, silhouette_side = _box_sides(*sources.mask_sums)
    projected, cosines, in_silhouettes = _project_into_all(rays, sources)

    # Images, with the proxy's depth as the last channel, and means of colours and of shapes over boxes
    images = torch.cat([sources.images.float(), sources.views.depth[:, None]], 1)
    boxes = [(2, half_colour_side), (1, shape_side)]
    at_points, colours, shapes = _sample_with_means(images, boxes, projected)
    fine, coverage, covered_depth = at_points.split((RGB_MASK, 1, 1), -1)
    around = torch.cat([colours[..., :3], shapes[..., 3:RGB_MASK_COVERAGE]], -1)

    # Distance behind the proxy: the mean depth of the pixels around that have one
    surface = 255 * covered_depth / coverage.clamp_min(MIN_COVERAGE)  # depths were divided by 255, too
    distance = projected.z_m - surface[..., 0]
    behind = distance * (coverage[..., 0] > MIN_COVERAGE)
    features = _camera_features(
        rays, sources, _InImages(projected, cosines, behind), fine, around, torch.tanh
    )

    smallest = torch.cat(_smallest_rig_masks(sources, in_silhouettes, silhouette_side), -1)
    return RaySamples(
        features, 0 * features[..., 0], F.pad(smallest, (NUM_STATISTICS - smallest.shape[-1], 0))
    )


def _sample_with_means(
    images: Float[Tensor, "view channel height width"],
    boxes: Sequence[tuple[int, Int[Tensor, ""]]],
    projected: Projections,
) -> Sequence[Float[Tensor, "ray sample view channel"]]:
    """Images at the projections, and their means over boxes, divided by 255.

    `boxes` are pairs of a step and a side, pixels: one row and column of each step counts; a box has `side` of these.
    """
    if torch.compiler.is_exporting():  # the sides depend on the inputs
        found = [sample_level(MipLevels.full(images), projected, images.shape[1])]
        for step, side in boxes:
            every = images
            for axis in (2, 3):  # by index: `torch.export` does not know the strides of a slice with steps
                every = every.index_select(axis, torch.arange(0, images.shape[axis], step))
            found.append(BoxSums.of(every).means(projected.uv_px / step, side))
        return found

    levels = [images]
    scales = [1.0]
    for step, side in boxes:
        every = images[:, :, ::step, ::step]
        levels.append(F.avg_pool2d(every, int(side), ceil_mode=True, divisor_override=int(side) ** 2))
        scales.append(1 / (step * int(side)))
    return sample_level(MipLevels.scaled(levels, scales), projected, images.shape[1]).unbind(0)


def _camera_features(
    rays: Rays,
    sources: SourceCameras,
    in_images: _InImages,
    fine: Float[Tensor, "ray sample view 4"],
    wide: Float[Tensor, "ray sample view 5"],
    squash: Callable[[Tensor], Tensor],
    chosen: Int[Tensor, "ray view"] | None = None,
) -> Float[Tensor, "ray sample view 14"]:
    """`CameraFeatures` stacked, given the images sampled where the samples lie in them."""
    is_source = sources.is_source(rays.view.source_views)
    if chosen is not None:
        is_source = is_source[chosen][:, None]
    is_source = is_source.expand_as(in_images.cosines)
    in_view = in_images.projected.in_view.float()[..., None]
    saturation = rays.scale.size_m * torch.tensor((NEAR, FAR), dtype=torch.double)
    differences = squash(in_images.behind[..., None] / saturation.to(in_images.behind.device))
    measured = torch.cat([differences, in_images.cosines[..., None]], -1).float()
    features = torch.cat([fine, measured, is_source[..., None], in_view, wide], -1)
    return features * in_view


def _distance_behind(
    sources: SourceCameras, projected: Projections, chosen: Int[Tensor, "ray view"] | None = None
) -> Float[Tensor, "ray sample view"]:
    """Distance of samples behind the proxy, metres, by the depth of the nearest pixel in each camera.

    With `chosen`, the projections are those into the cameras chosen for each ray.
    """
    depth = sources.views.depth
    rows, columns = depth.shape[1:]
    if chosen is None:
        camera = torch.arange(depth.shape[0], device=depth.device)
    else:
        camera = chosen[:, None]
    column, row = projected.uv_px.long().unbind(-1)
    if torch.compiler.is_exporting():
        index = camera * (rows * columns) + row * columns + column
        surface = _look_up(depth.reshape(-1, 1), index)[..., 0]
    else:
        surface = depth[camera, row, column]
    return (projected.z_m - surface) * (surface > 0)


def _closeness(
    cosine: Float[Tensor, "ray sample *view"], depth_difference: Float[Tensor, "ray sample *view"]
) -> Float[Tensor, "ray sample *view"]:
    """Prior weights, not normalised: high for cameras near the viewer, unless the sample is far behind the proxy."""
    return (4 * cosine).exp() * (-6 * depth_difference).sigmoid()


def _look_up(table: Shaped[Tensor, "row *channel"], index: Int[Tensor, "*sample"]) -> Shaped[Tensor, "..."]:
    """Rows of a table. ONNX Runtime gathers by a list of indices much faster than by an array of them."""
    return table.index_select(0, index.flatten()).view(*index.shape, *table.shape[1:])


def with_cameras(rays: Rays, sources: SourceCameras, choice: CameraChoice | None) -> Rays:
    """The rays with the cameras that are chosen for them; the same rays without a choice."""
    if choice is None:
        return rays
    some_samples = replace(rays, z_m=rays.z_m[:, list(choice.samples)])
    return replace(rays, cameras=choose_cameras(some_samples, sources, choice.views))


def choose_cameras(rays: Rays, sources: SourceCameras, count: int) -> Int[Tensor, "ray view"] | None:
    """Indices of the `count` source cameras with the highest prior weights on each ray; None if that is all of them.

    The weights are added up over the samples of the rays. Of cameras with equal weights, such as those
    that have none of these samples in view, the first are chosen. `topk` alone would choose different ones
    in different runtimes.
    """
    # An exported model takes any number of cameras. An index beyond the last stands for no camera.
    if torch.compiler.is_exporting():
        scores = _without_ties(score_cameras_torch(rays, sources))
        return F.pad(scores, (0, count), value=-1.0).topk(count, 1).indices

    if len(sources.cameras) <= count:
        return None
    scores = _score_numba(rays, sources) if sources.use_kernels else score_cameras_torch(rays, sources)
    return _highest(scores, count)


def _highest(scores: Float[Tensor, "ray camera"], count: int) -> Int[Tensor, "ray view"]:
    """Indices of the highest scores."""
    return _without_ties(scores).topk(count, 1).indices


def _without_ties(scores: Float[Tensor, "ray camera"]) -> Float[Tensor, "ray camera"]:
    """The scores, lowered a little from camera to camera, so that equal ones differ."""
    return scores - TIE * torch.arange(scores.shape[1], device=scores.device)


def score_cameras_torch(rays: Rays, sources: SourceCameras) -> Float[Tensor, "ray camera"]:
    """The reference of the scores of `choose_cameras`."""
    lines = CameraLines.of(rays, sources.cameras)
    projected = lines.project()
    behind = _distance_behind(sources, projected)
    return _weights(rays, _InImages(projected, lines.viewing_cosines(), behind)).sum(1).float()


def _weights(rays: Rays, in_images: _InImages) -> Float[Tensor, "ray sample view"]:
    """Prior weights of the cameras, not normalised."""
    near = F.softsign(in_images.behind / (NEAR * rays.scale.size_m))
    return in_images.projected.in_view * _closeness(in_images.cosines, near)


class CameraLines(NamedTuple):
    """Rays as lines in the image of every camera, or of those chosen for each ray; in double precision.

    b is the step along a ray per metre of z-depth, and c leads from a camera to the viewer.
    """

    rays: Rays
    step: Float[Tensor, "ray view 4"]
    """Step per metre in homogeneous image coordinates, and b c."""
    constants: Float[Tensor, "*ray view 7"]
    """Start in homogeneous image coordinates; the image's width and height, and infinity; and c c."""

    @classmethod
    def of(cls, rays: Rays, cameras: Cameras, chosen: Int[Tensor, "ray view"] | None = None) -> "CameraLines":
        """The lines in these cameras."""
        linear, start = _projection_from(rays.origin, cameras)
        host = _on_host(cameras)
        c = rays.origin - host.centers.double()
        end = F.pad(host.size_px.double(), (0, 1), value=torch.inf)
        numbers = [linear.flatten(1), c, start, end, c.square().sum(-1, keepdim=True)]
        in_one_copy = torch.cat(numbers, 1).to(rays.z_m.device)
        step = rays.directions @ in_one_copy[:, :12].unflatten(1, (4, 3)).mT
        step = step.movedim(0, 1)
        constants = in_one_copy[:, 12:]
        if chosen is not None:
            step = step.gather(1, chosen[..., None].expand(-1, -1, 4))
            constants = constants[chosen]
        return cls(rays, step, constants)

    def first(self, count: int) -> "CameraLines":
        """Those in the first cameras."""
        return CameraLines(self.rays, self.step[:, :count], self.constants[..., :count, :])

    def project(self) -> Projections:
        """The position of every sample."""
        z = self.rays.z_m[:, :, None, None]
        start, end, _ = self.constants.unsqueeze(-3).split((3, 3, 1), -1)
        homogeneous = torch.addcmul(start, self.step[:, None, :, :3], z)
        w = homogeneous[..., 2:]
        uvw = torch.cat([homogeneous[..., :2] / w.clamp_min(1e-6), w], -1)
        in_view = ((uvw >= 0) & (uvw < end)).all(-1) & (z > 0)[..., 0]
        visible = uvw * in_view[..., None]
        return Projections(uv_px=visible[..., :2], z_m=visible[..., 2], in_view=in_view)

    def viewing_cosines(self) -> Float[Tensor, "ray sample view"]:
        """Cosine of the angle at each sample between the viewer and each camera.

        Seen from the viewer, the sample lies along z b, and so it lies along v = z b + c seen from the camera. The
        square of the product of both lengths is that of v b plus that of the vector product v x b. This is c x b,
        which all samples of a ray share.
        """
        z = self.rays.z_m[..., None]
        b_b = self.rays.directions.square().sum(-1)[:, None]
        b_c = self.step[..., 3]
        across = torch.addcmul(b_b * self.constants[..., 6], b_c, b_c, value=-1).clamp_min(1e-24)
        along = torch.addcmul(b_c[:, None], z, b_b[:, None])
        return along * torch.addcmul(across[:, None], along, along).rsqrt()


def _projection_from(
    origin: Float[Tensor, "3"], cameras: Cameras
) -> tuple[Float[Tensor, "view 3 3"], Float[Tensor, "view 3"]]:
    """Turns a step in world coordinates into one in homogeneous image coordinates; and the origin there; on the CPU."""
    P = _on_host(cameras).projection
    linear = P[:, :, :3]
    return linear, linear @ origin + P[:, :, 3]


def _project_into_all(
    rays: Rays, sources: SourceCameras, chosen: Int[Tensor, "ray view"] | None = None
) -> tuple[Projections, Float[Tensor, "ray sample view"], Projections]:
    """Projections into the source cameras, or those chosen for each ray, with their viewing cosines, and into the rig.

    The rig are the cameras of the silhouettes.
    """
    source_cameras = sources.cameras
    rig = sources.silhouettes.cameras
    if torch.compiler.is_exporting():  # an exported model cannot split an unknown number of cameras
        lines = CameraLines.of(rays, source_cameras, chosen)
        return lines.project(), lines.viewing_cosines(), CameraLines.of(rays, rig).project()

    # Project into all of them at once. The silhouettes' cameras come after the source cameras.
    num_sources = source_cameras.K.shape[0]
    num_rig = rig.K.shape[0]
    index = None
    if chosen is not None:
        rig_index = torch.arange(num_sources, num_sources + num_rig, device=chosen.device)
        index = torch.cat([chosen, rig_index.expand(len(chosen), -1)], 1)
    together = CameraLines.of(rays, concatenate_cameras([_on_host(source_cameras), _on_host(rig)]), index)

    # Split the projections
    counts = [num_sources if chosen is None else chosen.shape[1], num_rig]
    split = zip(*(values.split(counts, 2) for values in together.project()), strict=True)
    of_images, of_silhouettes = (Projections(*parts) for parts in split)
    return of_images, together.first(counts[0]).viewing_cosines(), of_silhouettes


def sample_level(
    levels: MipLevels, projected: Projections, channels: int
) -> Float[Tensor, "*level ray sample view channel"]:
    """The first channels of each camera's image, interpolated bilinearly and divided by 255.

    Meaningless where a sample is not in view.
    """
    position = projected.uv_px * levels.scale[..., None] + 0.5
    whole = position.long()
    share = (position - whole).float()
    column, row = whole.unbind(-1)
    offset = torch.addcmul(column, row, levels.columns)
    pixels = levels.pixels[:, :channels]
    if torch.compiler.is_exporting():
        upper, lower = (offset + first for first in levels.first.unbind(-1))
        return _between_four(pixels, upper, lower, share) / 255

    # Two pixels in each of two rows; those of a row follow each other
    neighbours = pixels.unfold(0, 2, 1)
    left, right = (_look_up(neighbours, offset[..., None] + levels.first) / 255).unbind(-1)
    across, down = share[..., None].unbind(-2)
    upper, lower = left.lerp(right, across[..., None]).unbind(-2)
    return upper.lerp(lower, down)


def _between_four(
    pixels: Shaped[Tensor, "pixel channel"],
    upper: Int[Tensor, "*sample"],
    lower: Int[Tensor, "*sample"],
    share: Float[Tensor, "*sample 2"],
) -> Float[Tensor, "*sample channel"]:
    """Bilinear interpolation between the pixels at `upper` and `lower`, and their right neighbours.

    In ONNX Runtime, this takes a fifth of the time of sums over an axis of four. A GPU would need more
    kernels for it.
    """
    right, down = share[..., None].unbind(-2)
    left_values = [_look_up(pixels, first).to(share) for first in (upper, lower)]
    right_values = [_look_up(pixels, first + 1).to(share) for first in (upper, lower)]
    rows = [start + right * (end - start) for start, end in zip(left_values, right_values, strict=True)]
    return rows[0] + down * (rows[1] - rows[0])


def sample_level_cubic(
    levels: MipLevels, projected: Projections, channels: int
) -> Float[Tensor, "ray sample view channel"]:
    """`sample_level` by Catmull-Rom splines (Catmull & Rom, 1974), clamped to [0, 1]."""
    position = projected.uv_px * levels.scale[..., None] + 0.5
    whole = position.long()
    share = (position - whole).float()

    # The sixteen pixels around each position, or those at the border
    tap = torch.arange(-1, 3, device=share.device)
    place = (whole[..., None] + tap).clamp_min(0)
    column, row = torch.minimum(place, levels.last[..., None]).unbind(-2)
    first = torch.addcmul(levels.first[..., :1], row, levels.columns[..., None])
    index = first[..., None] + column[..., None, :]
    squared = share * share
    powers = torch.stack([torch.ones_like(share), share, squared, squared * share], -1)
    across, down = (powers @ share.new_tensor(CATMULL_ROM)).unbind(-2)
    weight = down[..., :, None] * across[..., None, :]
    values = _look_up(levels.pixels[:, :channels], index).flatten(-3, -2).to(weight)
    total = (weight.flatten(-2)[..., None, :] @ values)[..., 0, :]
    return (total / 255).clamp(0, 1)


def _on_host(cameras: Cameras) -> Cameras:
    """The cameras on the CPU, where values per camera are computed; unchanged while `torch.export` traces."""
    return cameras if cameras.K.device.type == "cpu" else cameras.on_host


def box_side_px(size: float | Float[Tensor, "size"], subject_px: float | Tensor) -> Int[Tensor, "..."]:
    """Lengths in subject sizes as whole pixels, at least 1."""
    return torch.as_tensor(size * subject_px, dtype=torch.double).round().clamp_min(1).long()


def _box_sides(
    mask_sums: Int[Tensor, "view"], silhouette_sums: Int[Tensor, "camera"]
) -> tuple[Tensor, Tensor, Tensor]:
    """Sides, in pixels, of boxes of masks, of every second pixel of colours, and of silhouettes."""
    source_px = (mask_sums / 255).mean().sqrt()
    rig_px = (silhouette_sums / 255).mean().sqrt()
    return box_side_px(AROUND, source_px), box_side_px(PATCH / 2, source_px), box_side_px(AROUND, rig_px)


def _smallest_rig_masks(
    sources: SourceCameras, projected: Projections, side: Int[Tensor, ""]
) -> tuple[Float[Tensor, "ray sample 2"], ...]:
    """The smallest masks of all cameras of the rig, single and averaged over boxes of this side."""
    masks = sources.silhouettes.mask[:, None].float()
    silhouettes = _sample_with_means(masks, [(1, side)], projected)
    return _smallest_masks(projected, torch.stack(tuple(silhouettes))[..., 0])


def _smallest_masks(
    projected: Projections, masks: Float[Tensor, "kind=2 ray sample view"]
) -> tuple[Float[Tensor, "ray sample 2"], ...]:
    """The two smallest masks and the two smallest averaged masks where samples are in view; 1 if there are none."""
    seen = masks.masked_fill(~projected.in_view, 1.0)
    if torch.compiler.is_exporting() or seen.shape[-1] < 2:  # an exported model takes any number of cameras
        seen = F.pad(seen, (0, 1), value=1.0)
    return seen.topk(2, largest=False).values.unbind(0)


def _sample_numba(
    rays: Rays,
    sources: SourceCameras,
    images: CameraImages,
    silhouettes: CameraImages,
    min_coverage: float,
    cubic: bool = False,
) -> RaySamples:
    """Samples with compiled kernels; for `RayFill`, `min_coverage` is above 0."""
    from viewmend.models.views import _sampler_numba

    kernels: Any = _sampler_numba
    count, samples = rays.z_m.shape
    names = sources.cameras.names
    for_fill = min_coverage > 0

    # What the kernels write
    chosen = np.tile(np.arange(len(names)), (count, 1)) if rays.cameras is None else rays.cameras.numpy()
    channels = sum(CAMERA_CHANNELS) if for_fill else NUM_FEATURES
    features = np.empty((count, samples, chosen.shape[1], channels), np.float32)
    prior = np.zeros((count, samples, chosen.shape[1]), np.float32)
    statistics = np.ones((count, samples, NUM_STATISTICS), np.float32)
    smallest_masks = statistics[..., -STATISTICS_CHANNELS[-1] :]

    # What they read of rays and cameras
    z = rays.z_m.float().numpy()
    directions = rays.directions.numpy()
    offsets = (sources.cameras.centers.double() - rays.origin).numpy()
    camera_lines = _lines(rays, sources.cameras)
    silhouette_lines = _lines(rays, sources.silhouettes.cameras)
    depths = [depth.numpy() for depth in sources.views.per_camera("depth")]
    is_source = [float(name in rays.view.source_views) for name in names]
    size_m = float(rays.scale.size_m)

    band_rays = -(-BAND // samples)

    def work(band: int) -> None:
        first = band * band_rays
        end = min(count, first + band_rays)
        for n, (per_metre, start, size) in enumerate(camera_lines):
            samples_in_camera = (chosen, z, directions, per_metre, start, offsets[n], size)
            camera = (*images[n], depths[n], size_m, is_source[n])
            kernels.sample_camera(
                first, end, n, *samples_in_camera, *camera, min_coverage, cubic, features, prior
            )
        if not for_fill:
            kernels.compare_cameras(first, end, features, prior, statistics)
        for (per_metre, start, size), (masks, scales) in zip(silhouette_lines, silhouettes, strict=True):
            kernels.compare_silhouette(first, end, z, per_metre, start, size, masks, scales, smallest_masks)

    parallel_for(work, -(-count // band_rays))
    return RaySamples(
        torch.from_numpy(features), torch.from_numpy(prior), torch.from_numpy(statistics), rays.cameras
    )


def _score_numba(rays: Rays, sources: SourceCameras) -> Float[Tensor, "ray camera"]:
    """`score_cameras_torch` with a compiled kernel."""
    from viewmend.models.views import _sampler_numba

    kernels: Any = _sampler_numba
    count, samples = rays.z_m.shape
    scores = np.zeros((len(sources.cameras), count), np.float32)
    z = rays.z_m.float().numpy()
    directions = rays.directions.numpy()
    offsets = (sources.cameras.centers.double() - rays.origin).numpy()
    views = _lines(rays, sources.cameras)
    depths = [depth.numpy() for depth in sources.views.per_camera("depth")]
    size_m = float(rays.scale.size_m)
    band_rays = -(-BAND // samples)

    def work(band: int) -> None:
        first = band * band_rays
        end = min(count, first + band_rays)
        for n, line in enumerate(views):
            per_metre, start, size = line
            kernels.score_camera(
                first, end, z, directions, per_metre, start, offsets[n], size, depths[n], size_m, scores[n]
            )

    parallel_for(work, -(-count // band_rays))
    return torch.from_numpy(scores).T


def _lines(rays: Rays, cameras: Cameras) -> list[tuple]:
    """The step per metre and the start in homogeneous image coordinates, and the image size, of each camera."""
    linear, start = _projection_from(rays.origin, cameras)
    per_metre = rays.directions @ linear.mT
    sizes = [tuple(size) for size in cameras.size_px.tolist()]
    return list(zip(per_metre.numpy(), start.numpy(), sizes, strict=True))


def _at_levels(pyramids: Sequence[Pyramid], levels: Sequence[Sequence[int]]) -> CameraImages:
    """Two levels of each pyramid, and their scales. The wide one is repeated: `sample_camera` takes three images."""
    found = []
    for pyramid, (fine, wide) in zip(pyramids, levels, strict=True):
        images = tuple(pyramid.levels[level].numpy() for level in (fine, wide, wide))
        found.append((images, (0.5**fine, 0.5**wide, 0.5**wide)))
    return found
