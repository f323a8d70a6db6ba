"""What the cameras show at places along rays, looked up in images of many scales. Ours."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from viewmend.chosen_views import each
from viewmend.geometry.cameras import Cameras
from viewmend.inpainting.ray_sampling import subject_size_m
from viewmend.inpainting.sweep.pyramids import Pyramid, Rig
from viewmend.views import IncompleteView

FEATURES = 18
"""Each place has in each camera, in this order: RGB upon black and mask; how far it is behind the proxy, fine and
coarse; cosine to the viewer; whether the camera coloured the view; whether the place is in view; RGB, mask and the
proxy's coverage around; how RGB differs from the cameras' mean; the first opinion on who sees it."""
COLOUR, MASK, IN_VIEW = slice(0, 3), slice(3, 4), 8
STATS = 10
"""Each place has: mean RGB, variance of RGB, the two smallest masks of the rig, the two smallest means around them."""
NEAR, FAR = 0.03, 0.2
"""Subject sizes at which the fine and the coarse distance behind the proxy are one half."""
CONTRAST = 10.0
"""Variances of colours are small numbers: shown times this."""
AROUND = 0.06
"""Side, in subject sizes, of the squares whose means tell what is around a place."""


@dataclass(frozen=True)
class Scale:
    """What lengths in a view are measured by; a part of a view is read by the whole view's."""

    size_m: float | Float[Tensor, ""]
    """The subject's size, metres."""
    depth_m: float | Float[Tensor, ""]
    """The median z-depth, metres. Both are tensors in what `torch.export` traces."""

    @classmethod
    def of(cls, view: IncompleteView) -> "Scale":
        """The scale of a view; 1 for both where there is no subject."""
        covered = view.depth > 0
        if not bool(covered.any()):
            return cls(1.0, 1.0)
        return cls(float(subject_size_m(view)), float(view.depth[covered].median()))


class Places(NamedTuple):
    """What was found at places along rays."""

    features: Float[Tensor, "ray place view 18"]
    prior: Float[Tensor, "ray place view"]
    """A first opinion on who sees the place; the sum over cameras is 1, or 0 where none has it in view."""
    stats: Float[Tensor, "ray place 10"]


class Level(NamedTuple):
    """A camera's image at one scale."""

    image: UInt8[Tensor, "rows columns channel"]
    """With a border of one black pixel."""
    scale: float
    """What positions in the camera's image are multiplied by."""


class Eyes(NamedTuple):
    """Cameras, and the two levels of each that are looked up: one as fine as the rays are apart, and a wide one."""

    cameras: Cameras
    fine: tuple[Level, ...]
    wide: tuple[Level, ...]


class Rays(NamedTuple):
    """Rays of a novel view, and places along them."""

    camera: Cameras
    uv_px: Float[Tensor, "ray 2"]
    z_m: Float[Tensor, "ray place"]

    def split(self, size: int | None) -> "list[Rays]":
        """Parts of so many rays; all in one where None."""
        if size is None:
            return [self]
        parts = zip(self.uv_px.split(size), self.z_m.split(size), strict=True)
        return [Rays(self.camera, *part) for part in parts]


@runtime_checkable
class Sight(Protocol):
    """What `SweepNet` looks places up in: a `Rig`, or what an export packs of one."""

    rays_at_once: ClassVar[int | None]
    """So many are weighed together; None for all."""

    def look_up(self, rays: Rays, source_views: Sequence[str], step_px: float, scale: Scale) -> Places:
        """As the function `look_up`."""
        ...


def look_up(rays: Rays, rig: Rig, source_views: Sequence[str], step_px: float, scale: Scale) -> Places:
    """What every camera of the rig shows at places along the rays of a novel view.

    Args:
        rays: of one camera.
        rig: the cameras.
        source_views: names of those that coloured the view.
        step_px: distance of neighbouring rays; images are looked up at the scale at which they are as far apart.
        scale: of the view.
    """
    if rays.z_m.device.type == "cpu":
        from viewmend.inpainting.sweep._lookup_numba import look_up_numba as implementation
    else:
        from viewmend.inpainting.sweep._lookup_torch import look_up_torch as implementation
    with torch.autocast(rays.z_m.device.type, enabled=False):  # positions need more than eight bits
        step_m = step_px * float(scale.depth_m) / float(rays.camera.K[0, 0, 0])
        pose = rays.camera.world_from_camera[0]
        middle = pose[:3, 3] + scale.depth_m * pose[:3, 2]
        views = _eyes(rig.views.frame.cameras, rig.pyramids, step_m, middle)
        outlines = _eyes(rig.silhouettes.cameras, rig.silhouette_pyramids, step_m, middle)
        is_source = [float(name in source_views) for name in views.cameras.names]
        return implementation(rays, views, each(rig.views, "depth"), is_source, outlines, float(scale.size_m))


def _eyes(cameras: Cameras, pyramids: Sequence[Pyramid], step_m: float, middle: Float[Tensor, "3"]) -> Eyes:
    """Every camera with the level whose pixels span `step_m` at the subject, and the one that spans `AROUND`."""
    away_m = (cameras.centers - middle).norm(dim=-1).clamp_min(1e-6).tolist()
    fine, wide = [], []
    for pyramid, focal_px, distance_m in zip(pyramids, cameras.K[:, 0, 0].tolist(), away_m, strict=True):
        level = pyramid.level(step_m * focal_px / distance_m)
        wider = max(level, pyramid.level(AROUND * pyramid.subject_px))
        fine.append(Level(pyramid.levels[level], 0.5**level))
        wide.append(Level(pyramid.levels[wider], 0.5**wider))
    return Eyes(cameras, tuple(fine), tuple(wide))
