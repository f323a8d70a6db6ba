"""What stands behind the performer on a real stage: a plain wall and floor."""

import torch
from jaxtyping import Float
from torch import Tensor

from viewmend.geometry.cameras import Cameras, pixel_centers

_WALLS = ((0.05, 0.35, 0.08), (0.22, 0.22, 0.23), (0.04, 0.04, 0.05), (0.6, 0.6, 0.58), (0.06, 0.12, 0.4))
"""Linear light: green screen, grey, dark, white, blue screen."""


def stage_backdrop(cameras: Cameras, seed: int) -> Float[Tensor, "view 3 height width"]:
    """Linear light behind the subject in each camera's image: a wall that darkens downwards into a floor.

    The colours are seeded. Rays are looked at by their elevation alone, so that all cameras agree on a far backdrop.
    """
    generator = torch.Generator().manual_seed(seed)
    wall = torch.tensor(_WALLS[int(torch.randint(len(_WALLS), (), generator=generator))])
    floor = wall * (0.5 + 0.6 * float(torch.rand((), generator=generator)))
    width, height = cameras.max_size_px
    pixels = pixel_centers(width, height, cameras.K.device).flatten(0, 1)
    pixels = torch.cat([pixels, torch.ones_like(pixels[:, :1])], -1)
    up_from_pixel = cameras.camera_from_world[:, :3, 1:2].mT @ torch.linalg.inv(cameras.K)
    rays = torch.linalg.inv(cameras.K) @ pixels.T
    upward = (up_from_pixel @ pixels.T)[:, 0] / rays.norm(dim=1)
    share = torch.sigmoid((upward + 0.15) * 12)[:, None]
    wall, floor = (c.to(pixels)[None, :, None] for c in (wall, floor))
    return ((floor + (wall - floor) * share) * (0.9 + 0.2 * upward[:, None])).unflatten(-1, (height, width))
