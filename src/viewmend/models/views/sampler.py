"""Samples the source cameras at points on the rays of a novel view, as IBRNet does (Wang et al., CVPR 2021).

Both networks of the default model take their inputs from here: `ViewSynthNet` by `sample_rays`, from image pyramids;
`RayFill` by `sample_fill_rays`, from full images and box means. The code in PyTorch is the reference for any device,
and what `torch.export` traces. On the CPU, compiled kernels replace it (`_sampler_numba.py`).
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Shaped, UInt8
from torch import Tensor
from torch.nn import functional as F

from viewmend.geometry.cameras import Cameras
from viewmend.geometry.threads import parallel_for
from viewmend.models.views.config import AROUND, CONTRAST, FAR, FEATURES, NEAR, STATISTICS
from viewmend.models.views.pyramids import MipLevels, Pyramid, SceneScale, SourceCameras
from viewmend.types import IncompleteView

Levels = Sequence[tuple]
"""The images of each camera, and their scales."""
CAMERA_CHANNELS = (3, 1, 1, 1, 1, 1, 1, 3, 1, 1)
"""Channels of each field of `CameraFeatures`."""
PATCH = 0.08
"""Side, in subject sizes, of the squares over which `RayFill` averages colours: single pixels agree by chance."""
LEAST_SHARE = 0.3
"""`RayFill` measures the distance behind the proxy where this share of a pixel is covered by it."""
BAND = 128
"""Rays that a thread takes at a time."""


class Rays(NamedTuple):
    """Rays of a novel view, and sample positions on them."""

    view: IncompleteView
    """The novel view, or a crop of it."""
    scale: SceneScale
    """Of the whole view."""
    uv_px: Float[Tensor, "ray 2"]
    z_m: Float[Tensor, "ray sample"]
    """z-depth; a sample at 0 is in no view."""

    def split(self, size: int | None) -> "list[Rays]":
        """Chunks of `size` rays; None gives one chunk."""
        if size is None:
            return [self]
        parts = zip(self.uv_px.split(size), self.z_m.split(size), strict=True)
        return [Rays(self.view, self.scale, *part) for part in parts]

    @property
    def origin(self) -> Float[Tensor, "3"]:
        """The viewer's position, metres."""
        return self.view.camera.centers[0].double()

    @property
    def world_from_pixel(self) -> Float[Tensor, "3 3"]:
        """From (u, v, 1) to what a pixel's ray gains per metre of z-depth: R K^-1; ONNX has no inverse."""
        camera = self.view.camera
        K, rotation = camera.K[0].double(), camera.camera_from_world[0, :3, :3].double().T
        fx, skew, cx, fy, cy = K[0, 0], K[0, 1], K[0, 2], K[1, 1], K[1, 2]
        zero, one = torch.zeros_like(fx), torch.ones_like(fx)
        rows = (1 / fx, -skew / (fx * fy), (skew * cy - cx * fy) / (fx * fy)), (zero, 1 / fy, -cy / fy)
        return rotation @ torch.stack([torch.stack(row) for row in (*rows, (zero, zero, one))])

    @property
    def directions(self) -> Float[Tensor, "ray 3"]:
        """What each ray gains per metre of z-depth, world coordinates."""
        uv = self.uv_px.double()
        return torch.cat([uv, torch.ones_like(uv[:, :1])], 1) @ self.world_from_pixel.T


class RaySamples(NamedTuple):
    """Samples on rays."""

    features: Float[Tensor, "ray sample view feature"]
    """`CameraFeatures`, stacked; of `sample_rays` all of `config.FEATURES`."""
    prior: Float[Tensor, "ray sample view"]
    """Initial weights of the cameras, of `sample_rays` only: high near the viewer, and where the sample is not far
    behind the proxy. The sum is 1, or 0 where no camera has the sample in view."""
    statistics: Float[Tensor, "ray sample 10"]
    """See `config.STATISTICS`; of `sample_fill_rays` only the masks."""


class CameraFeatures(NamedTuple):
    """What each source camera has at ray samples; zeros where the sample is not in view."""

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
    """Mask averaged over `AROUND`: low near an outline. Hulls are too large where outlines of two cameras meet."""
    mean_coverage: Float[Tensor, "ray sample view 1"]
    """Coverage by the proxy averaged over `AROUND`: above `mean_mask` where the proxy is too large."""

    @classmethod
    def unstack(cls, stacked: Float[Tensor, "ray sample view 14"]) -> "CameraFeatures":
        """The fields as views of stacked features."""
        return cls(*stacked.split(CAMERA_CHANNELS, -1))


def sample_rays(rays: Rays, sources: SourceCameras, step_px: float, cubic: bool = False) -> RaySamples:
    """Samples the pyramid levels of the source cameras that match rays which are `step_px` apart.

    With `cubic`, colours and masks are interpolated by Catmull-Rom splines, which are sharper than bilinear ones.
    """
    if torch.compiler.is_exporting():
        return sample_rays_torch(rays, sources, step_px, cubic)
    with torch.autocast(rays.z_m.device.type, enabled=False):  # positions need more than eight bits
        if not sources.use_kernels:
            return sample_rays_torch(rays, sources, step_px, cubic)
        levels = sources.levels(rays.view.camera, step_px, rays.scale)
        images, outlines = map(_at_levels, (sources.pyramids, sources.silhouette_pyramids), levels)
        return _sample_numba(rays, sources, images, outlines, 0.0, cubic)


def sample_rays_torch(rays: Rays, sources: SourceCameras, step_px: float, cubic: bool = False) -> RaySamples:
    """The reference of `sample_rays`."""
    fine, wide, outline, mean_outline = sources.mips(rays.view.camera, step_px, rays.scale)
    at, depth = project_rays(rays, sources.cameras), sources.views.depth
    rows, columns = depth.shape[1:]
    first = torch.arange(depth.shape[0], device=depth.device) * (rows * columns)
    surface = depth.flatten()[first + at.v_px.long() * columns + at.u_px.long()].double()
    behind = torch.where(surface > 0, at.z_m - surface, 0.0) / rays.scale.size_m
    values = (sample_level_cubic if cubic else sample_level)(fine, at, 4), sample_level(wide, at, 5)
    features = _camera_features(rays, sources, at, *values, behind, F.softsign)
    named = CameraFeatures.unstack(features)
    prior = named.in_view * (4 * named.viewing_cosine).exp() / (1 + (6 * named.depth_difference).exp())
    prior = prior / (prior.sum(2, keepdim=True) + 1e-6)
    mean, square = ((prior * colour).sum(2) for colour in (named.colour, named.colour.square()))
    difference = named.in_view * (named.colour - mean[:, :, None])
    at = project_rays(rays, sources.silhouettes.cameras)
    smallest = _smallest_masks(at, sample_level(outline, at, 1), sample_level(mean_outline, at, 1))
    statistics = torch.cat([mean, CONTRAST * (square - mean.square()).clamp_min(0), smallest], -1)
    return RaySamples(torch.cat([features, difference, prior], -1), prior[..., 0], statistics)


def sample_fill_rays(rays: Rays, sources: SourceCameras) -> RaySamples:
    """Samples the source cameras at full resolution, with means over boxes."""
    if not sources.use_kernels:
        return _sample_fill_rays_torch(rays, sources)
    images, masks = ([p.levels[0] for p in own] for own in (sources.pyramids, sources.silhouette_pyramids))
    sums = (torch.tensor([int(i[..., c].sum(dtype=torch.long)) for i in own]) for own, c in ((images, 3), (masks, 0)))
    side, half, outline_side = map(int, _box_sides(*sums))
    boxes = [(image, 0, 3, 2, half) for image in images] + [(image, 3, 2, 1, side) for image in images]
    boxes += [(mask, 0, 1, 1, outline_side) for mask in masks]
    means: dict[int, np.ndarray] = {}
    parallel_for(lambda n: means.update({n: _box_means(*boxes[n])}), len(boxes))
    count, scales, outline_scales = len(images), (1.0, 0.5 / half, 1 / side), (1.0, 1 / outline_side)
    views = [((image.numpy(), means[n], means[count + n]), scales) for n, image in enumerate(images)]
    outlines = [((mask.numpy(), means[2 * count + n]), outline_scales) for n, mask in enumerate(masks)]
    return _sample_numba(rays, sources, views, outlines, LEAST_SHARE)


def _sample_fill_rays_torch(rays: Rays, sources: SourceCameras) -> RaySamples:
    images, depth, masks = sources.images, sources.views.depth, sources.silhouettes.mask[:, None]
    at = project_rays(rays, sources.cameras)
    fine = sample_level(MipLevels.full(images), at, 5)
    share, surface = fine[..., 4], 255 * sample_level(MipLevels.full(depth[:, None]), at, 1)[..., 0]
    behind = torch.where(share > LEAST_SHARE, at.z_m - surface / share.clamp_min(LEAST_SHARE), 0.0) / rays.scale.size_m
    side, half, outline_side = _box_sides(images[:, 3].sum((1, 2)), masks.sum((1, 2, 3)))
    shapes = BoxSums.of(images[:, 3:]).means(at.u_px, at.v_px, side)
    for axis in (2, 3):  # gathered: `torch.export` does not know the strides of every second row and column
        images = images.index_select(axis, torch.arange(0, images.shape[axis], 2, device=images.device))
    colours = BoxSums.of(images[:, :3]).means(at.u_px / 2, at.v_px / 2, half)
    wide = torch.cat([colours, shapes], -1)
    features = _camera_features(rays, sources, at, fine[..., :4], wide, behind, torch.tanh)
    at = project_rays(rays, sources.silhouettes.cameras)
    means = BoxSums.of(masks).means(at.u_px, at.v_px, outline_side)
    smallest = _smallest_masks(at, sample_level(MipLevels.full(masks), at, 1), means)
    return RaySamples(features, 0 * features[..., 0], F.pad(smallest, (STATISTICS - 4, 0)))


def _camera_features(
    rays: Rays,
    sources: SourceCameras,
    at: "Projections",
    fine: Float[Tensor, "ray sample view 4"],
    wide: Float[Tensor, "ray sample view 5"],
    behind: Float[Tensor, "ray sample view"],
    squash: Callable[[Tensor], Tensor],
) -> Float[Tensor, "ray sample view 14"]:
    """`CameraFeatures` stacked, of images sampled at the projections, and of distances behind the proxy."""
    single = [squash(behind / NEAR), squash(behind / FAR), viewing_cosines(rays, sources.cameras)]
    single += [sources.is_source(rays.view.source_views).expand_as(behind), torch.ones_like(behind)]
    features = torch.cat([fine, torch.stack([value.float() for value in single], -1), wide], -1)
    return torch.where(at.in_view[..., None], features, 0.0)


class Projections(NamedTuple):
    """Where cameras see samples on rays; zeros where a sample is not in view."""

    u_px: Float[Tensor, "ray sample view"]
    v_px: Float[Tensor, "ray sample view"]
    z_m: Float[Tensor, "ray sample view"]
    """z-depth in the camera."""
    in_view: Bool[Tensor, "ray sample view"]


def project_lines(rays: Rays, cameras: Cameras) -> tuple[Float[Tensor, "view ray 3"], Float[Tensor, "view 3"]]:
    """Homogeneous image coordinates of rays in every camera: what they gain per metre of z-depth, and their start."""
    P = cameras.K.double() @ cameras.camera_from_world[:, :3].double()
    return rays.directions @ P[:, :, :3].mT, P[:, :, :3] @ rays.origin + P[:, :, 3]


def project_rays(rays: Rays, cameras: Cameras) -> Projections:
    """Projects every sample into every camera, in double precision."""
    per_metre, start = project_lines(rays, cameras)
    z = rays.z_m.double()[..., None]
    x, y, w = (per_metre[..., axis].T[:, None] * z + start[:, axis] for axis in range(3))
    front = (z > 0) & (w > 1e-6)
    safe = torch.where(front, w, 1.0)
    u, v = x / safe, y / safe
    width, height = cameras.size_px.double().unbind(1)
    in_view = front & (u >= 0) & (v >= 0) & (u < width) & (v < height)
    u, v, w = (torch.where(in_view, values, 0.0) for values in (u, v, w))
    return Projections(u, v, w, in_view)


def viewing_cosines(rays: Rays, cameras: Cameras) -> Float[Tensor, "ray sample view"]:
    """Cosine of the angle at each sample between the viewer and each camera."""
    back = -rays.directions
    offset = (cameras.centers.double() - rays.origin) + rays.z_m.double()[..., None, None] * back[:, None, None]
    along = (offset * back[:, None, None]).sum(-1)
    lengths = (offset.square().sum(-1) * back.square().sum(-1)[:, None, None]).sqrt()
    return along / lengths.clamp_min(1e-12)


def sample_level(levels: MipLevels, at: Projections, channels: int) -> Float[Tensor, "ray sample view channel"]:
    """The first channels of each camera's image, bilinearly, 255 as 1; meaningless where a sample is not in view."""
    x, y = at.u_px * levels.scale + 0.5, at.v_px * levels.scale + 0.5
    left, top = x.floor(), y.floor()
    right, below = (x - left).float()[..., None], (y - top).float()[..., None]
    corner = levels.first + top.long() * levels.columns + left.long()
    pixels = levels.pixels[:, :channels]
    upper = (1 - right) * pixels[corner] + right * pixels[corner + 1]
    lower = (1 - right) * pixels[corner + levels.columns] + right * pixels[corner + levels.columns + 1]
    return ((1 - below) * upper + below * lower) / 255


def sample_level_cubic(levels: MipLevels, at: Projections, channels: int) -> Float[Tensor, "ray sample view channel"]:
    """`sample_level` by Catmull-Rom splines (Catmull & Rom, 1974), clamped to [0, 1]."""
    x, y = at.u_px * levels.scale + 0.5, at.v_px * levels.scale + 0.5
    left, top = x.floor(), y.floor()
    across, down = _catmull_rom((x - left).float()), _catmull_rom((y - top).float())
    pixels = levels.pixels[:, :channels]
    last_row, last_column = (levels.size - 1).unbind(1)
    total = torch.zeros(1, device=x.device)
    for i in range(4):
        row = levels.first + torch.minimum((top.long() + i - 1).clamp_min(0), last_row) * levels.columns
        for j in range(4):
            column = torch.minimum((left.long() + j - 1).clamp_min(0), last_column)
            total = total + (down[i] * across[j])[..., None] * pixels[row + column]
    return (total / 255).clamp(0, 1)


def _catmull_rom(t: Float[Tensor, "*any"]) -> tuple[Float[Tensor, "*any"], ...]:
    """Weights of the four values around a position `t` of the way from the second to the third."""
    a = t * (t * (1 - 0.5 * t) - 0.5)
    d = 0.5 * t * t * (t - 1)
    b = t * t * (1.5 * t - 2.5) + 1
    return a, b, 1 - a - b - d, d


class BoxSums(NamedTuple):
    """Sums over all pixels above and left of each pixel corner (summed-area tables, Crow, SIGGRAPH 1984)."""

    values: Float[Tensor, "image corner_row corner_column channel"]

    @classmethod
    def of(cls, images: Shaped[Tensor, "image channel height width"]) -> "BoxSums":
        """The sums of these images."""
        return cls(F.pad(images.movedim(1, 3).double(), (0, 0, 1, 0, 1, 0)).cumsum(1).cumsum(2))

    def boxes(
        self, row: Int[Tensor, "*box image row_corner"], column: Int[Tensor, "*box image column_corner"]
    ) -> Float[Tensor, "*box image row column channel"]:
        """Sums between neighbouring corners; corners outside an image are moved to its border."""
        image = torch.arange(self.values.shape[0], device=row.device)[:, None, None]
        rows, columns = self.values.shape[1:3]
        row, column = row.clamp(0).clamp_max(rows - 1), column.clamp(0).clamp_max(columns - 1)
        corners = self.values.flatten(0, 2)[(image * rows + row[..., :, None]) * columns + column[..., None, :]]
        return corners.diff(dim=-3).diff(dim=-2)

    def means(
        self, u_px: Float[Tensor, "ray sample image"], v_px: Float[Tensor, "ray sample image"], side: Int[Tensor, ""]
    ) -> Float[Tensor, "ray sample image channel"]:
        """Means over boxes of `side` pixels, bilinear between box centres, 255 as 1; zeros outside an image."""
        x, y = u_px * (1 / side.double()) - 0.5, v_px * (1 / side.double()) - 0.5
        left, top, three = x.floor(), y.floor(), torch.arange(3, device=x.device)
        row, column = ((corner.long()[..., None] + three) * side for corner in (top, left))
        across, down = (torch.stack([1 - share, share], -1) for share in (x - left, y - top))
        weights = (down[..., :, None] * across[..., None, :])[..., None]
        return ((self.boxes(row, column) * weights).sum((-3, -2)) / (255 * side.double() ** 2)).float()


def box_side_px(size: float, subject_px: Float[Tensor, ""]) -> Int[Tensor, ""]:
    """A length in subject sizes as whole pixels, at least 1."""
    return (size * subject_px.double()).round().clamp_min(1).long()


def _box_sides(mask_sums: Int[Tensor, "view"], outline_sums: Int[Tensor, "camera"]) -> tuple[Tensor, Tensor, Tensor]:
    """Sides, in pixels, of boxes of masks, of every second pixel of colours, and of silhouettes."""
    own, rig = ((sums / 255).mean().sqrt() for sums in (mask_sums, outline_sums))
    return box_side_px(AROUND, own), box_side_px(PATCH / 2, own), box_side_px(AROUND, rig)


def _smallest_masks(
    at: Projections, mask: Float[Tensor, "ray sample view 1"], mean: Float[Tensor, "ray sample view 1"]
) -> Float[Tensor, "ray sample 4"]:
    """The two smallest masks and the two smallest averaged masks where samples are in view; 1 if there are none."""
    found = []
    for values in (mask[..., 0], mean[..., 0]):  # ONNX has no `topk` of an unknown number of cameras
        values = torch.where(at.in_view, values, 1.0)
        first = values.argmin(-1, keepdim=True)
        others = torch.where(torch.arange(values.shape[-1], device=values.device) == first, 1.0, values)
        found += [values.amin(-1), others.amin(-1)]
    return torch.stack(found, -1)


def _sample_numba(
    rays: Rays, sources: SourceCameras, images: Levels, outlines: Levels, least_share: float, cubic: bool = False
) -> RaySamples:
    """Samples with compiled kernels; for `RayFill`, `least_share` is above 0."""
    from viewmend.models.views import _sampler_numba

    kernels: Any = _sampler_numba
    count, samples = rays.z_m.shape
    channels = sum(CAMERA_CHANNELS) if least_share > 0 else FEATURES
    names, size_m = sources.cameras.names, float(rays.scale.size_m)
    features = np.empty((count, samples, len(names), channels), np.float32)
    prior, statistics = np.zeros(features.shape[:3], np.float32), np.ones((count, samples, STATISTICS), np.float32)
    z, directions, rig = rays.z_m.float().numpy(), rays.directions.numpy(), sources.silhouettes.cameras
    offsets = (sources.cameras.centers.double() - rays.origin).numpy()
    views, silhouettes = _lines(rays, sources.cameras), _lines(rays, rig)
    depths = [depth.numpy() for depth in sources.views.per_camera("depth")]
    more = [(depth, size_m, float(name in rays.view.source_views)) for depth, name in zip(depths, names, strict=True)]

    def work(band: int) -> None:
        first, end = band * BAND, min(count, (band + 1) * BAND)
        for n, (per_metre, start, size) in enumerate(views):
            camera = directions, per_metre, start, offsets[n], size, *images[n], *more[n]
            kernels.sample_camera(first, end, n, z, *camera, least_share, cubic, features, prior)
        if channels == FEATURES:
            kernels.compare_cameras(first, end, features, prior, statistics)
        for line, own in zip(silhouettes, outlines, strict=True):
            kernels.compare_silhouette(first, end, z, *line, *own, statistics[..., -4:])

    parallel_for(work, -(-count // BAND))
    return RaySamples(*map(torch.from_numpy, (features, prior, statistics)))


def _lines(rays: Rays, cameras: Cameras) -> list[tuple]:
    """`project_lines` and the image size of each camera."""
    per_metre, start = project_lines(rays, cameras)
    return list(zip(per_metre.numpy(), start.numpy(), map(tuple, cameras.size_px.tolist()), strict=True))


def _at_levels(pyramids: Sequence[Pyramid], levels: Sequence[Sequence[int]]) -> Levels:
    """Two levels of each pyramid, the wide one twice as `sample_camera` takes three images, and their scales."""
    found = []
    for pyramid, (fine, wide) in zip(pyramids, levels, strict=True):
        images = tuple(pyramid.levels[level].numpy() for level in (fine, wide, wide))
        found.append((images, (0.5**fine, 0.5**wide, 0.5**wide)))
    return found


def _box_means(
    image: UInt8[Tensor, "rows columns channel"], first: int, count: int, step: int, side: int
) -> Float[np.ndarray, "box_rows box_columns mean"]:
    """Means of `count` channels over boxes, with a border of zeros; see `_sampler_numba.average_boxes`."""
    from viewmend.models.views._sampler_numba import average_boxes

    rows, columns = (2 - (2 - length) // (step * side) for length in image.shape[:2])
    means = np.zeros((rows, columns, count), np.float32)
    average_boxes(image.numpy(), first, step, side, means)
    return means
