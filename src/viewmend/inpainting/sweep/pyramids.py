"""Cameras' images in all scales: what is looked up in them has the size of what it is for. Ours."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import torch
from jaxtyping import Int, UInt8
from torch import Tensor
from torch.nn import functional as F

from viewmend.chosen_views import each
from viewmend.geometry.threads import parallel_for
from viewmend.inpainting.protocol import ContextProvider
from viewmend.views import ContextViews, Silhouettes

if TYPE_CHECKING:
    from viewmend.inpainting.sweep.lookup import Places, Rays, Scale

SMALLEST_PX = 4
"""Levels are halved until a side is no longer than this."""


@dataclass(frozen=True)
class Pyramid:
    """A camera's image in all scales, each half of the one before, with a border of one black pixel."""

    levels: tuple[UInt8[Tensor, "_rows _columns channel"], ...]
    subject_px: float
    """Root of the subject's area."""

    def level(self, footprint_px: float) -> int:
        """The level whose pixels are about as large as so many of the image's."""
        return min(len(self.levels) - 1, max(0, round(math.log2(max(footprint_px, 1.0)))))


@dataclass(frozen=True)
class Rig:
    """The cameras that may be looked at, of one time."""

    views: ContextViews
    pyramids: tuple[Pyramid, ...]
    """RGB upon black, mask, and coverage by the proxy, of each of `views`."""
    silhouettes: Silhouettes
    """The masks of all cameras."""
    silhouette_pyramids: tuple[Pyramid, ...]
    rays_at_once: ClassVar[int | None] = 1024
    """So many are weighed together: what is looked up along more does not fit a cache."""

    @classmethod
    def of(cls, views: ContextViews, silhouettes: Silhouettes | None, context: ContextProvider | None = None) -> "Rig":
        """Cameras with their pyramids.

        Args:
            views: the cameras that may be looked at.
            silhouettes: of all cameras; None for the views' own.
            context: remembers pyramids, and has those that were made for earlier views of the time.
        """
        if silhouettes is None:
            silhouettes = Silhouettes(_masks(views), views.frame.cameras)
        if context is None:
            return cls(views, view_pyramids(views), silhouettes, silhouette_pyramids(silhouettes))
        time, names, all_names = views.frame.time, views.frame.cameras.names, silhouettes.cameras.names
        pyramids = context.remembered(time, "views", names, lambda new: view_pyramids(views.select(new)))
        masks = context.remembered(
            time, "silhouettes", all_names, lambda new: silhouette_pyramids(silhouettes.select(new))
        )
        return cls(views, tuple(pyramids), silhouettes, tuple(masks))

    def look_up(self, rays: "Rays", source_views: Sequence[str], step_px: float, scale: "Scale") -> "Places":
        """What every camera shows at places along rays, as `lookup.look_up`."""
        from viewmend.inpainting.sweep.lookup import look_up

        return look_up(rays, self, source_views, step_px, scale)

    def first(self, count: int) -> "Rig":
        """With so many of the cameras; all silhouettes stay."""
        names = self.views.frame.cameras.names[:count]
        return replace(self, views=self.views.select(names), pyramids=self.pyramids[: len(names)])


def keep_pyramids(views: ContextViews, context: ContextProvider) -> None:
    """The pyramids of all cameras of a time, for `context` to remember."""
    Rig.of(views, None, context)


def view_pyramids(views: ContextViews) -> tuple[Pyramid, ...]:
    """RGB upon black, mask and coverage by the proxy, of every camera."""
    rgb, depth = each(views.frame, "rgb"), each(views, "depth")
    mask = each(views.frame, "mask") or _masks(views)

    def whole(view: int, width: int, height: int) -> UInt8[Tensor, "rows columns 5"]:
        own = slice(height), slice(width)
        if rgb[0].device.type == "cpu":
            from viewmend.inpainting.sweep._lookup_numba import premultiplied

            image = torch.zeros(height + 2, width + 2, 5, dtype=torch.uint8)
            premultiplied(rgb[view][:, *own].numpy(), mask[view][own].numpy(), depth[view][own].numpy(), image.numpy())
            return image
        black = (rgb[view][:, *own].int() * mask[view][own].int() + 127) // 255
        channels = [black, mask[view][own][None], 255 * (depth[view][own] > 0)[None]]
        return F.pad(torch.cat([c.to(torch.uint8) for c in channels]).permute(1, 2, 0), (0, 0, 1, 1, 1, 1))

    return _each(views.frame.cameras.size_px, whole, 3)


def silhouette_pyramids(silhouettes: Silhouettes) -> tuple[Pyramid, ...]:
    """The masks of every camera."""

    def whole(view: int, width: int, height: int) -> UInt8[Tensor, "rows columns 1"]:
        return F.pad(silhouettes.mask[view, :height, :width, None], (0, 0, 1, 1, 1, 1))

    return _each(silhouettes.cameras.size_px, whole, 0)


def _masks(views: ContextViews) -> UInt8[Tensor, "view height width"]:
    """The views' masks; where they have none, what the proxy covers."""
    return (255 * (views.depth > 0)).to(torch.uint8) if views.frame.mask is None else views.frame.mask


def _each(sizes_px: Int[Tensor, "view 2"], whole: Callable[[int, int, int], Tensor], mask: int) -> tuple[Pyramid, ...]:
    """The pyramid of every camera, upon whole(view, width, height); `mask` is the channel of the mask."""
    made: dict[int, Pyramid] = {}
    sizes = sizes_px.tolist()

    def work(view: int) -> None:
        levels = [whole(view, *sizes[view])]
        while min(levels[-1].shape[:2]) - 2 > SMALLEST_PX:
            levels.append(halved(levels[-1]))
        middle = min(2, len(levels) - 1)
        area_px = float(levels[middle][..., mask].sum(dtype=torch.long)) / 255 * 4**middle
        made[view] = Pyramid(tuple(levels), max(1.0, math.sqrt(area_px)))

    parallel_for(work, len(sizes))
    return tuple(made[view] for view in range(len(sizes)))


def halved(image: UInt8[Tensor, "rows columns channel"]) -> UInt8[Tensor, "_rows _columns channel"]:
    """Means of 2 x 2 pixels, rounded; both have a border of one black pixel, which also makes up for odd sides."""
    rows, columns, channels = image.shape
    if image.device.type == "cpu":
        from viewmend.inpainting.sweep._lookup_numba import halve

        half = torch.zeros((rows - 1) // 2 + 2, (columns - 1) // 2 + 2, channels, dtype=torch.uint8)
        halve(image.numpy(), half.numpy())
        return half
    inner = F.pad(image[1:-1, 1:-1].permute(2, 0, 1).float(), (0, columns % 2, 0, rows % 2))
    means = (F.avg_pool2d(inner[None], 2)[0] + 0.5).floor()
    return F.pad(means.to(torch.uint8).permute(1, 2, 0), (0, 0, 1, 1, 1, 1))
