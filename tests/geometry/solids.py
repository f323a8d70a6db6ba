"""Analytic solids and rigs whose silhouettes are known exactly."""

import math

import torch
import trimesh

from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras, concatenate_cameras, pinhole, pixel_centers, unproject
from viewmend.geometry.mesh import Mesh
from viewmend.geometry.rigid import look_at

UP = torch.tensor([0.0, 1.0, 0.0])


def camera_at(eye, target=(0.0, 0.0, 0.0), width=96, height=80, fov=0.7, name="view") -> Cameras:
    """A camera at `eye` that looks at `target`; y is up."""
    pose = look_at(torch.tensor(eye, dtype=torch.float32), torch.tensor(target, dtype=torch.float32), UP)
    return pinhole(fov, width, height, pose, name)


def dome(count: int, distance: float = 2.5, **options) -> Cameras:
    """Cameras at equal angles around the origin, by turns a little above and below it."""
    cameras = []
    for i in range(count):
        angle = 2 * math.pi * i / count
        eye = (
            distance * math.cos(angle),
            (0.8, -0.3, 0.2)[i % 3] * distance / 2.5,
            distance * math.sin(angle),
        )
        cameras.append(camera_at(eye, name=f"c{i}", **options))
    return concatenate_cameras(cameras)


def ball_masks(cameras: Cameras, center=(0.0, 0.0, 0.0), radius: float = 0.5) -> torch.Tensor:
    """Exact silhouettes: 255 where the ray through a pixel's centre hits the ball in front of the camera."""
    width, height = cameras.max_size_px
    pixels = pixel_centers(width, height).reshape(1, -1, 2).expand(len(cameras), -1, -1)
    rays = unproject(pixels, torch.ones(pixels.shape[:2]), cameras) - cameras.centers[:, None]
    rays = torch.nn.functional.normalize(rays, dim=-1)
    offset = torch.tensor(center) - cameras.centers[:, None]
    along = (offset * rays).sum(-1)
    hit = (along > 0) & (offset.square().sum(-1) - along.square() <= radius**2)
    return (hit * 255).to(torch.uint8).view(len(cameras), height, width)


def around(half: float, center=(0.0, 0.0, 0.0)) -> Bounds:
    """The cube of side 2 * half about `center`."""
    middle = torch.tensor(center)
    return Bounds(middle - half, middle + half)


def ball_mesh(subdivisions: int = 2) -> Mesh:
    """A closed, outward ball of radius 0.5 with 20 * 4**subdivisions triangles."""
    ball = trimesh.creation.icosphere(subdivisions, radius=0.5)
    return Mesh(torch.tensor(ball.vertices, dtype=torch.float32), torch.tensor(ball.faces, dtype=torch.int32))


def _in_trimesh(mesh: Mesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices.numpy(), mesh.faces.numpy(), process=False)


def volume(mesh: Mesh) -> float:
    """Signed volume of a closed mesh: positive if its faces look outward."""
    return float(_in_trimesh(mesh).volume)


def is_closed(mesh: Mesh) -> bool:
    """Whether each side belongs to two triangles, which pass it in opposite directions."""
    return _in_trimesh(mesh).is_watertight and _in_trimesh(mesh).is_winding_consistent


def silhouette_iou(depth: torch.Tensor, mask: torch.Tensor) -> float:
    """Overlap of what a proxy covers with a mask."""
    covered, true = depth > 0, mask > 127
    return float((covered & true).sum() / (covered | true).sum())
