"""Complete the views of another renderer: `python examples/02_own_renderer.py [OUT.png]`.

This renderer knows the surface and colours it from the nearest camera; what that camera does not see is missing.
"""

import sys
from pathlib import Path

import torch

from viewmend import (
    Cameras,
    IncompleteView,
    MultiViewFrame,
    Silhouettes,
    Stream,
    Studio,
    StudioConfig,
    load_inpainter,
    orbit,
    write_image,
)


class Surface:
    """The renderer's geometry. A stream only calls `depth`."""

    def __init__(self, studio: Studio, time: int) -> None:
        self.studio = studio
        self.time = time

    def depth(self, cameras: Cameras) -> torch.Tensor:
        """z-depth in metres, (view, height, width); 0 where there is no surface."""
        return self.studio.truth(cameras, self.time).depth


def render(frame: MultiViewFrame, target: Cameras, depth: torch.Tensor) -> IncompleteView:
    """The surface, whose depth in the view is (height, width), with the colours of the nearest camera."""
    by_distance = (frame.cameras.centers - target.centers).norm(dim=1).argsort()
    names = tuple(frame.cameras.names[index] for index in by_distance)
    nearest = frame.select(names[:1])
    # From the view's pixels to points, and on to pixels of the nearest camera.
    v, u = torch.meshgrid(*(torch.arange(side) + 0.5 for side in depth.shape), indexing="ij")
    rays = target.K[0].inverse() @ torch.stack([u, v, torch.ones_like(u)]).reshape(3, -1)
    in_view = rays * depth.reshape(1, -1)
    source_from_view = nearest.cameras.camera_from_world[0] @ target.camera_from_world[0].inverse()
    in_source = source_from_view[:3, :3] @ in_view + source_from_view[:3, 3:]
    projected = nearest.cameras.K[0] @ in_source
    column, row = (projected[:2] / projected[2]).nan_to_num().floor().long()
    height, width = nearest.depth.shape[1:]
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    pixel = (row.clamp(0, height - 1), column.clamp(0, width - 1))
    # A point is coloured if nothing is in front of it there.
    in_front = (nearest.depth[0][pixel] - in_source[2]).abs() < 0.03
    covered = depth > 0
    coloured = covered & (inside & in_front).reshape(depth.shape)
    rgb = nearest.rgb[0][:, *pixel].reshape(3, *depth.shape) / 255
    masks = Silhouettes(frame.mask, frame.cameras)
    weights = coloured.float()[None]
    error = (covered & ~coloured).float()
    known = (target, rgb * coloured, covered.float(), error, depth)
    return IncompleteView(*known, names[:1], weights, frame.time, candidate_views=names, silhouettes=masks)


def main(out: Path, size_px: int = 256, time: int = 0) -> torch.Tensor:
    """Write the rendered view, and the completed one on grey; return rendered, completed and true colours."""
    studio = Studio(StudioConfig(seed=10003, cameras=6, frames=time + 1, size_px=size_px))
    target = orbit([0.5], (size_px, size_px), elevation_rad=0.3)
    surface = Surface(studio, time)
    stream = Stream(load_inpainter("views"))
    stream.add_frame(studio.read(time), surface)
    view = render(studio.read(time), target, surface.depth(target)[0])
    completed = stream.mend(view).completed  # its colours are on black
    row = torch.cat([view.rgb, completed.rgb + (1 - completed.opacity) * 0.5], 2).clamp(0, 1)
    write_image(out, (row * 255).byte().movedim(0, -1).contiguous().numpy())
    truth = studio.truth(target, time)
    return torch.stack([view.rgb, completed.rgb, truth.rgb[0] / 255 * (truth.mask[0] / 255)])


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "out/own_renderer.png"))
