"""Views of random people, sizes and cameras, rendered from the hull, for what must hold for all of them."""

from dataclasses import replace

import torch

from viewmend.models.base import ContextProvider, State
from viewmend.models.views.model import ViewSynthNet
from viewmend.rendering.view import RenderConfig
from viewmend.stream import Stream, StreamConfig
from viewmend.studio.rigs import orbit
from viewmend.studio.stage import Studio, StudioConfig
from viewmend.types import CompletedView, IncompleteView, MultiViewFrame


def random_view(seed: int, net: ViewSynthNet, longest: int = 200) -> tuple[IncompleteView, ContextProvider]:
    """A view that is anywhere about a person, and what the cameras saw.

    One camera's image is smaller than the others'; in every third view E is soft and leaves half of the subject out.
    """
    chance = torch.Generator().manual_seed(seed)

    def between(low: int, high: int) -> int:
        return int(torch.randint(low, high + 1, (), generator=chance))

    size = between(80, longest), between(80, longest)
    studio = Studio(StudioConfig(seed=10000 + seed, cameras=between(4, 11), frames=1, size_px=size))
    frame = smaller(studio.read(0), between(0, len(studio.cameras) - 1), between(0, 15))
    stream = Stream(net, StreamConfig(render=RenderConfig(cameras=between(1, 3), error_rule="all")))
    seen = stream.add_frame(frame)
    angle, height = torch.rand(2, generator=chance).tolist()
    target = orbit([6.28 * angle], (between(64, longest), between(64, longest)), elevation_rad=height - 0.3)
    view = stream.render(target)
    if seed % 3 == 2:
        view = replace(
            view, error=view.error * torch.rand(view.error.shape, generator=chance).sub(0.3).clamp_min(0)
        )
    return view, ContextProvider(lambda _, names: seen.context(names))


def smaller(frame: MultiViewFrame, camera: int, by: int) -> MultiViewFrame:
    """The frame with an image that is cut on the right, and padded with zeros instead."""
    width = int(frame.cameras.size_px[camera, 0]) - by
    sizes, rgb, mask = frame.cameras.size_px.clone(), frame.rgb.clone(), frame.mask.clone()
    sizes[camera, 0], rgb[camera, :, :, width:], mask[camera, :, width:] = width, 0, 0
    return replace(frame, cameras=replace(frame.cameras, size_px=sizes), rgb=rgb, mask=mask)


def holed(view: IncompleteView) -> IncompleteView:
    """The view, half of whose pixels no camera colours."""
    left = torch.arange(view.mask.shape[1]) < view.mask.shape[1] // 2
    weights = torch.where(left, 0.0, view.weights)
    return replace(view, rgb=view.rgb * (weights.sum(0) > 0), weights=weights)


def mended(net: ViewSynthNet, view: IncompleteView, context: ContextProvider) -> CompletedView:
    """What the model itself makes of it."""
    return net.step(view, context, State())[0]


def images(completed: CompletedView) -> dict[str, torch.Tensor]:
    """What an export gives, by the names of its outputs."""
    assert completed.confidence is not None
    return {
        "completed_rgb": completed.rgb,
        "alpha": completed.opacity,
        "confidence": completed.confidence,
        "completed_depth": completed.surface_depth,
    }
