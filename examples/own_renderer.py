"""Complete the views of another renderer: `python examples/own_renderer.py [OUT.png]`.

For each view a renderer provides colours, the subject's mask, which of its pixels it could not colour, and their depth.
The inpainter also needs the camera images, and the depth of the renderer's geometry in these cameras. Here the renderer
splats points: depth sensors of all six cameras provide the surface, but only the nearest camera provides colour. What
that camera does not see is missing.
"""

import math
import sys
from pathlib import Path

import torch

from viewmend import Stream
from viewmend.data.images import write_image
from viewmend.geometry.cameras import Cameras, pixel_centers, project, unproject
from viewmend.models.base import Inpainter
from viewmend.models.checkpoint import load_inpainter
from viewmend.rendering.view import select_closest
from viewmend.studio.rigs import orbit
from viewmend.studio.stage import Studio, StudioConfig
from viewmend.types import CompletedView, IncompleteView, MultiViewFrame, Silhouettes


class DepthSensors:
    """Geometry of our own, from each camera's depth sensor. A stream only calls `depth(cameras)`."""

    def __init__(self, frame: MultiViewFrame) -> None:
        self.frame = frame

    def depth(self, cameras: Cameras) -> torch.Tensor:
        """z-depth in metres, (view, height, width); 0 where there is no surface."""
        measured = self.frame.select(cameras.names).depth
        assert measured is not None
        return measured


def splat(frame: MultiViewFrame, target: Cameras, coloured: tuple[str, ...]) -> tuple[torch.Tensor, torch.Tensor]:
    """Splat all pixels of the named cameras as squares of 3 x 3 pixels.

    Returns colour (3, h, w) and depth (h, w) of the nearest point in each pixel; 0 where there is none.
    """
    seen = frame.select(coloured)
    assert seen.depth is not None
    views, _, height, width = seen.rgb.shape
    pixels = pixel_centers(width, height).reshape(1, -1, 2).expand(views, -1, -1)
    points = unproject(pixels, seen.depth.flatten(1), seen.cameras)[seen.depth.flatten(1) > 0]
    colours = (seen.rgb / 255).movedim(1, -1).reshape(views, -1, 3)[seen.depth.flatten(1) > 0]

    uv, z = (part[0] for part in project(points, target))
    width, height = target.max_size_px
    depth, rgb = torch.full((height * width,), math.inf), torch.zeros(height * width, 3)
    for dx, dy in [(0, 0), (-1, 0), (1, 0), (0, -1), (0, 1), (-1, -1), (1, 1), (-1, 1), (1, -1)]:
        column, row = (uv.floor().long() + torch.tensor([dx, dy])).unbind(-1)
        inside = (z > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        place = (row * width + column)[inside]
        nearest = depth.scatter_reduce(0, place, z[inside], "amin")
        first = z[inside] <= nearest[place]
        rgb[place[first]] = colours[inside][first]
        depth = nearest
    depth = torch.where(depth.isfinite(), depth, 0.0)
    return rgb.T.reshape(3, height, width), depth.reshape(height, width)


def render(frame: MultiViewFrame, target: Cameras, center: torch.Tensor) -> IncompleteView:
    """Render a view: the surface of all sensors with the colours of the nearest camera."""
    nearest = select_closest(target, frame.cameras, center, len(frame.cameras))
    chosen = nearest[:1]
    _, surface = splat(frame, target, nearest)
    rgb, depth = splat(frame, target, chosen)
    mask = (surface > 0).float()
    # Correct where that camera's points are the front-most surface, missing elsewhere on the subject.
    right = (depth > 0) & (depth <= surface + 0.03) & (surface > 0)
    error = mask * (~right).float()
    weights = right.float()[None]
    masks = None if frame.mask is None else Silhouettes(frame.mask, frame.cameras)
    return IncompleteView(target, rgb * right, mask, error, surface, chosen, weights, frame.time, nearest, masks)


def run(inpainter: Inpainter, frames: int = 4, size: int = 256, cameras: int = 6):
    """Complete a view of each frame; the last one, and the image a real camera would take."""
    studio = Studio(StudioConfig(seed=10003, cameras=cameras, frames=frames, size_px=size))
    target = orbit([0.5], (size, size), elevation_rad=0.3)
    center = torch.tensor([0.0, 0.95, 0.0])
    stream = Stream(inpainter)
    viewer, mended = None, None
    for time in range(frames):
        frame = studio.read(time)
        stream.add_frame(frame, DepthSensors(frame))
        mended = stream.mend(render(frame, target, center), viewer)
        viewer = mended.viewer
    assert mended is not None
    return mended.completed, studio.truth(target, frames - 1)


BACKGROUND = torch.tensor([0.85, 0.88, 0.92])


def composite(completed: CompletedView, background: torch.Tensor) -> torch.Tensor:
    """The view on a background colour, (3, h, w). Its colours are on black, so none spills over the outline."""
    return completed.rgb + (1 - completed.opacity) * background[:, None, None]


def main() -> None:
    out = Path(sys.argv[1] if len(sys.argv) > 1 else "out/own_renderer.png")
    completed, truth = run(load_inpainter("views"))
    assert truth.mask is not None
    black = truth.rgb[0] / 255 * (truth.mask[0] / 255)
    pictures = torch.cat([completed.view.rgb, completed.rgb, composite(completed, BACKGROUND), black], 2)
    write_image(out, (pictures.clamp(0, 1) * 255).byte().movedim(0, -1).contiguous().numpy())
    holes = completed.view.error > 0
    for name, rgb in (("rendered", completed.view.rgb), ("completed", completed.rgb)):
        error = (rgb - black)[:, holes].square().mean()
        print(f"{name}: {-10 * math.log10(float(error)):.1f} dB in {int(holes.sum())} missing pixels")
    print(f"wrote {out}: rendered, completed, on a background, truth")


if __name__ == "__main__":
    main()
