"""An analytic world: a ball whose colour is a smooth function of its surface, seen by a ring of cameras."""

import math
from dataclasses import replace

import torch

from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras, concatenate_cameras, pinhole, pixel_centers, unproject
from viewmend.geometry.mesh import Mesh
from viewmend.geometry.proxy import GeometryProxy
from viewmend.geometry.rigid import look_at
from viewmend.types import MultiViewFrame

RADIUS_M = 0.5


def camera_at(
    angle_deg: float, name: str, size: int = 48, height_m: float = 0.0, distance_m: float = 2.0
) -> Cameras:
    """A camera on a ring about the ball that looks at its centre; y is up."""
    angle = math.radians(angle_deg)
    eye = torch.tensor([distance_m * math.sin(angle), height_m, distance_m * math.cos(angle)])
    pose = look_at(eye, torch.zeros(3), torch.tensor([0.0, 1.0, 0.0]))
    return pinhole(0.7, size, size, pose, name)


def ring(count: int, size: int = 48) -> Cameras:
    """Cameras named c0, c1, ... at equal angles."""
    return concatenate_cameras([camera_at(360 * i / count, f"c{i}", size) for i in range(count)])


def photograph(cameras: Cameras, time: int = 0) -> MultiViewFrame:
    """What the cameras see: colour (1 + x / r, ...) / 2 of the ball's surface on black; exact mask and depth."""
    width, height = cameras.max_size_px
    pixels = pixel_centers(width, height).reshape(1, -1, 2).expand(len(cameras), -1, -1)
    ends = unproject(pixels, torch.ones(pixels.shape[:2]), cameras)
    centers = cameras.centers[:, None]
    along = ends - centers
    a, b = along.square().sum(-1), (along * centers).sum(-1)
    root = b.square() - a * (centers.square().sum(-1) - RADIUS_M**2)
    depth = torch.where(root > 0, (-b - root.clamp(min=0).sqrt()) / a, torch.zeros_like(a))
    surface = centers + along * depth[..., None]
    colour = (0.5 + 0.4 * surface / RADIUS_M) * (depth > 0)[..., None]
    rgb = (colour * 255).round().byte().mT.reshape(len(cameras), 3, height, width).contiguous()
    depth = depth.reshape(len(cameras), height, width)
    return MultiViewFrame(cameras, rgb, (depth > 0).byte() * 255, time, depth)


def photograph_at(center: tuple[float, float, float], cameras: Cameras, time: int = 0) -> MultiViewFrame:
    """`photograph`, with the ball elsewhere."""
    shift = torch.eye(4)
    shift[:3, 3] = torch.tensor(center)
    seen = photograph(replace(cameras, camera_from_world=cameras.camera_from_world @ shift), time)
    return replace(seen, cameras=cameras)


def proxy(rows: int = 48) -> GeometryProxy:
    """The ball as a mesh of rows of latitude."""
    latitude = torch.linspace(-math.pi / 2, math.pi / 2, rows + 1)
    longitude = torch.linspace(0, 2 * math.pi, 2 * rows + 1)[:-1]
    lat, lon = torch.meshgrid(latitude, longitude, indexing="ij")
    normals = torch.stack([lat.cos() * lon.sin(), lat.sin(), lat.cos() * lon.cos()], -1).reshape(-1, 3)
    i, j = torch.meshgrid(torch.arange(rows), torch.arange(2 * rows), indexing="ij")
    a, b = i * 2 * rows + j, i * 2 * rows + (j + 1) % (2 * rows)
    faces = torch.cat(
        [torch.stack([a, b, b + 2 * rows], -1), torch.stack([a, b + 2 * rows, a + 2 * rows], -1)]
    )
    half = torch.full((3,), RADIUS_M)
    return GeometryProxy(Mesh(RADIUS_M * normals, faces.reshape(-1, 3)), normals, Bounds(-half, half))


class BallCapture:
    """The ball as a `CaptureSource`; from frame to frame its colour changes a little."""

    name, fps, up = "ball", 10.0, None

    def __init__(self, cameras: Cameras, frames: int = 2):
        self.cameras = cameras
        self.frame_ids = tuple(f"{time:03d}" for time in range(frames))
        side = torch.full((3,), 1.2 * RADIUS_M)
        self.bounds = Bounds(-side, side)

    def read(self, time: int) -> MultiViewFrame:
        """The ball at this time, exact."""
        frame = photograph(self.cameras, time)
        return replace(frame, rgb=(frame.rgb.float() * (1 - 0.1 * time)).byte(), depth=None)


class AwayBall(BallCapture):
    """The ball, which is out of all cameras' sight at some times."""

    def __init__(self, cameras: Cameras, frames: int, away: set[int]):
        super().__init__(cameras, frames)
        self.away = away

    def read(self, time: int) -> MultiViewFrame:
        """The ball at this time, or black images and masks."""
        frame = super().read(time)
        return replace(frame, rgb=0 * frame.rgb, mask=0 * frame.mask) if time in self.away else frame
