"""The default model as one module from tensors to tensors that `torch.export` traces for any sizes.

Layers and ray sampler are the model's own. Only image pyramids and a smooth fill are rewritten
here, with operations that do not depend on sizes or contents. Each scale of an image lies in a
canvas with at least one spare row and column, since a length of one would be traced as fixed. From
some level on all canvases are as large as those of the largest image: expressions of many nested
halves would take the compiler long.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor, nn
from torch.nn import functional as F

from viewmend.geometry.cameras import Cameras
from viewmend.geometry.rim import rim_depth
from viewmend.models.base import ContextProvider
from viewmend.models.smooth_fill import from_near, spread
from viewmend.models.views.grid import scatter_to_image
from viewmend.models.views.model import ViewSynthNet
from viewmend.models.views.pyramids import (
    AREA_LEVEL,
    SMALLEST_PX,
    MipLevels,
    SceneScale,
    SourceCameras,
    choose_levels,
    pixel_footprints,
    source_images,
    view_masks,
)
from viewmend.models.views.ray_fill import gather_ray_inputs
from viewmend.types import ContextViews, IncompleteView, MultiViewFrame, Silhouettes

LARGEST_PX = 4096
"""Images and views have at most this many pixels along a side."""
LEVELS = 11
"""An image pyramid has this many levels: enough for a shorter side of `LARGEST_PX`."""
CONSTANT = 5
"""The first level of an image pyramid whose canvas has the same size for all images: 130 pixels."""
SPARE = 16
"""The sheet of `_packed` has this many rows more than the finest level, for the borders of the
levels next to it."""
FILL_LEVELS = 12
"""The smooth fill halves a view this many times, until one pixel is left."""
FILL_CONSTANT = 3
"""The first level of the smooth fill whose canvas has the same size for all views."""


class ViewInputs(NamedTuple):
    """A rendered view, the rig, and the choice of source cameras: the exported model's inputs, in this order.

    Conventions are those of the project (docs/conventions.md): OpenCV axes, metres, pixel centres at +0.5.
    """

    rgb: Float[Tensor, "3 height width"]
    """F, in [0, 1], on black; black where no camera colours the view."""
    mask: Float[Tensor, "height width"]
    """M, in [0, 1]: 1 where the proxy covers the pixel."""
    error: Float[Tensor, "height width"]
    """E, in [0, 1]: 1 where the pixel may change; for the whole subject, M and a rim of two pixels."""
    depth: Float[Tensor, "height width"]
    """z-depth of the proxy, metres; 0 where there is none."""
    weights: Float[Tensor, "chosen height width"]
    """Weight of each chosen camera in each pixel's colour: the sum is 1 where a pixel is coloured, else 0."""
    K: Float[Tensor, "3 3"]
    """The view's intrinsics, pixels."""
    camera_from_world: Float[Tensor, "4 4"]
    """The view's pose."""
    chosen: Int[Tensor, "chosen"]
    """Indices of the source cameras: those that coloured the view, then the closest others."""
    is_source: Bool[Tensor, "chosen"]
    """Whether each of them coloured the view."""
    images: UInt8[Tensor, "camera 3 rows columns"]
    """RGB of all cameras; cameras that are not chosen may have any values."""
    masks: UInt8[Tensor, "camera rows columns"]
    """Foreground masks of all cameras, 0 to 255."""
    proxy_depths: Float[Tensor, "camera rows columns"]
    """z-depth of the proxy in all cameras, metres, 0 where there is none; of cameras that are not
    chosen, anything."""
    rig_K: Float[Tensor, "camera 3 3"]  # noqa: N815
    """The cameras' intrinsics, pixels."""
    rig_camera_from_world: Float[Tensor, "camera 4 4"]
    """The cameras' poses."""
    image_sizes_px: Int[Tensor, "camera 2"]
    """Width and height of each camera's image; smaller ones are padded at the right and bottom."""

    @classmethod
    def of(cls, view: IncompleteView, context: ContextProvider, num_views: int) -> "ViewInputs":
        """The inputs for a view as `ViewSynthNet.step` would complete it.

        Args:
            view: the rendered view.
            context: the cameras' images.
            num_views: number of source cameras.

        Raises:
            ValueError: fewer than two of the cameras that the view names have a frame.
        """
        wanted = view.closest_views(num_views)
        rig = wanted if view.silhouettes is None else view.silhouettes.cameras.names
        seen = context(view.time, tuple(dict.fromkeys((*rig, *wanted))))
        names = () if seen is None else seen.frame.cameras.names
        chosen = [name for name in wanted if name in names]
        if seen is None or len(chosen) < 2:
            raise ValueError(
                f"expected a view that names at least two cameras with a frame, got {chosen}; give source_views and "
                "candidate_views"
            )
        frame = seen.frame
        weights = dict(zip(view.source_views, view.weights, strict=True))
        return cls(
            rgb=view.rgb,
            mask=view.mask,
            error=view.error,
            depth=view.depth,
            weights=torch.stack([weights.get(name, torch.zeros_like(view.mask)) for name in chosen]),
            K=view.camera.K[0],
            camera_from_world=view.camera.camera_from_world[0],
            chosen=torch.tensor([names.index(name) for name in chosen]),
            is_source=torch.tensor([name in view.source_views for name in chosen]),
            images=frame.rgb,
            masks=(255 * (seen.depth > 0)).to(torch.uint8) if frame.mask is None else frame.mask,
            proxy_depths=seen.depth,
            rig_K=frame.cameras.K,
            rig_camera_from_world=frame.cameras.camera_from_world,
            image_sizes_px=frame.cameras.size_px.long(),
        )

    @property
    def view(self) -> IncompleteView:
        """The rendered view; its cameras have no names here."""
        size = torch.tensor([[self.mask.shape[1], self.mask.shape[0]]])
        camera = Cameras(("view",), self.K[None], self.camera_from_world[None], size)
        return IncompleteView(camera, self.rgb, self.mask, self.error, self.depth, (), self.weights, 0)


class ViewOutputs(NamedTuple):
    """The completed view: the exported model's outputs, in this order. Where E is 0, the view is unchanged."""

    completed_rgb: Float[Tensor, "3 height width"]
    """Fhat, in [0, 1], on black."""
    alpha: Float[Tensor, "height width"]
    """Fraction of each pixel that the subject covers, in [0, 1]."""
    confidence: Float[Tensor, "height width"]
    """Probability that the pixel is correct, in [0, 1]."""
    completed_depth: Float[Tensor, "height width"]
    """z-depth of the subject, metres; 0 where there is none."""


class ExportedModel(nn.Module):
    """`ViewSynthNet.step` of one view, without removing `artefact_islands`. Cells have one size in all views."""

    def __init__(self, net: ViewSynthNet) -> None:
        super().__init__()
        self.net = net

    def forward(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        """`ViewOutputs` of `ViewInputs`."""
        inputs = ViewInputs(*tensors)
        view = inputs.view
        sources = PackedSources.of_inputs(inputs)
        where = view.refine_mask & (rim_depth(view.depth) > 0)
        filled = self._fill_holes(view, sources)
        prediction = self.net(view, sources, where=where, filled=filled)
        ray_fill = None if self.net.coarse is None else filled
        faded = torch.zeros_like(where)
        completed = prediction.composite_into(view, where, faded, ray_fill, keep_islands=True)
        assert completed.confidence is not None, "the model predicts it"
        return tuple(
            ViewOutputs(completed.rgb, completed.opacity, completed.confidence, completed.surface_depth)
        )

    def _fill_holes(self, view: IncompleteView, sources: "PackedSources") -> Float[Tensor, "3 height width"]:
        """The image of `ViewSynthNet.fill_holes`."""
        smooth = fill_any_size(view.rgb, view.holes, view.mask > 0)
        if self.net.coarse is None:
            return smooth
        holes = view.holes & (view.depth > 0).any()
        first = torch.arange(holes.numel()).view(holes.shape) == 0
        pixels = torch.nonzero(holes | first)  # some layers need at least one
        holed = replace(view, error=view.holes.to(view.error))
        colours = self.net.coarse.mix(gather_ray_inputs(holed, sources, pixels, smooth))
        return torch.where(holes, scatter_to_image(colours, pixels, holes.shape), smooth)


@dataclass(frozen=True)
class PackedSources(SourceCameras):
    """The source cameras of an exported model's inputs, with pyramids of a fixed number of levels."""

    coloured: Bool[Tensor, "view"]
    use_kernels = False
    rays_at_once = None

    @classmethod
    def of_inputs(cls, inputs: ViewInputs) -> "PackedSources":
        """The chosen cameras, and the silhouettes of all."""
        tensors = inputs.rig_K, inputs.rig_camera_from_world, inputs.image_sizes_px
        cameras = Cameras((), *(tensor[inputs.chosen] for tensor in tensors))
        images, masks, depth = (t[inputs.chosen] for t in (inputs.images, inputs.masks, inputs.proxy_depths))
        views = ContextViews(MultiViewFrame(cameras, images, masks, 0), depth)
        return cls(views, (), Silhouettes(inputs.masks, Cameras((), *tensors)), (), inputs.is_source)

    @property
    def images(self) -> UInt8[Tensor, "view 5 height width"]:
        """`SourceCameras.images`, of the inputs."""
        return source_images(self.views.frame.rgb, view_masks(self.views), self.views.depth)

    @property
    def mask_sums(self) -> tuple[Int[Tensor, "view"], Int[Tensor, "silhouette"]]:
        """`SourceCameras.mask_sums`, of the inputs."""
        return self.images[:, 3].sum((1, 2)), self.silhouettes.mask.sum((1, 2))

    def is_source(self, names: Sequence[str]) -> Float[Tensor, "view"]:
        """1 for cameras that coloured the view: an input here, since cameras have no names."""
        return self.coloured.float()

    def mips(self, viewer: Cameras, step_px: float, scale: SceneScale) -> tuple[MipLevels, MipLevels]:
        """`SourceCameras.mips`."""
        images, masks = self._packed
        mips = []
        for packed, cameras in ((images, self.cameras), (masks, self.silhouettes.cameras)):
            levels = choose_levels(cameras, packed.last, packed.subject_px, viewer, step_px, scale)
            mips.append(packed.at(torch.stack(levels)))
        of_images, of_masks = mips
        return of_images, of_masks

    @cached_property
    def _packed(self) -> "tuple[PackedPyramids, PackedPyramids]":
        """The pyramids of the source cameras and of the silhouettes, which are traced once for all samples."""
        masks = self.silhouettes.mask[:, None].float()
        return (
            PackedPyramids.of(self.images.float(), self.cameras.size_px, mask=3),
            PackedPyramids.of(masks, self.silhouettes.cameras.size_px, mask=0),
        )

    def magnification(self, viewer: Cameras, scale: SceneScale) -> Float[Tensor, ""]:
        """`SourceCameras.magnification` as a tensor, on which the sides of the bands of detail depend."""
        largest = pixel_footprints(self.cameras, viewer, scale).amax(0)  # ONNX needs the axis
        return (1 / largest.clamp_min(1e-6)).clamp_min(1)


class PackedPyramids(NamedTuple):
    """The pyramids of some cameras, all levels in one tensor, so that levels may depend on the inputs."""

    pixels: Float[Tensor, "camera pixel channel"]
    """0 to 255; each level has a border of black pixels."""
    first: Int[Tensor, "level"]
    """Index of each level's first pixel."""
    columns: Int[Tensor, "level"]
    """Pixels from one row to the next of each level."""
    size: Int[Tensor, "level 2"]
    """Rows and columns of each level, with the border."""
    last: Int[Tensor, "camera"]
    """The coarsest level of each camera."""
    subject_px: Float[Tensor, "camera"]
    """Root of the subject's area in each image."""

    @classmethod
    def of(
        cls,
        images: Float[Tensor, "camera channel rows columns"],
        sizes_px: Int[Tensor, "camera 2"],
        mask: int,
    ) -> "PackedPyramids":
        """The pyramids of images of 0 to 255; `mask` is the mask's channel."""
        levels = halvings(images, LEVELS - 1, lambda means: (means + 0.5).floor(), CONSTANT)
        area = levels[AREA_LEVEL][:, mask].double().sum((1, 2)) / 255 * 4**AREA_LEVEL
        sides = torch.tensor([2**level for level in range(LEVELS)])
        shortest = (sizes_px.amin(1)[:, None] + sides - 1) // sides
        last = (shortest > SMALLEST_PX).sum(1).clamp_max(LEVELS - 1)
        return cls(*_packed(levels), last, area.sqrt().clamp_min(1))

    def at(self, levels: Int[Tensor, "level camera"]) -> MipLevels:
        """Several levels of each camera."""
        level = levels[:, None, None]
        columns = self.columns[level]
        first = self.first[level] + torch.arange(levels.shape[1]) * self.pixels.shape[1]
        last = self.size[level].flip(-1) - 1
        rows = torch.stack([first, first + columns, columns], -1)
        return MipLevels(self.pixels.flatten(0, 1), torch.cat([rows, last], -1), 0.5 ** level.double())


def _packed(levels: list[Tensor]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """All levels as one row of pixels, channels last; the index of each level's first pixel, its row length and size.

    The finest level and, below each other to its right, those before `CONSTANT` make one sheet; the
    others follow.
    """
    finest = levels[0]
    right = levels[1:CONSTANT]
    others = levels[CONSTANT:]

    # the sheet: the finest level, and a strip of the following ones
    height = finest.shape[2] + SPARE
    width = finest.shape[3] + 1
    strip_width = right[0].shape[3] + 1
    strips = [F.pad(level, (1, strip_width - 1 - level.shape[3], 1, 0)) for level in right]
    below = height - sum(level.shape[2] for level in strips)
    left = F.pad(finest, (1, 0, 1, SPARE - 1))
    sheet = torch.cat([left, F.pad(torch.cat(strips, 2), (0, 0, 0, below))], 3)

    # the other levels, row by row behind it
    rows = [F.pad(level, (1, 0, 1, 0)) for level in others]
    pixels = torch.cat([image.flatten(2) for image in (sheet, *rows)], 2).movedim(1, 2)

    # where each level begins, and its row length and size
    heights = [0, *(strip.shape[2] for strip in strips[:-1])]
    tops = torch.cat([torch.full((1,), size, dtype=torch.long) for size in heights]).cumsum(0)
    columns = sheet.shape[3]
    areas = torch.tensor([0, *(level.shape[2] * level.shape[3] for level in rows)]).cumsum(0)[:-1]
    first = torch.cat([torch.zeros_like(tops[:1]), tops * columns + width, areas + sheet.shape[2] * columns])
    sheet_columns = torch.full((CONSTANT,), columns, dtype=torch.long)
    row_columns = torch.tensor([row.shape[3] for row in rows])
    sides = [torch.cat([torch.full((1,), level.shape[axis] + 1) for level in levels]) for axis in (2, 3)]
    return pixels, first, torch.cat([sheet_columns, row_columns]), torch.stack(sides, 1)


def halvings(
    images: Float[Tensor, "image channel height width"],
    count: int,
    change: Callable[[Tensor], Tensor],
    constant: int,
) -> list[Float[Tensor, "image channel _height _width"]]:
    """Some images at full resolution and at `count` halved ones, each in a canvas.

    Args:
        images: of any size up to `LARGEST_PX`.
        count: number of halvings.
        change: applied to the means of 2 x 2 pixels before they are halved again.
        constant: first level whose canvas is as large as the largest image's.
    """
    levels = [F.pad(images, (0, 1, 0, 1))]
    for level in range(1, count + 1):
        half = F.pad(change(F.avg_pool2d(levels[-1], 2)), (0, 1, 0, 1))
        if level == constant:
            at = torch.arange(LARGEST_PX // 2**constant + 2)
            for axis in (2, 3):
                half = half.index_select(axis, at.clamp_max(half.shape[axis] - 1))
        levels.append(half)
    return levels


def fill_any_size(
    rgb: Float[Tensor, "channel height width"],
    missing: Bool[Tensor, "height width"],
    subject: Bool[Tensor, "height width"],
) -> Float[Tensor, "channel height width"]:
    """`smooth_fill.fill`, by the same operations whatever is missing."""
    near, _ = from_near(rgb, ~missing, missing)
    wide = missing & spread(~spread(~missing))
    filled, reached = from_near(rgb, ~missing & subject, missing)
    deep = missing & ~reached
    filled = torch.where(deep, pull_push_any_size(filled, ~deep & subject), filled)
    return torch.where(wide, filled, near)


def pull_push_any_size(
    image: Float[Tensor, "channel height width"], known: Bool[Tensor, "height width"]
) -> Float[Tensor, "channel height width"]:
    """`smooth_fill.pull_push`."""

    def mean(half: Tensor) -> Tensor:
        colour, weight = half.split((len(image), 1), 1)
        return torch.cat([colour / weight.clamp_min(1e-6), (weight > 0).to(weight)], 1)

    weighted = torch.cat([image * known, known[None].to(image)])
    levels = [level[0] for level in halvings(weighted[None], FILL_LEVELS, mean, FILL_CONSTANT)]
    scale = torch.tensor([2**level for level in range(FILL_LEVELS + 1)])
    sizes = [(axis, (size + scale - 1) // scale) for axis, size in zip((1, 2), known.shape, strict=True)]
    filled = levels[-1][:-1]
    for level in range(FILL_LEVELS - 1, -1, -1):
        colour = levels[level][:-1]
        weight = levels[level][-1:]
        for axis, size in sizes:
            filled = _interpolate(filled, axis, size[level + 1], size[level], colour.shape[axis])
        filled = torch.where(weight > 0, colour, filled)
    return torch.where(known, image, filled[:, : known.shape[0], : known.shape[1]])


def _interpolate(image: Tensor, axis: int, coarse: Tensor, fine: Tensor, length: int) -> Tensor:
    """An image of `coarse` pixels along an axis, interpolated to `fine` pixels in a canvas of this length."""
    at = ((torch.arange(length) + 0.5) * (coarse / fine) - 0.5).clamp_min(0)
    first = torch.minimum(at.long(), coarse - 1)
    share = (at - first).clamp(0, 1).view([-1 if other == axis else 1 for other in range(3)])
    after = torch.minimum(first + 1, coarse - 1)
    return (1 - share) * image.index_select(axis, first) + share * image.index_select(axis, after)
