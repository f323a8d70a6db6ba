"""Where patches are: (u, v, s), lifted by the proxy's depth and carried into the novel view (section 5)."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

from viewmend.geometry.cameras import Cameras, project, unproject
from viewmend.inpainting.patches import PATCH_PX, STEP_PX, centers_px, grid_shape, padded_size, split


def patch_depths(
    depth: Float[Tensor, "view height width"], foreground: Bool[Tensor, "view height width"], around: bool = False
) -> Float[Tensor, "view rows cols"]:
    """z-depth of every patch's centre, metres.

    A centre is where four pixels meet: its depth is that of the pixel below and right of it, or, with `around`, the
    mean of those of the four that have one.

    A patch whose centre has none takes the median depth of its foreground pixels that have one; 0 where there are
    none of these either.
    """
    height, width = depth.shape[1:]
    rows, cols = grid_shape(height, width)
    full_height, full_width = padded_size(rows, cols)
    beyond = (0, full_width - width, 0, full_height - height)
    depth = F.pad(depth.clamp_min(0), beyond)
    half = PATCH_PX // 2
    four = [depth[:, v::STEP_PX, u::STEP_PX][:, :rows, :cols] for v in (half - 1, half) for u in (half - 1, half)]
    centre = _mean_of_those(torch.stack(four)) if around else four[-1]

    usable = torch.where(F.pad(foreground, beyond), depth, 0.0)
    somewhere = F.max_pool2d(usable[:, None], PATCH_PX, STEP_PX)[:, 0] > 0
    places = torch.nonzero((centre == 0) & somewhere)
    pixels = split(usable[:, None], places, PATCH_PX, STEP_PX).flatten(1)
    median = torch.where(pixels > 0, pixels, torch.nan).nanmedian(1).values
    return centre.index_put(tuple(places.unbind(1)), median)


def _mean_of_those(depths: Float[Tensor, "four view rows cols"]) -> Float[Tensor, "view rows cols"]:
    """The mean of the depths that are there; 0 without any."""
    return depths.sum(0) / (depths > 0).sum(0).clamp_min(1)


def lift(
    places: Int[Tensor, "patch 3"], depths: Float[Tensor, "view rows cols"], cameras: Cameras
) -> tuple[Float[Tensor, "patch 3"], Bool[Tensor, "patch"]]:
    """World points of the patches' centres at these depths (metres), and whether there is a depth."""
    views, rows, cols = depths.shape
    grid = torch.cartesian_prod(torch.zeros(1, dtype=torch.long), torch.arange(rows), torch.arange(cols)).to(
        depths.device
    )
    uv = centers_px(grid).expand(views, -1, -1)
    points = unproject(uv, depths.flatten(1), cameras).unflatten(1, (rows, cols))
    index = tuple(places.unbind(1))
    return points[index], depths[index] > 0


def reproject(
    points_world: Float[Tensor, "patch 3"], valid: Bool[Tensor, "patch"], target: Cameras
) -> tuple[Float[Tensor, "patch 2"], Bool[Tensor, "patch"]]:
    """C_G(x): the points' (u, v) in the target, normalised by its size, and which of them count.

    Coordinates outside of [0, 1] are kept; points without depth or behind the target do not count (and are 0).
    """
    uv, z = project(points_world, target)
    counts = valid & (z[0] > 1e-6)
    return torch.where(counts[:, None], uv[0] / target.size_px[0], 0.0), counts


def reference_depth(depth: Float[Tensor, "view height width"]) -> Float[Tensor, "view"]:
    """The median depth of each image, metres; 1 where there is no surface."""
    seen = depth > 0
    return torch.stack([d[s].median() if bool(s.any()) else d.new_ones(()) for d, s in zip(depth, seen, strict=True)])


def relative_depth(
    depth: Float[Tensor, "view height width"], reference: Float[Tensor, "view"] | None = None
) -> Float[Tensor, "view height width"]:
    """4 (z / z_ref - 1) with z_ref the `reference`, by default each image's `reference_depth`; 0 without a surface.

    It depends on the rig's scale no more than on the target, so what is encoded from it can be cached.
    """
    seen = depth > 0
    reference = reference_depth(depth) if reference is None else reference
    return torch.where(seen, 4 * (depth / reference[:, None, None] - 1), 0.0)
