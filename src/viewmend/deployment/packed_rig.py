"""Cameras' images in all scales in one tensor each, so that which one is looked up in may depend on the scene.

The twin of `sweep.pyramids` and `sweep.lookup` for `torch.export`: no size, and no choice of a scale, is known before.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

from viewmend.deployment.halvings import halvings
from viewmend.deployment.rig_cameras import RigCameras, Seen, Viewer, cosines, seen_by
from viewmend.deployment.view_inputs import ViewInputs
from viewmend.inpainting.sweep.lookup import AROUND, CONTRAST, FAR, NEAR, Places, Rays, Scale
from viewmend.inpainting.sweep.pyramids import SMALLEST_PX

LEVELS = 11
"""Scales of an image, each half of the one before: enough for a shorter side of 4096 pixels."""
CONSTANT = 5
"""The first level whose canvas is as large for all images: 130 pixels."""
SPARE = 16
"""Rows that a sheet of levels has beyond the finest: halves of a length add up to no more than it, but for borders."""
MEASURED = 2
"""Scale at which the subject's area is measured."""


class PackedLevels(NamedTuple):
    """Images of some cameras in all scales, one after the other, each with a border of black pixels."""

    values: Float[Tensor, "camera pixel channel"]
    """0 to 255."""
    first: Int[Tensor, "level"]
    """Index of each level's first pixel."""
    columns: Int[Tensor, "level"]
    """Pixels of a row of each level, with its border."""
    last: Int[Tensor, "camera"]
    """The coarsest level that each camera has."""
    subject_px: Float[Tensor, "camera"]
    """Root of the subject's area in each image."""

    @classmethod
    def of(
        cls, images: Float[Tensor, "camera channel rows columns"], sizes_px: Int[Tensor, "camera 2"], mask: int
    ) -> "PackedLevels":
        """All scales of images from 0 to 255, whose channel `mask` shows the subject."""
        levels = halvings(images, LEVELS - 1, lambda means: (means + 0.5).floor(), CONSTANT)
        area = levels[MEASURED][:, mask].double().sum((1, 2)) / 255 * 4**MEASURED
        sides = torch.tensor([2**level for level in range(LEVELS)])
        shortest = (sizes_px.amin(1)[:, None] + sides - 1) // sides
        last = (shortest > SMALLEST_PX).sum(1).clamp_max(LEVELS - 1)
        return cls(*_laid_out(levels), last, area.sqrt().clamp_min(1))

    def level(self, footprint_px: Float[Tensor, "camera"]) -> Int[Tensor, "camera"]:
        """Each camera's level whose pixels are about as large as so many of the image's."""
        return torch.minimum(footprint_px.clamp_min(1).log2().round().long(), self.last)

    def at(self, seen: Seen, level: Int[Tensor, "camera"], channels: int) -> Float[Tensor, "ray place camera channel"]:
        """The first channels of each camera's level, bilinearly, in [0, 1]; meaningless where nothing is in view."""
        scale = 0.5 ** level.double()
        x, y = seen.u * scale + 0.5, seen.v * scale + 0.5
        left, top = x.floor(), y.floor()
        right, below = ((x - left).float()[..., None], (y - top).float()[..., None])
        columns, size = self.columns[level], self.values.shape[1]
        corner = self.first[level] + torch.arange(level.shape[0]) * size + top.long() * columns + left.long()
        flat = self.values.flatten(0, 1)[:, :channels]
        upper = (1 - right) * flat[corner] + right * flat[corner + 1]
        lower = (1 - right) * flat[corner + columns] + right * flat[corner + columns + 1]
        return ((1 - below) * upper + below * lower) / 255


def _laid_out(levels: list[Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """All levels as one row of pixels, channels last; where each begins, and how long its rows are.

    The finest lies on the left of a sheet, those below `CONSTANT` under each other on the right; then come the others.
    """
    whole, right, others = levels[0], levels[1:CONSTANT], levels[CONSTANT:]
    height, width, half = whole.shape[2] + SPARE, whole.shape[3] + 1, right[0].shape[3] + 1
    left = F.pad(whole, (1, 0, 1, SPARE - 1))
    strips = [F.pad(level, (1, half - 1 - level.shape[3], 1, 0)) for level in right]
    below = height - sum(level.shape[2] for level in strips)
    sheet = torch.cat([left, F.pad(torch.cat(strips, 2), (0, 0, 0, below))], 3)
    rows = [F.pad(level, (1, 0, 1, 0)) for level in others]
    values = torch.cat([image.flatten(2) for image in (sheet, *rows)], 2).movedim(1, 2)
    tops = torch.cat([torch.full((1,), size, dtype=torch.long) for size in (0, *(s.shape[2] for s in strips[:-1]))])
    tops, rows_px = tops.cumsum(0), sheet.shape[3]
    sizes = torch.tensor([0, *(level.shape[2] * level.shape[3] for level in rows)]).cumsum(0)[:-1]
    first = [torch.zeros(1, dtype=torch.long), tops * rows_px + width, sizes + sheet.shape[2] * rows_px]
    columns = [torch.full((CONSTANT,), rows_px, dtype=torch.long), torch.tensor([level.shape[3] for level in rows])]
    return values, torch.cat(first), torch.cat(columns)


@dataclass(frozen=True)
class PackedRig:
    """The cameras of a rig, as `SweepNet` looks them up: a `Rig` whose sizes and scales need not be known."""

    cameras: RigCameras
    levels: PackedLevels
    depth: Float[Tensor, "camera rows columns"]
    is_source: Bool[Tensor, "camera"]
    all_cameras: RigCameras
    outlines: PackedLevels
    rays_at_once: ClassVar[int | None] = None

    @classmethod
    def of(cls, given: ViewInputs) -> "PackedRig":
        """The cameras that are chosen, and the masks of all."""
        everyone = RigCameras.of(given.rig_K, given.rig_camera_from_world, given.image_sizes_px)
        cameras = RigCameras(*(values[given.chosen] for values in everyone))
        rgb, mask = given.images[given.chosen].float(), given.masks[given.chosen].float()
        depth = given.proxy_depths[given.chosen]
        black = ((rgb * mask[:, None] + 127) / 255).floor()
        shown = torch.cat([black, mask[:, None], 255 * (depth > 0).float()[:, None]], 1)
        levels = PackedLevels.of(shown, cameras.sizes_px, 3)
        outlines = PackedLevels.of(given.masks.float()[:, None], given.image_sizes_px, 0)
        return cls(cameras, levels, depth, given.is_source, everyone, outlines)

    def look_up(self, rays: Rays, source_views: Sequence[str], step_px: float, scale: Scale) -> Places:
        """What every camera shows at places along rays, as `lookup.look_up`; sources are known by themselves here."""
        viewer = Viewer.of(rays.camera)
        seen = seen_by(self.cameras, viewer, rays.uv_px, rays.z_m)
        fine, wide = _levels(self.levels, self.cameras, viewer, step_px, scale)
        inside = seen.inside.float()
        cosine = inside * cosines(self.cameras, viewer, rays.uv_px, rays.z_m)
        behind = self._behind(seen) / scale.size_m
        near, far = (torch.where(seen.inside, _softsign(behind / reach), 0.0) for reach in (NEAR, FAR))
        prior = torch.where(seen.inside, (4 * cosine).exp() / (1 + (6 * near).exp()), 0.0)
        prior = (prior / (prior.sum(2, keepdim=True) + 1e-6)).float()
        shown = inside[..., None] * self.levels.at(seen, fine, 4)
        around = inside[..., None] * self.levels.at(seen, wide, 5)
        mean = (prior[..., None] * shown[..., :3]).sum(2)
        square = (prior[..., None] * shown[..., :3].square()).sum(2)
        told = [near.float(), far.float(), cosine.float(), inside * self.is_source, inside]
        differs = inside[..., None] * (shown[..., :3] - mean[:, :, None])
        features = torch.cat([shown, torch.stack(told, -1), around, differs, prior[..., None]], -1)
        variance = CONTRAST * (square - mean.square()).clamp_min(0)
        stats = torch.cat([mean, variance, self._least(rays, viewer, step_px, scale)], -1)
        return Places(features, prior, stats)

    def _behind(self, seen: Seen) -> Float[Tensor, "ray place camera"]:
        """How far each place is behind the proxy as each camera sees it, metres; 0 where there is no proxy."""
        rows, columns = self.depth.shape[1:]
        first = torch.arange(self.depth.shape[0]) * (rows * columns)
        there = self.depth.flatten()[first + seen.v.long() * columns + seen.u.long()].double()
        return torch.where(there > 0, seen.z - there, 0.0)

    def _least(self, rays: Rays, viewer: Viewer, step_px: float, scale: Scale) -> Float[Tensor, "ray place 4"]:
        """The two smallest masks and the two smallest means around, of all cameras that have the place in view."""
        seen = seen_by(self.all_cameras, viewer, rays.uv_px, rays.z_m)
        levels = _levels(self.outlines, self.all_cameras, viewer, step_px, scale)
        values = [torch.where(seen.inside, self.outlines.at(seen, level, 1)[..., 0], 1.0) for level in levels]
        return torch.cat([two_least(value) for value in values], -1)


def two_least(values: Float[Tensor, "*place camera"]) -> Float[Tensor, "*place 2"]:
    """The two smallest of the cameras' values in [0, 1], the smaller first; 1 where there is no second."""
    first = values.argmin(-1, keepdim=True)
    others = torch.where(torch.arange(values.shape[-1]) == first, 1.0, values)
    return torch.stack([values.amin(-1), others.amin(-1)], -1)


def _levels(
    levels: PackedLevels, cameras: RigCameras, viewer: Viewer, step_px: float, scale: Scale
) -> tuple[Int[Tensor, "camera"], Int[Tensor, "camera"]]:
    """Each camera's level with pixels as far apart as the rays are, and its level that spans `AROUND`."""
    depth_m = torch.as_tensor(scale.depth_m).double()
    away_m = (cameras.centers - (viewer.center + depth_m * viewer.forward)).square().sum(-1).sqrt().clamp_min(1e-6)
    fine = levels.level(step_px * depth_m / viewer.focal_px * cameras.focal_px / away_m)
    return fine, torch.maximum(fine, levels.level(AROUND * levels.subject_px))


def _softsign(x: Tensor) -> Tensor:
    return x / (1 + x.abs())
