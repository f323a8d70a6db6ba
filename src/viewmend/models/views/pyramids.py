"""Source cameras with image pyramids: samples are taken at the level that matches the footprint of a pixel."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int, Shaped, UInt8
from torch import Tensor
from torch.nn import functional as F

from viewmend.geometry.cameras import Cameras
from viewmend.geometry.threads import parallel_for
from viewmend.models.base import ContextProvider
from viewmend.models.views.config import AROUND
from viewmend.types import ContextViews, IncompleteView, Silhouettes

Levels = Int[Tensor, "view"]
SMALLEST_PX = 4
"""An image is halved until a side is no longer than this, pixels."""
AREA_LEVEL = 2
"""The subject's area is measured at this level."""
CPU_RAYS = 1024
"""A chunk has this many rays on the CPU: the samples of more do not fit the cache."""
GPU_RAYS = 16384
"""A chunk has this many rays on a GPU, where memory is the limit."""


@dataclass(frozen=True)
class SceneScale:
    """Units of a view's lengths; a crop of a view uses those of the whole view."""

    size_m: float | Float[Tensor, ""]
    """Size of the subject in metres: the root of its area at its median depth."""
    depth_m: float | Float[Tensor, ""]
    """Median z-depth of the proxy in metres."""
    subject_px: float | Float[Tensor, ""]
    """Root of the subject's area in the view. All three are tensors while `torch.export` traces."""

    @classmethod
    def of(cls, view: IncompleteView) -> "SceneScale":
        """The scale of a view; 1 metre for both lengths if the proxy covers nothing."""
        covered = view.depth > 0
        if torch.compiler.is_exporting():
            count = covered.sum()
            ordered = torch.where(covered, view.depth, torch.inf).flatten().sort().values
            median = ordered[((count - 1).clamp_min(0) // 2)]
            area = (view.mask > 0).sum()
            size_m = torch.where(count > 0, _size_m(area, median, view.camera), 1.0)
            depth_m = torch.where(count > 0, median, 1.0)
            return cls(size_m, depth_m, area.sqrt().double())
        return cls.with_count(view, covered)[0]

    @classmethod
    def with_count(
        cls, view: IncompleteView, pixels: Bool[Tensor, "height width"]
    ) -> "tuple[SceneScale, int]":
        """The scale of a view, and the number of these pixels; waits for a GPU only once."""
        counts = [some.sum(dtype=torch.double) for some in (view.mask > 0, pixels)]
        median_m = view.depth.masked_fill(view.depth <= 0, torch.nan).nanmedian()
        area, count, median = torch.stack([*counts, median_m.double()]).cpu()
        subject_px = float(area.float().sqrt())
        if bool(median.isnan()):
            return cls(1.0, 1.0, subject_px), int(count)
        size_m = _size_m(area.long(), median.float(), view.camera.on_host)
        return cls(float(size_m), float(median), subject_px), int(count)

    def depths_behind(
        self, depth_m: Float[Tensor, "ray"], offsets: Sequence[float]
    ) -> Float[Tensor, "ray sample"]:
        """z-depths, metres, that lie these subject sizes behind a depth."""
        offsets_m = self.size_m * torch.tensor(offsets)
        return depth_m[:, None] + offsets_m.to(depth_m.device)


def _size_m(area_px: Int[Tensor, ""], median_m: Float[Tensor, ""], camera: Cameras) -> Float[Tensor, ""]:
    """The root of a subject's area at its median depth, metres."""
    focal_px = (camera.K[0, 0, 0] * camera.K[0, 1, 1]).sqrt()
    return area_px.clamp_min(1).sqrt() * median_m / focal_px


class MipLevels(NamedTuple):
    """Images of each camera, as rows of pixels one after the other; each image has a border of one black pixel.

    `*level` is empty for one image per camera, and "level 1 1" for several levels of a pyramid.
    """

    pixels: Shaped[Tensor, "pixel channel"]
    """0 to 255, or metres."""
    layout: Int[Tensor, "*level view 5"]
    """The positions of each image's pixels: `first`, `columns` and `last`."""
    scale: Float[Tensor, "*level view"]
    """Factor from positions in the camera's image to positions in this one."""

    @property
    def first(self) -> Int[Tensor, "*level view 2"]:
        """Indices of the first pixels of each image's first two rows."""
        return self.layout[..., :2]

    @property
    def columns(self) -> Int[Tensor, "*level view"]:
        """Pixels from one row to the next."""
        return self.layout[..., 2]

    @property
    def last(self) -> Int[Tensor, "*level view 2"]:
        """Column and row of each image's last pixel, which is in its border."""
        return self.layout[..., 3:]

    @classmethod
    def of(cls, pyramids: Sequence["Pyramid"], levels: Sequence[Sequence[int]]) -> "MipLevels":
        """Several levels of each pyramid; `levels` has a row for each of them."""
        images = [
            pyramid.levels[level] for own in levels for pyramid, level in zip(pyramids, own, strict=True)
        ]
        pixels = torch.cat([image.flatten(0, 1) for image in images])
        sizes = [image.shape[:2] for image in images]
        return cls._of_rows(pixels, sizes, [0.5**level for own in levels for level in own], len(levels))

    @classmethod
    def scaled(
        cls, images: Sequence[Shaped[Tensor, "view channel _rows _columns"]], scales: Sequence[float]
    ) -> "MipLevels":
        """The images of all views at several scales, which get their borders; one of `scales` for each level."""
        bordered = [F.pad(level.movedim(1, 3), (0, 0, 1, 1, 1, 1)) for level in images]
        pixels = torch.cat([level.flatten(0, 2) for level in bordered])
        sizes = [image.shape[:2] for level in bordered for image in level]
        of_each = [scale for level, scale in zip(images, scales, strict=True) for _ in level]
        return cls._of_rows(pixels, sizes, of_each, len(images))

    @classmethod
    def _of_rows(
        cls,
        pixels: Shaped[Tensor, "pixel channel"],
        sizes: Sequence[Sequence[int]],
        scales: Sequence[float],
        levels: int,
    ) -> "MipLevels":
        """Rows of pixels of images of these sizes (rows and columns with the border), level by level.

        What describes them is computed on the CPU, and copied to a device at once.
        """
        rows, columns = torch.tensor([list(size) for size in sizes]).unbind(1)
        count = rows * columns
        first = count.cumsum(0) - count
        shape = (levels, 1, 1, len(sizes) // levels)
        layout = torch.stack([first, first + columns, columns, columns - 1, rows - 1], 1)
        scale = torch.tensor(scales, dtype=torch.double).view(shape)
        return cls(pixels, layout.view(*shape, 5).to(pixels.device), scale.to(pixels.device))

    def at(self, level: int) -> "MipLevels":
        """One of the levels."""
        return MipLevels(self.pixels, self.layout[level], self.scale[level])

    @classmethod
    def full(cls, images: Shaped[Tensor, "view channel height width"]) -> "MipLevels":
        """Images at full resolution, which get their borders."""
        bordered = F.pad(images, (1, 1, 1, 1))
        rows, columns = bordered.shape[2:]
        # len(images) would make the number of cameras of an exported model constant.
        view = torch.arange(images.shape[0], device=images.device)
        first = view * (rows * columns)
        sizes = [0 * view + size for size in (columns, columns - 1, rows - 1)]
        return cls(
            pixels=bordered.movedim(1, 3).flatten(0, 2),
            layout=torch.stack([first, first + columns, *sizes], 1),
            scale=torch.ones_like(view, dtype=torch.double),
        )

    def of_cameras(self, index: Int[Tensor, "ray chosen"]) -> "MipLevels":
        """The levels of the cameras chosen for each ray: the fields get the shape [level, ray, 1, chosen, ...]."""
        at = index[:, None]
        return MipLevels(self.pixels, self.layout[:, 0, 0][:, at], self.scale[:, 0, 0][:, at])


def choose_levels(
    cameras: Cameras,
    last: Levels,
    subject_px: Float[Tensor, "view"],
    viewer: Cameras,
    step_px: float,
    scale: SceneScale,
) -> tuple[Levels, Levels]:
    """The fine and the wide pyramid level of each source camera.

    Args:
        cameras: the source cameras.
        last: the coarsest level of each.
        subject_px: root of the subject's area in each.
        viewer: the camera of the novel view.
        step_px: distance of rays in the novel view.
        scale: the scale of the novel view.
    """
    footprint_px = step_px * pixel_footprints(cameras, viewer, scale)
    fine = torch.minimum(_level_of(footprint_px), last)
    wide = torch.minimum(_level_of(AROUND * subject_px), last)
    return fine, torch.maximum(fine, wide)


def pixel_footprints(cameras: Cameras, viewer: Cameras, scale: SceneScale) -> Float[Tensor, "view"]:
    """Size of a novel view's pixel at the subject in each source camera, in pixels of its image."""
    pose = viewer.world_from_camera[0].double()
    depth_m = torch.as_tensor(scale.depth_m, dtype=torch.double)
    subject_center = pose[:3, 3] + depth_m * pose[:3, 2]
    distance_m = (cameras.centers - subject_center).square().sum(-1).sqrt().clamp_min(1e-6)
    return depth_m / viewer.K[0, 0, 0] * cameras.K[:, 0, 0] / distance_m


def _level_of(pixel_size: Float[Tensor, "view"]) -> Levels:
    """The level whose pixels are closest to this size, in pixels of the camera's image."""
    return pixel_size.clamp_min(1).log2().round().long()


@dataclass(frozen=True)
class Pyramid:
    """A camera's image at all scales, each half of the one before, with a border of one black pixel."""

    levels: tuple[UInt8[Tensor, "_rows _columns channel"], ...]
    subject_px: float
    """Root of the subject's area."""
    mask_sum: int
    """Sum of the mask, 0 to 255, over all pixels."""


@dataclass(frozen=True)
class SourceCameras:
    """Source cameras of one frame with their pyramids, and the silhouettes of the whole rig with theirs."""

    views: ContextViews
    pyramids: tuple[Pyramid, ...]
    """RGB on black, mask, and coverage by the proxy, of each of `views`."""
    silhouettes: Silhouettes
    silhouette_pyramids: tuple[Pyramid, ...]

    @classmethod
    def of(
        cls, views: ContextViews, silhouettes: Silhouettes | None, context: ContextProvider | None = None
    ) -> "SourceCameras":
        """Cameras with their pyramids, which `context` caches; `silhouettes` are the masks of `views` by default."""
        if silhouettes is None:
            silhouettes = Silhouettes(view_masks(views), views.frame.cameras)
        if context is None:
            return cls(views, view_pyramids(views), silhouettes, silhouette_pyramids(silhouettes))
        time = views.frame.time
        device = silhouettes.mask.device
        pyramids = context.remembered(
            time, "views", views.frame.cameras.names, lambda new: view_pyramids(views.select(new)), device
        )
        masks = context.remembered(
            time,
            "silhouettes",
            silhouettes.cameras.names,
            lambda new: silhouette_pyramids(silhouettes.select(new)),
            device,
        )
        return cls(views, tuple(pyramids), silhouettes, tuple(masks))

    @classmethod
    def closest_to(cls, view: IncompleteView, context: ContextProvider, count: int) -> "SourceCameras | None":
        """The source views of a view and the closest others, `count` in all; None if none is available."""
        names = view.closest_views(count)
        if not names:
            return None
        views = context(view.time, names)
        return None if views is None else cls.of(views, view.silhouettes, context)

    def first(self, count: int) -> "SourceCameras":
        """The first `count` cameras; all silhouettes stay."""
        names = self.views.frame.cameras.names[:count]
        return replace(self, views=self.views.select(names), pyramids=self.pyramids[: len(names)])

    @property
    def use_kernels(self) -> bool:
        """Whether compiled kernels can sample them."""
        return self.silhouettes.mask.device.type == "cpu"

    @property
    def rays_at_once(self) -> int | None:
        """Rays per chunk; None for all."""
        return CPU_RAYS if self.use_kernels else GPU_RAYS

    @property
    def cameras(self) -> Cameras:
        """The source cameras."""
        return self.views.frame.cameras

    @property
    def images(self) -> UInt8[Tensor, "view 5 height width"]:
        """RGB on black, mask and coverage by the proxy, of each source camera."""
        width, height = self.cameras.max_size_px
        images = [pyramid.levels[0][1:-1, 1:-1].movedim(2, 0) for pyramid in self.pyramids]
        if any(image.shape[1:] != (height, width) for image in images):
            images = [F.pad(own, (0, width - own.shape[2], 0, height - own.shape[1])) for own in images]
        return torch.stack(images)

    @property
    def mask_sums(self) -> tuple[Int[Tensor, "view"], Int[Tensor, "silhouette"]]:
        """Sum of each source camera's mask, 0 to 255, over all pixels, and of each silhouette; on the CPU."""
        of_views = torch.tensor([pyramid.mask_sum for pyramid in self.pyramids])
        return of_views, torch.tensor([pyramid.mask_sum for pyramid in self.silhouette_pyramids])

    def is_source(self, names: Sequence[str]) -> Float[Tensor, "view"]:
        """1 for source cameras that have one of these names, else 0."""
        device = self.silhouettes.mask.device
        return torch.tensor([float(name in names) for name in self.cameras.names], device=device)

    def levels(self, viewer: Cameras, step_px: float, scale: SceneScale) -> list[list[list[int]]]:
        """Fine and wide level of each source camera, and of each silhouette; see `choose_levels`."""
        found = []
        for cameras, pyramids in self._parts:
            last = torch.tensor([len(pyramid.levels) - 1 for pyramid in pyramids])
            subject_px = torch.tensor([pyramid.subject_px for pyramid in pyramids])
            levels = choose_levels(cameras.on_host, last, subject_px, viewer.on_host, step_px, scale)
            found.append(torch.stack(levels, 1).tolist())
        return found

    def mips(self, viewer: Cameras, step_px: float, scale: SceneScale) -> tuple[MipLevels, MipLevels]:
        """The fine and the wide level of each source camera, and of each camera of the silhouettes."""
        images, outlines = self.levels(viewer, step_px, scale)
        return (
            MipLevels.of(self.pyramids, list(zip(*images, strict=True))),
            MipLevels.of(self.silhouette_pyramids, list(zip(*outlines, strict=True))),
        )

    def magnification(self, viewer: Cameras, scale: SceneScale) -> float | Float[Tensor, ""]:
        """How many pixels of the novel view a pixel of the sharpest source camera fills along a side, at least 1.

        An exported model computes it as a tensor.
        """
        largest = float(pixel_footprints(self.cameras.on_host, viewer.on_host, scale).amax())
        return max(1.0, 1 / max(largest, 1e-6))

    @property
    def _parts(self) -> list[tuple[Cameras, tuple[Pyramid, ...]]]:
        """The source cameras and the cameras of the silhouettes, each with their pyramids."""
        return [(self.cameras, self.pyramids), (self.silhouettes.cameras, self.silhouette_pyramids)]


def source_images(
    rgb: UInt8[Tensor, "view 3 height width"],
    mask: UInt8[Tensor, "view height width"],
    depth: Float[Tensor, "view height width"],
) -> UInt8[Tensor, "view 5 height width"]:
    """RGB on black, mask, and coverage by the proxy."""
    on_black = (rgb.int() * mask[:, None].int() + 127) // 255
    coverage = 255 * (depth > 0)[:, None].to(torch.uint8)
    return torch.cat([on_black.to(torch.uint8), mask[:, None], coverage], 1)


def view_pyramids(views: ContextViews) -> tuple[Pyramid, ...]:
    """The pyramids of the `source_images` of every camera."""
    all_rgb = views.frame.per_camera("rgb")
    all_masks = views.frame.per_camera("mask") or view_masks(views)
    all_depth = views.per_camera("depth")

    def base(view: int, width: int, height: int) -> UInt8[Tensor, "rows columns 5"]:
        rgb = all_rgb[view][:, :height, :width]
        mask = all_masks[view][:height, :width]
        depth = all_depth[view][:height, :width]
        if rgb.device.type != "cpu":
            image = source_images(rgb[None], mask[None], depth[None])[0]
            return F.pad(image.permute(1, 2, 0), (0, 0, 1, 1, 1, 1))
        from viewmend.models.views._sampler_numba import premultiply

        bordered = torch.zeros(height + 2, width + 2, 5, dtype=torch.uint8)
        premultiply(rgb.numpy(), mask.numpy(), depth.numpy(), bordered.numpy())
        return bordered

    return _pyramids(views.frame.cameras, base, mask_channel=3)


def silhouette_pyramids(silhouettes: Silhouettes) -> tuple[Pyramid, ...]:
    """The pyramids of the masks of every camera."""

    def base(view: int, width: int, height: int) -> UInt8[Tensor, "rows columns 1"]:
        return F.pad(silhouettes.mask[view, :height, :width, None], (0, 0, 1, 1, 1, 1))

    return _pyramids(silhouettes.cameras, base, mask_channel=0)


def downsample2x(image: UInt8[Tensor, "rows columns channel"]) -> UInt8[Tensor, "_rows _columns channel"]:
    """Rounded means of 2 x 2 pixels; both images have a border of one black pixel, which also completes odd sides."""
    rows, columns, channels = image.shape
    if image.device.type == "cpu":
        from viewmend.models.views._sampler_numba import halve

        half = torch.zeros((rows - 1) // 2 + 2, (columns - 1) // 2 + 2, channels, dtype=torch.uint8)
        halve(image.numpy(), half.numpy())
        return half
    inner = F.pad(image[1:-1, 1:-1].permute(2, 0, 1).float(), (0, columns % 2, 0, rows % 2))
    means = (F.avg_pool2d(inner[None], 2)[0] + 0.5).floor()
    return F.pad(means.to(torch.uint8).permute(1, 2, 0), (0, 0, 1, 1, 1, 1))


def view_masks(views: ContextViews) -> UInt8[Tensor, "view height width"]:
    """The views' masks; what the proxy covers if they have none."""
    if views.frame.mask is None:
        return (255 * (views.depth > 0)).to(torch.uint8)
    return views.frame.mask


def _pyramids(
    cameras: Cameras, base: Callable[[int, int, int], Tensor], mask_channel: int
) -> tuple[Pyramid, ...]:
    """The pyramid of every camera. Its finest level is base(view, width, height)."""
    made: dict[int, Pyramid] = {}
    sizes = cameras.size_px.tolist()

    def work(view: int) -> None:
        levels = [base(view, *sizes[view])]
        while min(levels[-1].shape[:2]) - 2 > SMALLEST_PX:
            levels.append(downsample2x(levels[-1]))
        level = min(AREA_LEVEL, len(levels) - 1)
        sums = torch.stack([levels[at][..., mask_channel].sum(dtype=torch.long) for at in (0, level)])
        mask_sum, coarse_sum = sums.tolist()
        area_px = coarse_sum / 255 * 4**level
        made[view] = Pyramid(tuple(levels), max(1.0, math.sqrt(area_px)), mask_sum)

    parallel_for(work, len(sizes))
    return tuple(made[view] for view in range(len(sizes)))
