"""Which way is up, for orbits and pictures: a default where a capture does not say."""

import torch
from jaxtyping import Float
from torch import Tensor

from viewmend.geometry.cameras import Cameras

AGREED = 0.5
"""Length of the mean of the images' up directions below which they do not agree."""


def upright(cameras: Cameras) -> Float[Tensor, "3"]:
    """The rig's up, a unit vector in the world.

    The mean of the images' up directions or, where these disagree (images partly upside down), the normal of the
    plane that the cameras lie in.
    """
    mean = -cameras.camera_from_world[:, 1, :3].mean(0)
    if float(mean.norm()) < AGREED:
        normal = torch.linalg.svd(cameras.centers - cameras.centers.mean(0)).Vh[2]
        mean = normal if float(normal @ mean) >= 0 else -normal
    return mean / mean.norm()


def horizontal_axes(up: Float[Tensor, "3"]) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """Where azimuth 0 and azimuth 90 degrees are, unit vectors in the world: +z and +x where `up` (unit) is +y."""
    ahead = up.new_tensor([0.0, 0.0, 1.0] if abs(float(up[2])) < 0.9 else [1.0, 0.0, 0.0])
    front = torch.nn.functional.normalize(ahead - (ahead @ up) * up, dim=0)
    return front, torch.linalg.cross(up, front)
