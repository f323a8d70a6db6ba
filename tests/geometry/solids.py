"""Analytic solids and rigs whose silhouettes are known exactly."""

import math

import torch

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
        eye = (distance * math.cos(angle), (0.8, -0.3, 0.2)[i % 3] * distance / 2.5, distance * math.sin(angle))
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


def ball_mesh(rings: int = 12, sectors: int = 18, radius: float = 0.5) -> Mesh:
    """A closed, outward ball of 2 * sectors * (rings - 1) triangles."""
    polar = torch.linspace(0, math.pi, rings + 1)[1:-1, None]
    turn = torch.arange(sectors)[None] * (2 * math.pi / sectors)
    side = [polar.sin() * turn.cos(), polar.cos().expand(-1, sectors), polar.sin() * turn.sin()]
    poles = torch.tensor([[0.0, 1, 0], [0.0, -1, 0]])
    vertices = torch.cat([torch.stack(side, -1).reshape(-1, 3), poles]) * radius
    north, south = len(vertices) - 2, len(vertices) - 1
    faces = []
    for s in range(sectors):
        t = (s + 1) % sectors
        faces.append((north, t, s))
        for r in range(rings - 2):
            a, b, c, d = r * sectors + s, r * sectors + t, (r + 1) * sectors + s, (r + 1) * sectors + t
            faces += [(a, b, c), (b, d, c)]
        last = (rings - 2) * sectors
        faces.append((south, last + s, last + t))
    return Mesh(vertices, torch.tensor(faces, dtype=torch.int32))


def volume(mesh: Mesh) -> float:
    """Signed volume of a closed mesh: positive if its faces look outward."""
    a, b, c = mesh.vertices.double()[mesh.faces.long()].unbind(1)
    return float((torch.linalg.cross(a, b) * c).sum() / 6)


def sides(mesh: Mesh) -> tuple[torch.Tensor, torch.Tensor]:
    """How often each undirected and each directed side of the triangles occurs."""
    directed = mesh.faces.long()[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    undirected = directed.sort(1).values
    return (
        torch.unique(undirected, dim=0, return_counts=True)[1],
        torch.unique(directed, dim=0, return_counts=True)[1],
    )


def silhouette_iou(depth: torch.Tensor, mask: torch.Tensor) -> float:
    """Overlap of what a proxy covers with a mask."""
    covered, true = depth > 0, mask > 127
    return float((covered & true).sum() / (covered | true).sum())
