"""Overlapping patches, kept sparse (section 4), and their spatio-temporal coordinates (section 5).

A patch is 7 x 7 cells of the feature map, 28 x 28 image pixels; patches are 4 cells, 16 pixels,
apart. A patch is identified by its place (view, row, column); row 0 and column 0 start at the top
left of the image. The grid covers the whole image and may extend beyond its right and bottom edges,
where everything is zero.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

from viewmend.geometry.cameras import Cameras, project, unproject

Places = Int[Tensor, "patch 3"]
"""View, row and column of patches."""
Maps = Float[Tensor, "view channel height width"]
Patches = Float[Tensor, "patch channel size size"]
Planes = Float[Tensor, "view height width"]
CELL_PX = 4
"""Side of a cell of the feature map, in image pixels."""
PATCH_CELLS = 7
STEP_CELLS = 4
PATCH_PX = PATCH_CELLS * CELL_PX
STEP_PX = STEP_CELLS * CELL_PX


def grid_shape(height: int, width: int) -> tuple[int, int]:
    """Rows and columns of patches that cover an image of this size, in pixels."""
    rows, cols = (max(0, -(-(n - PATCH_PX) // STEP_PX)) + 1 for n in (height, width))
    return rows, cols


def padded_size(rows: int, cols: int) -> tuple[int, int]:
    """Height and width covered by a grid of patches, in pixels."""
    return (rows - 1) * STEP_PX + PATCH_PX, (cols - 1) * STEP_PX + PATCH_PX


def any_in_patch(pixels: Bool[Tensor, "view height width"]) -> Bool[Tensor, "view rows cols"]:
    """Whether a patch contains any of these pixels."""
    height, width = pixels.shape[1:]
    full_height, full_width = padded_size(*grid_shape(height, width))
    padded = F.pad(pixels.float(), (0, full_width - width, 0, full_height - height))
    return F.max_pool2d(padded[:, None], PATCH_PX, STEP_PX)[:, 0] > 0


def centers_px(places: Places) -> Float[Tensor, "patch 2"]:
    """Image coordinates (u, v) of the patch centres, in pixels."""
    return places[:, [2, 1]].float() * STEP_PX + PATCH_PX / 2


def split(maps: Maps, places: Places, size: int, step: int) -> Patches:
    """Cut patches of size x size at these places, `step` apart; the maps must be large enough to contain them."""
    channels, height, width = maps.shape[1:]
    offsets = torch.arange(size, device=maps.device)
    view, row, col = places[:, :, None, None].unbind(1)
    flat = (view * height + row * step + offsets[:, None]) * width + col * step + offsets
    pixels = maps.movedim(1, -1).reshape(-1, channels).index_select(0, flat.flatten())
    return pixels.unflatten(0, (-1, size, size)).movedim(-1, 1)


def merge(patches: Patches, places: Places, shape: tuple[int, int, int], step: int) -> tuple[Maps, Planes]:
    """Put patches back in their places with linearly blended overlaps (section 7).

    `shape` is (views, height, width). Returns the images, 0 where no patch covers them, and the
    coverage, 1 or 0. The blending weights sum to one at every covered pixel.
    """
    views, height, width = shape
    channels, size = patches.shape[1:3]
    offsets = torch.arange(size, device=patches.device)
    v = places[:, 1, None, None] * step + offsets[:, None]
    u = places[:, 2, None, None] * step + offsets
    inside = (v < height) & (u < width)
    pixels = views * height * width
    # Pixels of patches beyond the image go to an extra place: to leave them out would wait for a device.
    flat = torch.where(inside, (places[:, 0, None, None] * height + v) * width + u, pixels).flatten()

    # Weights fall from a patch's centre to its edges, and are above 0
    ramp = torch.minimum(offsets + 0.5, size - (offsets + 0.5))
    weights = (ramp[:, None] * ramp / (size / 2) ** 2).to(patches).expand(len(patches), -1, -1)
    weighted = (
        torch.cat([patches * weights[:, None], weights[:, None]], 1).movedim(1, -1).reshape(-1, channels + 1)
    )
    sums = weighted.new_zeros(pixels + 1, channels + 1).index_add(0, flat, weighted)[:pixels]
    total = sums.unflatten(0, (views, height, width)).movedim(-1, 1)
    weight = total[:, -1]
    return total[:, :-1] / weight.clamp_min(1e-6)[:, None], (weight > 0).to(patches.dtype)


def crop(
    image: Float[Tensor, "channel height width"], top: int, left: int, size: tuple[int, int]
) -> Float[Tensor, "channel crop_height crop_width"]:
    """The window of this size at (top, left), which may extend beyond the image; zero outside of it."""
    height, width = image.shape[1:]
    rows = slice(max(top, 0), max(min(top + size[0], height), 0))
    cols = slice(max(left, 0), max(min(left + size[1], width), 0))
    inside = image[:, rows, cols]
    above = min(max(-top, 0), size[0])
    before = min(max(-left, 0), size[1])
    below = size[0] - above - inside.shape[1]
    after = size[1] - before - inside.shape[2]
    return F.pad(inside, (before, after, above, below))


def patch_depths(
    depth: Planes, foreground: Bool[Tensor, "view height width"]
) -> Float[Tensor, "view rows cols"]:
    """z-depth of every patch's centre, in metres (section 5).

    A centre is where four pixels meet; its depth is the mean of those of the four that have
    one. Without any, it is the median depth of the patch's foreground pixels, or 0 if none
    of them has a depth.
    """
    height, width = depth.shape[1:]
    rows, cols = grid_shape(height, width)
    full_height, full_width = padded_size(rows, cols)
    padding = (0, full_width - width, 0, full_height - height)
    depth = F.pad(depth.clamp_min(0), padding)
    corner = (PATCH_PX // 2 - 1, PATCH_PX // 2)
    four = torch.stack([depth[:, v::STEP_PX, u::STEP_PX][:, :rows, :cols] for v in corner for u in corner])
    centre = four.sum(0) / (four > 0).sum(0).clamp_min(1)

    usable = torch.where(F.pad(foreground, padding), depth, 0.0)
    places = torch.nonzero((centre == 0) & (F.max_pool2d(usable[:, None], PATCH_PX, STEP_PX)[:, 0] > 0))
    pixels = split(usable[:, None], places, PATCH_PX, STEP_PX).flatten(1)
    median = torch.where(pixels > 0, pixels, torch.nan).nanmedian(1).values
    return centre.index_put(tuple(places.unbind(1)), median)


def lift(
    places: Places, depths: Float[Tensor, "view rows cols"], cameras: Cameras
) -> tuple[Float[Tensor, "patch 3"], Bool[Tensor, "patch"]]:
    """World points of the patch centres at these depths (metres), and whether a patch has a depth (section 5)."""
    views, rows, cols = depths.shape
    grid = torch.cartesian_prod(torch.zeros(1, dtype=torch.long), torch.arange(rows), torch.arange(cols))
    uv = centers_px(grid.to(depths.device)).expand(views, -1, -1)
    points = unproject(uv, depths.flatten(1), cameras).unflatten(1, (rows, cols))
    index = tuple(places.unbind(1))
    return points[index], depths[index] > 0


def reproject(
    points_world: Float[Tensor, "patch 3"], valid: Bool[Tensor, "patch"], target: Cameras
) -> tuple[Float[Tensor, "patch 2"], Bool[Tensor, "patch"]]:
    """C_G(x) of section 5: (u, v) of points in the target view, normalised by its size, and validity.

    Coordinates outside [0, 1] are kept. Points without depth or behind the target camera are invalid, and 0.
    """
    uv, z = project(points_world, target)
    valid = valid & (z[0] > 1e-6)
    return uv[0] / target.size_px[0] * valid[:, None], valid
