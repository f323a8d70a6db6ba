"""What `RayBlendNet` is told of a view's holes: the twin of `look_around` for `torch.export`.

Means over squares whose side depends on the scene come from sums over all that is above and left (Crow, SIGGRAPH 1984).
"""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional as F

from viewmend.deployment.packed_rig import two_least
from viewmend.deployment.rig_cameras import RigCameras, Seen, Viewer, cosines, seen_by
from viewmend.deployment.view_inputs import ViewInputs
from viewmend.inpainting.ray_blend_net import RADIUS_PX, RayBlendNet
from viewmend.inpainting.ray_sampling import (
    CELLS,
    CELLS_AROUND,
    COVERED,
    FAR,
    NEAR,
    OFFSETS,
    OUTLINE,
    PATCH,
    windows,
)
from viewmend.inpainting.sweep.lookup import Scale


class Sums(NamedTuple):
    """Sums over all that is above and left of each corner of the pixels of some images."""

    values: Float[Tensor, "image corner_row corner_column channel"]

    @classmethod
    def of(cls, images: Float[Tensor, "image height width channel"]) -> "Sums":
        """The sums of these images."""
        return cls(F.pad(images.double(), (0, 0, 1, 0, 1, 0)).cumsum(1).cumsum(2))

    def at(self, image: Tensor, row: Tensor, column: Tensor) -> Float[Tensor, "*corner channel"]:
        """The sums at corners, each of its image; beyond an image they are those of its border."""
        rows, columns = self.values.shape[1:3]
        row, column = row.clamp(0).clamp_max(rows - 1), column.clamp(0).clamp_max(columns - 1)
        return self.values.flatten(0, 2)[(image * rows + row) * columns + column]

    def means(self, u: Tensor, v: Tensor, side: Int[Tensor, ""]) -> Float[Tensor, "ray place image channel"]:
        """Means over squares of this side at positions in each image, in pixels, bilinearly."""
        x, y = u * (1 / side.double()) - 0.5, v * (1 / side.double()) - 0.5
        left, top = x.floor(), y.floor()
        image, three = torch.arange(self.values.shape[0]), torch.arange(3)
        row, column = ((first.long()[..., None] + three) * side for first in (top, left))
        corners = self.at(image[:, None, None], row[..., :, None], column[..., None, :])
        squares = corners.diff(dim=-3).diff(dim=-2)
        shares = bilinear_shares(x - left, y - top)[..., None]
        return ((squares * shares).sum((-3, -2)) / side.double() ** 2).float()


def bilinear_shares(right: Tensor, below: Tensor) -> Float[Tensor, "*point 2 2"]:
    """How much each of four pixels counts at a point so far right of the first and below it, in [0, 1]."""
    across, down = torch.stack([1 - right, right], -1), torch.stack([1 - below, below], -1)
    return down[..., :, None] * across[..., None, :]


def read_holes(
    net: RayBlendNet, given: ViewInputs, pixels: Int[Tensor, "pixel 2"], guess: Float[Tensor, "3 height width"],
    scale: Scale,
) -> Float[Tensor, "pixel 3"]:  # fmt: skip
    """The colours that the net reads for these pixels (row, column) of a view; `guess` is its smooth fill."""
    view = given.view
    shown = torch.cat([view.rgb, view.mask[None], view.holes.to(guess)[None], guess])
    features, consistency = along_rays(given, pixels, scale)
    window = windows(shown, pixels, RADIUS_PX).contiguous()  # else how it lies depends on how many there are
    far = net.far(surroundings(given, guess, pixels, scale)).flatten(1)
    return net.mixed(features, consistency, window, far)


def along_rays(
    given: ViewInputs, pixels: Int[Tensor, "pixel 2"], scale: Scale
) -> tuple[Float[Tensor, "pixel point view 14"], Float[Tensor, "pixel point 4"]]:
    """The stacked `RayFeatures` and `SilhouetteConsistency` of `ray_sampling.sample_along_rays`."""
    everyone = RigCameras.of(given.rig_K, given.rig_camera_from_world, given.image_sizes_px)
    cameras, viewer = RigCameras(*(values[given.chosen] for values in everyone)), Viewer.of(given.view.camera)
    rgb, mask, proxy = (values[given.chosen] for values in (given.images, given.masks, given.proxy_depths))
    depth = given.depth[pixels[:, 0], pixels[:, 1]]
    depth = torch.where(depth > 0, depth, scale.depth_m)  # M reaches beyond the depth that was given
    z = depth[:, None] + scale.size_m * depth.new_tensor(OFFSETS)
    uv = pixels.flip(1) + 0.5
    seen = seen_by(cameras, viewer, uv, z)
    soft = mask.float() / 255
    shown = torch.cat([rgb.float() / 255 * soft[:, None], torch.stack([soft, (proxy > 0).float(), proxy], 1)], 1)
    *near, coverage, surface = bilinear(shown.movedim(1, 3), seen).unbind(-1)
    behind = torch.where(coverage > COVERED, (seen.z - surface / coverage.clamp_min(COVERED)) / scale.size_m, 0.0)
    shapes = torch.stack([mask.double() / 255, (proxy > 0).double()], -1)
    halves = (rgb * mask.float()[:, None]).movedim(1, -1) / 255**2
    for axis in (1, 2):  # gathered: of a view with steps not all strides are known
        halves = halves.index_select(axis, torch.arange(0, halves.shape[axis], 2))
    half = side_px(PATCH / 2, mask)
    shape = Sums.of(shapes).means(seen.u, seen.v, side_px(OUTLINE, mask))
    colour = Sums.of(halves).means(seen.u / 2, seen.v / 2, half)
    told = [*near, (behind / NEAR).tanh(), (behind / FAR).tanh(), cosines(cameras, viewer, uv, z)]
    told += [
        given.is_source.expand_as(behind),
        torch.ones_like(behind),
        shape[..., 0],
        *colour.unbind(-1),
        shape[..., 1],
    ]
    features = torch.where(seen.inside[..., None], torch.stack([value.float() for value in told], -1), 0.0)
    return features, _consistency(everyone, given.masks, viewer, uv, z)


def _consistency(
    cameras: RigCameras, masks: Tensor, viewer: Viewer, uv: Tensor, z: Tensor
) -> Float[Tensor, "pixel point 4"]:
    seen = seen_by(cameras, viewer, uv, z)
    mean = Sums.of(masks[..., None] / 255).means(seen.u, seen.v, side_px(OUTLINE, masks))[..., 0]
    values = [
        torch.where(seen.inside, value.float(), 1.0) for value in (bilinear(masks[..., None] / 255, seen)[..., 0], mean)
    ]
    return torch.cat([two_least(value) for value in values], -1)


def bilinear(
    images: Float[Tensor, "camera rows columns channel"], seen: Seen
) -> Float[Tensor, "ray place camera channel"]:
    """Images at where places are seen, bilinearly, zeros beyond them."""
    x, y = seen.u - 0.5, seen.v - 0.5
    left, top = x.floor(), y.floor()
    rows, columns = images.shape[1:3]
    row, column = ((first.long()[..., None] + torch.arange(2)) for first in (top, left))
    inside = ((row >= 0) & (row < rows))[..., :, None] & ((column >= 0) & (column < columns))[..., None, :]
    row, column = row.clamp(0).clamp_max(rows - 1), column.clamp(0).clamp_max(columns - 1)
    first = torch.arange(images.shape[0])[:, None, None] * (rows * columns)
    values = images.flatten(0, 2)[first + row[..., :, None] * columns + column[..., None, :]]
    return (values * (bilinear_shares(x - left, y - top) * inside)[..., None]).sum((-3, -2))


def surroundings(
    given: ViewInputs, guess: Float[Tensor, "3 height width"], pixels: Int[Tensor, "pixel 2"], scale: Scale
) -> Float[Tensor, "pixel 12 11 11"]:
    """What `ray_sampling.multi_scale_context` tells of each pixel (row, column)."""
    view, covered = given.view, given.depth > 0
    beyond = (0.5 + 0.5 * ((view.depth - scale.depth_m) / scale.size_m).tanh()) * covered
    shown = torch.cat([guess, view.mask[None], view.holes.to(guess)[None], beyond[None]])
    sums = Sums.of(shown.movedim(0, -1)[None])
    subject_px = (view.mask > 0).sum().float().sqrt().double()
    middle = given.K[:2, 2].floor().long().flip(0)
    reach = torch.arange(-CELLS_AROUND, CELLS_AROUND + 2)
    told = []
    for size in CELLS:
        side = (size * subject_px).round().clamp_min(1).long()
        before = (-middle) % side
        row, column = ((((pixels + before) // side)[:, :, None] + reach) * side - before[:, None]).unbind(1)
        corners = sums.at(torch.zeros((), dtype=torch.long), row[:, :, None], column[:, None, :])
        cells = corners[:, 1:, 1:] - corners[:, :-1, 1:] - corners[:, 1:, :-1] + corners[:, :-1, :-1]
        told.append((cells / side.double() ** 2).float().movedim(-1, 1))
    return torch.cat(told, 1)


def side_px(size: float, masks: Tensor) -> Int[Tensor, ""]:
    """A length in sizes of the subject, a mean over cameras: whole pixels, 1 at least."""
    subject = (masks.sum((1, 2)) / 255).mean().sqrt().double()
    return (size * subject).round().clamp_min(1).long()
