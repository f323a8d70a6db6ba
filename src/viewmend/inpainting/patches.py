"""Overlapping patches, kept sparse (section 4).

A patch is 7 x 7 cells of the feature map, 28 x 28 pixels of the image, and steps by 4 cells, 16 pixels. It is named
by its place (view, row, column); row 0 and column 0 start at the image's top left. The grid covers the whole image
and may pass its right and lower edges, where everything is zero.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

from viewmend.inpainting.encoder import CELL_PX, RECEPTIVE_RADIUS_PX

PATCH_CELLS = 7
STEP_CELLS = 4
PATCH_PX = PATCH_CELLS * CELL_PX
STEP_PX = STEP_CELLS * CELL_PX
MARGIN_STEPS = -(-RECEPTIVE_RADIUS_PX // STEP_PX)
"""Patch steps that hold the encoder's receptive radius."""
CROP_STEPS = 4
"""Crops are a multiple of so many patch steps: convolutions are compiled for each size they meet (20 ms on a CPU)."""


def grid_shape(height: int, width: int) -> tuple[int, int]:
    """Rows and columns of patches that cover an image of this size."""
    rows, cols = (max(0, -(-(n - PATCH_PX) // STEP_PX)) + 1 for n in (height, width))
    return rows, cols


def padded_size(rows: int, cols: int) -> tuple[int, int]:
    """Height and width, in pixels, that a grid of patches covers."""
    return (rows - 1) * STEP_PX + PATCH_PX, (cols - 1) * STEP_PX + PATCH_PX


def any_in_patch(pixels: Bool[Tensor, "view height width"]) -> Bool[Tensor, "view rows cols"]:
    """Whether a patch holds any of these pixels."""
    height, width = pixels.shape[1:]
    full_height, full_width = padded_size(*grid_shape(height, width))
    padded = F.pad(pixels.float(), (0, full_width - width, 0, full_height - height))
    return F.max_pool2d(padded[:, None], PATCH_PX, STEP_PX)[:, 0] > 0


def centers_px(places: Int[Tensor, "patch 3"]) -> Float[Tensor, "patch 2"]:
    """Image coordinates (u, v) of patches' centres, pixels."""
    return places[:, [2, 1]].float() * STEP_PX + PATCH_PX / 2


def split(
    maps: Float[Tensor, "view channel height width"], places: Int[Tensor, "patch 3"], size: int, step: int
) -> Float[Tensor, "patch channel size size"]:
    """The patches of size x size at these places, `step` apart; the maps must reach as far as the patches."""
    channels, height, width = maps.shape[1:]
    offsets = torch.arange(size, device=maps.device)
    view, row, col = places[:, :, None, None].unbind(1)
    flat = (view * height + row * step + offsets[:, None]) * width + col * step + offsets
    pixels = maps.movedim(1, -1).reshape(-1, channels).index_select(0, flat.flatten())
    return pixels.unflatten(0, (-1, size, size)).movedim(-1, 1)


def tent(size: int, device: torch.device | None = None) -> Float[Tensor, "size size"]:
    """Weights that fall linearly from a patch's middle to its edges; positive everywhere."""
    ramp = torch.arange(size, device=device) + 0.5
    ramp = torch.minimum(ramp, size - ramp)
    return ramp[:, None] * ramp / (size / 2) ** 2


def merge(
    patches: Float[Tensor, "patch channel size size"],
    places: Int[Tensor, "patch 3"],
    shape: tuple[int, int, int],
    step: int,
) -> tuple[Float[Tensor, "view channel height width"], Float[Tensor, "view height width"]]:
    """Patches put back at their places, overlaps blended linearly, and which pixels they cover (0 or 1).

    `shape` is (views, height, width). Weights sum to one at every covered pixel; the others are zero. What passes
    the right and lower edges is cut off.
    """
    views, height, width = shape
    channels, size = patches.shape[1:3]
    offsets = torch.arange(size, device=patches.device)
    v = places[:, 1, None, None] * step + offsets[:, None]
    u = places[:, 2, None, None] * step + offsets
    inside = (v < height) & (u < width)
    flat = ((places[:, 0, None, None] * height + v) * width + u)[inside]

    weights = tent(size, patches.device).to(patches).expand(len(patches), -1, -1)
    weighted = torch.cat([patches * weights[:, None], weights[:, None]], 1).movedim(1, -1)[inside]
    total = weighted.new_zeros(views * height * width, channels + 1).index_add(0, flat, weighted)
    total = total.unflatten(0, (views, height, width)).movedim(-1, 1)
    weight = total[:, -1]
    return total[:, :-1] / weight.clamp_min(1e-6)[:, None], (weight > 0).to(patches.dtype)


def crop_windows(kept: Bool[Tensor, "view rows cols"]) -> tuple[Int[Tensor, "view 2"], tuple[int, int]]:
    """Where to crop so that the encoder sees all that matters to the kept patches.

    Returns each view's first (row, column) of the crop, in patch steps, negative where it starts outside of the
    image, and the height and width in pixels that are common to all. Every kept patch has the encoder's receptive
    radius around it, so that the crop's border cannot be told from the zeros beyond.
    """
    firsts, extents = [], []
    for axis in (2, 1):
        used = kept.any(axis)
        count = used.shape[1]
        steps = torch.arange(count, device=kept.device)
        first = torch.where(used, steps, count).amin(1)
        last = torch.where(used, steps, -1).amax(1)
        first = torch.where(last >= 0, first, 0)
        firsts.append(first - MARGIN_STEPS)
        extents.append(int((last - first + 1).clamp_min(1).amax()))
    rows, cols = (-(-(extent + 2 * MARGIN_STEPS) // CROP_STEPS) * CROP_STEPS for extent in extents)
    height, width = padded_size(rows, cols)
    return torch.stack(firsts, 1), (height, width)


def crop(
    image: Float[Tensor, "channel height width"], top: int, left: int, size: tuple[int, int]
) -> Float[Tensor, "channel crop_height crop_width"]:
    """The window at (top, left), which may leave the image; zero outside of it."""
    height, width = image.shape[1:]
    rows = slice(max(top, 0), max(min(top + size[0], height), 0))
    cols = slice(max(left, 0), max(min(left + size[1], width), 0))
    inside = image[:, rows, cols]
    above, before = min(max(-top, 0), size[0]), min(max(-left, 0), size[1])
    below, after = size[0] - above - inside.shape[1], size[1] - before - inside.shape[2]
    return F.pad(inside, (before, after, above, below))
