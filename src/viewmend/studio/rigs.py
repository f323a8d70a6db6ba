"""Camera rigs of the studio: rings and domes around the stage, and orbits for novel views."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from viewmend.geometry.cameras import Cameras, concatenate_cameras, pinhole
from viewmend.geometry.orbit import fov_y_showing
from viewmend.geometry.orbit import orbit as orbit_of
from viewmend.geometry.rigid import look_at, rotation_from_axis_angle

SUBJECT_CENTER_M = (0.0, 0.95, 0.0)
"""Target of all cameras, metres: the middle of a standing person at the stage's centre."""
VISIBLE_M = 2.4
"""Height and width of the view at the stage's centre, metres; a person of 1.75 m fills
three quarters."""
RADIUS_M = 3.0
"""Distance of the cameras from the stage's axis, or from the subject in a dome."""
HEIGHTS_M = (1.1, 1.8)
"""Heights of a ring's cameras above the floor, in turn."""
LAYER_HEIGHTS_M = (0.4, 1.2, 2.2)
"""Heights of a layered rig's cameras above the floor, in turn: low, middle and high, as in DNA-Rendering."""
DOME_RAD = (0.0, 1.2)
"""Elevations above the horizon between which a dome's cameras stand."""
UP = (0.0, 1.0, 0.0)


def ring_rig(count: int, size_px: tuple[int, int] = (512, 512), *, seed: int = 0) -> Cameras:
    """Place cameras around the stage at alternating heights, with small errors (degrees, centimetres)."""
    return _around(count, HEIGHTS_M, size_px, seed)


def layered_rig(count: int, size_px: tuple[int, int] = (512, 512), *, seed: int = 0) -> Cameras:
    """Place cameras around the stage in three layers, with the same errors as those of a ring."""
    return _around(count, LAYER_HEIGHTS_M, size_px, seed)


def _around(count: int, heights_m: Sequence[float], size_px: tuple[int, int], seed: int) -> Cameras:
    """Place cameras at equal angles around the stage, with alternating heights."""
    azimuth = torch.arange(_positive(count)) * 2 * math.pi / count
    height = torch.tensor([heights_m[n % len(heights_m)] for n in range(count)])
    eyes = torch.stack([RADIUS_M * azimuth.sin(), height, RADIUS_M * azimuth.cos()], -1)
    return _stand(eyes, size_px, seed)


def dome_rig(count: int, size_px: tuple[int, int] = (512, 512), *, seed: int = 0) -> Cameras:
    """Spread cameras evenly over a part of a sphere around the subject, with small errors."""
    low, high = (math.sin(e) for e in DOME_RAD)
    y = low + (high - low) * (torch.arange(_positive(count)) + 0.5) / count
    angle = torch.arange(count) * math.pi * (3 - math.sqrt(5))
    around = (1 - y * y).sqrt()
    eyes = RADIUS_M * torch.stack([around * angle.sin(), y, around * angle.cos()], -1) + torch.tensor(
        SUBJECT_CENTER_M
    )
    return _stand(eyes, size_px, seed)


def orbit(azimuths_rad: Sequence[float], size_px: tuple[int, int], *, elevation_rad: float = 0.15) -> Cameras:
    """Make novel cameras on a circle around the subject's middle.

    Azimuth 0 is in front (+z), and azimuths grow towards +x.

    Examples:
        >>> from viewmend import orbit
        >>> orbit([0.0, 0.5], (320, 240)).names
        ('orbit000', 'orbit001')
    """
    center = torch.tensor(SUBJECT_CENTER_M)
    up = torch.tensor(UP)
    shown = {"radius_m": RADIUS_M, "elevation_rad": elevation_rad, "visible_m": VISIBLE_M}
    return orbit_of(azimuths_rad, size_px, center=center, up=up, **shown)


def _stand(eyes: Float[Tensor, "view 3"], size_px: tuple[int, int], seed: int) -> Cameras:
    """Place cameras near `eyes` that look approximately at the subject's centre."""
    off = torch.randn(len(eyes), 3, 3, generator=torch.Generator().manual_seed(seed))
    center = torch.tensor(SUBJECT_CENTER_M)
    up = torch.tensor(UP)
    views = []
    for n, eye in enumerate(eyes):
        eye = eye + 0.04 * off[n, 0]
        pose = look_at(eye, center + 0.02 * off[n, 1], up)
        pose[:3] = rotation_from_axis_angle(torch.tensor([0.0, 0.0, 0.01 * float(off[n, 2, 0])])) @ pose[:3]
        fov = fov_y_showing(
            size_px, VISIBLE_M, float((eye - center).norm()) * (1 + 0.01 * float(off[n, 2, 1]))
        )
        views.append(pinhole(fov, *size_px, pose, f"cam{n:02d}"))
    return concatenate_cameras(views)


def _positive(count: int) -> int:
    if count < 1:
        raise ValueError(f"expected at least 1 camera, got {count}; 4 to 60 are usual")
    return count
