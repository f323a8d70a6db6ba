"""Cameras of viewers: on an orbit around the subject by angles, or anywhere by a matrix."""

import math
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras, pinhole
from viewmend.geometry.orbit import horizontal_axes, upright
from viewmend.geometry.rigid import look_at, rigid
from viewmend.live.protocol import Camera

ARC_GAP = 1.5
"""Cameras form an arc if the widest gap between neighbours is at least this multiple of the second widest."""


@dataclass(frozen=True)
class HomeView:
    """Axes of the orbit around the subject, and the initial view."""

    center: Float[Tensor, "3"]
    """Centre of the subject, metres."""
    up: Float[Tensor, "3"]
    front: Float[Tensor, "3"]
    """Horizontal unit vector to azimuth 0."""
    side: Float[Tensor, "3"]
    """Horizontal unit vector to azimuth 90 degrees."""
    azimuth: float
    """Azimuth and elevation of the initial view, degrees."""
    elevation: float
    distance_m: float
    fov_y: float
    """Field of view of the shorter side, degrees."""

    def as_json(self) -> dict[str, Any]:
        """Its part of the message `rig`."""
        axes = {key: _list(getattr(self, key)) for key in ("center", "up", "front", "side")}
        names = {
            "azimuth": self.azimuth,
            "elevation": self.elevation,
            "distance": self.distance_m,
            "fov_y": self.fov_y,
        }
        return axes | {"home": {name: round(value, 4) for name, value in names.items()}}


def home_view(cameras: Cameras, center: Float[Tensor, "3"], up: Float[Tensor, "3"] | None) -> HomeView:
    """Find the axes of the orbit, with azimuths as in `geometry.orbit`, and the initial view.

    The initial view is in the middle of the cameras' arc or, if they stand all around,
    halfway between the first camera and its neighbour; distance, elevation and field of
    view are those of the cameras.

    `center` is the subject's, in metres; `up` the up axis of the world, None to estimate it from the cameras.
    """
    cameras = cameras.to("cpu")
    center = center.cpu().float()
    up = upright(cameras) if up is None else (up / up.norm()).cpu().float()
    front, side = horizontal_axes(up)
    offsets = cameras.centers - center
    distance = offsets.norm(dim=-1)
    azimuths = torch.rad2deg(torch.atan2(offsets @ side, offsets @ front))
    after = ((azimuths - azimuths[0]) % 360).sort().values
    gaps = torch.cat([after, after.new_tensor([360.0])]).diff()
    widest = int(gaps.argmax())
    others = gaps.sort().values[:-1]
    if not len(others) or float(gaps[widest]) >= ARC_GAP * float(others[-1]):
        # Opposite to the widest gap, relative to camera 0
        ahead = float(after[widest] + gaps[widest] / 2) + 180
    else:
        ahead = float(after[after > 1][0]) / 2
    elevation = float(torch.rad2deg(torch.asin((offsets @ up / distance).clamp(-1, 1))).mean())
    width, height = cameras.size_px[0].tolist()
    fov_y = 2 * math.degrees(math.atan(min(width, height) / 2 / float(cameras.K[0, 1, 1])))
    azimuth = round((float(azimuths[0]) + ahead + 180) % 360 - 180, 2)
    return HomeView(
        center, up, front, side, azimuth, max(-80.0, min(80.0, elevation)), float(distance.mean()), fov_y
    )


def view_camera(asked: Camera, home: HomeView, size_px: tuple[int, int], scale: float = 1.0) -> Cameras:
    """The requested camera, with its image resized by `scale` (sides rounded to even numbers, at least 16).

    `home` has the default pose and field of view; the lens is given in pixels of an image of `size_px`.
    """
    width, height = size_px
    if asked.R is not None and asked.T is not None:
        pose = rigid(torch.tensor(asked.R).view(3, 3), torch.tensor(asked.T))
    else:
        center = home.center if asked.target is None else torch.tensor(asked.target)
        azimuth = math.radians(asked.azimuth)
        elevation = math.radians(asked.elevation)
        flat = math.cos(azimuth) * home.front + math.sin(azimuth) * home.side
        distance_m = home.distance_m if asked.distance is None else asked.distance
        eye = center + distance_m * (math.cos(elevation) * flat + math.sin(elevation) * home.up)
        pose = look_at(eye, center, home.up)
    if asked.fx is not None:
        cx = width / 2 if asked.cx is None else asked.cx
        cy = height / 2 if asked.cy is None else asked.cy
        K = [[asked.fx, 0.0, cx], [0.0, asked.fy or asked.fx, cy], [0.0, 0.0, 1.0]]
        camera = Cameras(("view",), torch.tensor([K]), pose[None], torch.tensor([[width, height]]))
    else:
        fov_rad = math.radians(home.fov_y if asked.fov_y is None else asked.fov_y)
        if asked.fov_y is None and height > width:  # the field of view is that of the shorter side
            fov_rad = 2 * math.atan(math.tan(fov_rad / 2) * height / width)
        camera = pinhole(fov_rad, width, height, pose)
    if scale < 1:
        camera = camera.resized(*(max(16, 2 * round(side * scale / 2)) for side in size_px))
    return camera


def stereo_pair(camera: Cameras, apart_m: float, center: Float[Tensor, "3"]) -> tuple[Cameras, Cameras]:
    """The parallel left and right eye of a stereo camera.

    Their principal points are shifted so that both show the depth of `center` (metres) at
    the same pixel, which is where a screen appears; if it is behind the camera, the eyes
    converge at infinity.
    """
    z = float(camera.camera_from_world[0, 2, :3] @ center.to(camera.K) + camera.camera_from_world[0, 2, 3])
    eyes = []
    for right_m in (-apart_m / 2, apart_m / 2):
        pose = camera.camera_from_world.clone()
        pose[:, 0, 3] -= right_m
        moved = right_m * float(camera.K[0, 0, 0]) / z if z > apart_m else 0.0
        eyes.append(replace(camera, camera_from_world=pose).moved(moved, 0.0))
    return eyes[0], eyes[1]


def cameras_json(cameras: Cameras) -> list[dict[str, Any]]:
    """Cameras in the protocol's form."""
    poses = cameras.camera_from_world.cpu()
    centers = cameras.centers.cpu()
    return [
        {
            "name": name,
            "width": int(cameras.size_px[n, 0]),
            "height": int(cameras.size_px[n, 1]),
            "K": _list(cameras.K[n]),
            "R": _list(poses[n, :3, :3]),
            "T": _list(poses[n, :3, 3]),
            "center": _list(centers[n]),
        }
        for n, name in enumerate(cameras.names)
    ]


def rig_json(
    name: str, cameras: Cameras, bounds: Bounds, home: HomeView, fps: float | None, assets: str | None
) -> dict[str, Any]:
    """The message `rig`, without its type.

    `assets` is the version of what pages draw, None if they draw nothing.
    """
    described = {
        "name": name,
        "cameras": cameras_json(cameras),
        "bounds": bounds_json(bounds),
        "assets": assets,
    }
    return described | home.as_json() | {"fps": fps}


def bounds_json(bounds: Bounds) -> dict[str, list[float]]:
    """Bounds in the protocol's form."""
    return {"low": _list(bounds.low), "high": _list(bounds.high)}


def _list(tensor: Tensor) -> list[float]:
    return [round(float(value), 6) for value in tensor.flatten()]
