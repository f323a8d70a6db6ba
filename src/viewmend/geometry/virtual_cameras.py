"""Virtual cameras in the gaps of a rig, from which the geometry is looked at as well."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from viewmend.geometry.cameras import Cameras, concatenate_cameras
from viewmend.geometry.orbit import upright
from viewmend.geometry.rigid import look_at

NEIGHBOURS = 3
"""Virtual cameras stand between a camera and this many of its closest neighbours."""

STEPS = (1 / 3, 1 / 2, 2 / 3)
"""The parts of the way from a camera to its neighbour at which a virtual camera may stand."""

WIDEST_GAP_RAD = math.radians(130)
"""Two cameras that are farther apart than this, seen from the subject, have no virtual camera
between them."""

STEEP = 0.98
"""A view whose direction has a cosine above this with the rig's up keeps the up direction of its
camera's image."""


@dataclass(frozen=True)
class _Candidates:
    """Places where a virtual camera may stand."""

    direction: Float[Tensor, "place 3"]
    """The unit vector from the subject to each place."""
    distance_m: Float[Tensor, "place"]
    """The distance from the subject to each place."""
    camera: list[int]
    """The index of the real camera that is closest to each place."""


def surround(cameras: Cameras, center: Float[Tensor, "3"], most: int, min_angle_rad: float) -> Cameras:
    """Views all around the subject: cameras of the rig, and virtual cameras in the gaps between neighbours.

    Views are chosen one after the other, each as far as possible from those chosen before it; all
    real cameras come first. A virtual camera looks at the centre, with the focal lengths, the skew and the
    image size of the closest real camera; the centre is in the middle of its image.

    Args:
        cameras: the rig.
        center: the middle of the subject, metres.
        most: the largest number of views.
        min_angle_rad: the smallest angle between two views, as seen from the subject, in radians.
    """
    direction = normalize(cameras.centers - center, dim=1)
    real = [0, *_farthest_points(direction[:1], direction, most - 1, min_angle_rad)]
    parts = [cameras[real]]
    places = _candidates(cameras, center)
    if places is not None:
        chosen = _farthest_points(direction[real], places.direction, most - len(real), min_angle_rad)
        up = upright(cameras)
        parts += [_virtual_camera(cameras, center, places, place, up) for place in chosen]
    return concatenate_cameras(parts)


def _virtual_camera(
    cameras: Cameras, center: Float[Tensor, "3"], places: _Candidates, place: int, up: Float[Tensor, "3"]
) -> Cameras:
    """The virtual camera at a place. Where it looks along `up`, the up direction of its real camera is kept."""
    source = cameras[places.camera[place]]
    direction = places.direction[place]
    is_steep = abs(float(direction @ up)) > STEEP
    own_up = -source.camera_from_world[0, 1, :3] if is_steep else up
    pose = look_at(center + places.distance_m[place] * direction, center, own_up)
    K = source.K.clone()
    K[0, :2, 2] = source.size_px[0] / 2
    return Cameras((f"virtual{place:03d}",), K, pose[None], source.size_px)


def _candidates(cameras: Cameras, center: Float[Tensor, "3"]) -> _Candidates | None:
    """Places between each camera and its neighbours; None without any."""
    offset = cameras.centers - center
    distance_m = offset.norm(dim=1)
    direction = normalize(offset, dim=1)
    angle = torch.acos((direction @ direction.T).clamp(-1, 1)).fill_diagonal_(torch.inf)
    nearest = angle.argsort(1)[:, : min(NEIGHBOURS, len(cameras) - 1)].tolist()
    pairs = sorted({(min(a, b), max(a, b)) for a in range(len(cameras)) for b in nearest[a]})

    directions = []
    distances = []
    closest = []
    for a, b in pairs:
        if not 0 < float(angle[a, b]) <= WIDEST_GAP_RAD:
            continue
        for step in STEPS:
            directions.append(normalize((1 - step) * direction[a] + step * direction[b], dim=0))
            distances.append((1 - step) * distance_m[a] + step * distance_m[b])
            closest.append(a if step <= 1 / 2 else b)
    if not directions:
        return None
    return _Candidates(torch.stack(directions), torch.stack(distances), closest)


def _farthest_points(
    taken: Float[Tensor, "camera 3"], places: Float[Tensor, "place 3"], most: int, min_angle_rad: float
) -> list[int]:
    """Indices of unit vectors among `places`, each the farthest from those taken and chosen before it."""
    chosen: list[int] = []
    largest_cosine = (places @ taken.T).amax(1)
    while len(chosen) < most:
        farthest = int(largest_cosine.argmin())
        if math.acos(max(-1.0, min(1.0, float(largest_cosine[farthest])))) < min_angle_rad:
            break
        chosen.append(farthest)
        largest_cosine = torch.maximum(largest_cosine, places @ places[farthest])
    return chosen
