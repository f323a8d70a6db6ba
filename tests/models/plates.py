"""A tiny analytic scene: cameras side by side look at a flat, patterned plate."""

from dataclasses import replace

import torch

from viewmend.geometry.cameras import Cameras, concatenate_cameras, pixel_centers
from viewmend.models.base import ContextProvider
from viewmend.models.paper.config import PaperConfig
from viewmend.models.paper.context import ContextFrame
from viewmend.models.paper.patch_transformer import PatchTransformer
from viewmend.models.views.config import RaysConfig
from viewmend.models.views.ray_fill import RayFill
from viewmend.types import ContextViews, IncompleteView, MultiViewFrame

FOCAL_PX, DISTANCE_M = 60.0, 2.0
WIDTH, HEIGHT = 90, 74  # not divisible by 4, 16 or 28
NAMES = ("left", "right")
OFFSETS_M = {"left": -0.2, "right": 0.25, "novel": 0.03, "third": 0.1}

TINY = PaperConfig(
    widths=(8,) * 3 + (16,) * 5 + (8,),
    dim=64,
    heads=4,
    groups=2,
    blocks=2,
    n_c=2,
    n_w=2,
    k_w=4,
    num_source_views=2,
)


def tiny(seed: int = 0, **changes) -> PatchTransformer:
    """A patch transformer with random weights, none of them zero."""
    torch.manual_seed(seed)
    return perturbed(PatchTransformer(replace(TINY, **changes)), seed)


def tiny_rays(seed: int = 0) -> RayFill:
    """A ray fill of three cameras with random weights, none of them zero."""
    torch.manual_seed(seed)
    return perturbed(RayFill(RaysConfig(num_views=3)), seed)


def perturbed(net, seed: int):
    """The network in evaluation mode with noise on all parameters."""
    generator = torch.Generator().manual_seed(seed)
    net.eval()
    with torch.no_grad():
        for parameter in net.parameters():
            parameter += 0.05 * torch.randn(parameter.shape, generator=generator)
    return net


def encode(net: PatchTransformer, views: ContextViews) -> tuple[ContextFrame, ...]:
    """The context frames of one time step."""
    return net.encode_contexts([views])[0]


def camera(name: str, width: int = WIDTH, height: int = HEIGHT) -> Cameras:
    camera_from_world = torch.eye(4)
    camera_from_world[0, 3] = -OFFSETS_M[name]
    K = torch.tensor([[FOCAL_PX, 0, width / 2], [0, FOCAL_PX, height / 2], [0, 0, 1.0]])
    return Cameras((name,), K[None], camera_from_world[None], torch.tensor([[width, height]]))


def look(at: Cameras, time: int) -> tuple[torch.Tensor, torch.Tensor]:
    """RGB and mask of the plate, an ellipse of 0.9 m by 0.7 m that drifts and changes its pattern."""
    width, height = at.max_size_px
    uv = pixel_centers(width, height)
    x = (uv[..., 0] - width / 2) / FOCAL_PX * DISTANCE_M - float(at.camera_from_world[0, 0, 3])
    y = (uv[..., 1] - height / 2) / FOCAL_PX * DISTANCE_M
    x = x - 0.02 * time
    mask = ((x / 0.9) ** 2 + (y / 0.7) ** 2 < 1).float()
    rgb = torch.stack(
        [0.5 + 0.5 * torch.sin(9 * x + c + 0.1 * time) * torch.cos(7 * y - c) for c in range(3)]
    )
    return rgb * mask, mask


def context(time: int, names: tuple[str, ...] = NAMES, **size) -> ContextViews:
    cameras = concatenate_cameras([camera(name, **size) for name in names])
    seen = [look(cameras[i], time) for i in range(len(names))]
    rgb, mask = (torch.stack(parts) for parts in zip(*seen, strict=True))
    frame = MultiViewFrame(cameras, (rgb * 255).byte(), (mask * 255).byte(), time)
    return ContextViews(frame, mask * DISTANCE_M)


def view(time: int, hole: tuple[int, int, int, int] | None = (20, 40, 30, 55), **size) -> IncompleteView:
    """The plate from between the cameras with a hole (top, bottom, left, right), soft at its left edge."""
    at = camera("novel", **size)
    rgb, mask = look(at, time)
    error = torch.zeros_like(mask)
    if hole is not None:
        top, bottom, left, right = hole
        error[top:bottom, left:right] = 1
        error[top:bottom, left] = 0.5
    error = error * mask
    weights = torch.stack([mask * (1 - error) / 2] * 2)
    return IncompleteView(at, rgb * (1 - error), mask, error, mask * DISTANCE_M, NAMES, weights, time)


class Rig(ContextProvider):
    """A provider that records requests: frames from `start` on, without the (camera, frame) pairs in `silent`."""

    def __init__(self, start: int = 0, silent: frozenset[tuple[str, int]] = frozenset(), **size) -> None:
        super().__init__(self._look)
        self.start, self.silent, self.size = start, silent, size
        self.asked: list[tuple[int, tuple[str, ...]]] = []

    def _look(self, time: int, names: tuple[str, ...]) -> ContextViews | None:
        self.asked.append((time, names))
        there = tuple(name for name in names if (name, time) not in self.silent)
        return context(time, there, **self.size) if there and time >= self.start else None
