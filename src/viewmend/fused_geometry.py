"""The geometry proxy of a frame, from its hull and the depth that a model predicts in views all around the subject."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from viewmend.frame_cache import CachedFrame
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras, concatenate_cameras, project
from viewmend.geometry.fusion import DepthViews, FusionConfig, fuse_depth
from viewmend.geometry.hull import HullConfig, OccupancyGrid
from viewmend.geometry.last_surface import LastSurface, stillness
from viewmend.geometry.proxy import GeometryProxy
from viewmend.geometry.virtual_cameras import surround
from viewmend.models.base import ContextProvider, DepthMap, Inpainter, RenderQuality
from viewmend.rendering.crop import grid_px, mesh_crop
from viewmend.rendering.view import RenderConfig, render_view
from viewmend.types import MultiViewFrame, Silhouettes
from viewmend.utils.cancellation import stop_if_cancelled
from viewmend.utils.tensors import to_mmap

LEAST_SIDE_PX = 16
"""The sides of the views whose depth is predicted have at least this many pixels."""

MAX_GAP = 3
"""The last frame's surface is used if that frame is at most this many frames older."""


@dataclass(frozen=True)
class FusedFrame:
    """A frame behind fused geometry, and what the next frame's geometry needs of it."""

    cached: CachedFrame
    occupancy: OccupancyGrid | None
    """The voxels of its proxy; None if that is the hull itself."""

    def surface_for(self, frame: MultiViewFrame) -> LastSurface | None:
        """Its surface, and how little has changed since; None unless a frame of the same cameras follows it."""
        own = self.cached.frame
        if self.occupancy is None or not 0 < frame.time - own.time <= MAX_GAP or not _same_rig(own, frame):
            return None
        still = stillness(_images(frame), _images(own))
        return LastSurface(self.occupancy, own.cameras, self.cached.depth(own.cameras.names), still)


def _same_rig(one: MultiViewFrame, other: MultiViewFrame) -> bool:
    """Whether both frames have images of the same cameras, calibrated alike."""
    a = one.cameras.on_host
    b = other.cameras.on_host
    return (
        a.names == b.names
        and torch.equal(a.size_px, b.size_px)
        and torch.equal(a.K, b.K)
        and torch.equal(a.camera_from_world, b.camera_from_world)
    )


def _images(frame: MultiViewFrame) -> Tensor:
    """The images with their masks as a fourth channel, cut to the size of the largest."""
    assert frame.mask is not None, "frames with a hull have masks"
    width, height = frame.cameras.max_size_px
    return torch.cat([frame.rgb, frame.mask[:, None]], 1)[..., :height, :width]


def fuse_geometry(
    cached: CachedFrame,
    masks: Silhouettes,
    model: Inpainter,
    render: RenderConfig,
    config: FusionConfig,
    hull_config: HullConfig,
    last: FusedFrame | None = None,
) -> FusedFrame:
    """The frame with its hull tightened by depth that the model predicts behind it.

    Args:
        cached: the frame with its hull.
        masks: the masks that carved the hull.
        model: predicts depth (`Inpainter.predicts_depth`).
        render: how the views are rendered whose depth is predicted.
        config: parameters of the fusion.
        hull_config: parameters of the hull, except its resolution, which is that of the fusion.
        last: the frame that was fused last, if any. If the frame follows it, its surface counts where no
            image has changed (`FusedFrame.surface_for`).

    Returns:
        The frame with the fused proxy; with the hull itself if it is empty, or if no camera can be used.
        Encodings are dropped, because they depend on the hull's depth.

    Raises:
        CancelledError: the result is not needed any more (`cancellable`).
    """
    hull = cached.proxy
    assert isinstance(hull, GeometryProxy)
    if not len(hull.mesh.vertices):
        return FusedFrame(CachedFrame(cached.frame, hull), None)
    on_host = cached.frame.cameras.on_host
    cameras = surround(
        on_host, hull.bounds.on_host.center, config.max_views, math.radians(config.min_angle_deg)
    )
    predicted = []
    for number in range(len(cameras)):
        stop_if_cancelled()
        camera = _resized(cameras[number], hull.bounds, config.view_px).to(cached.frame.rgb.device)
        found = _predict(cached, camera, model, render)
        if found is not None:
            predicted.append(found)
    if not predicted:
        return FusedFrame(CachedFrame(cached.frame, hull), None)
    before = last.surface_for(cached.frame) if last is not None and config.last_share > 0 else None
    views = _stacked(predicted)
    fused = fuse_depth(hull, masks.mask, masks.cameras, views, config, hull_config, before)
    return FusedFrame(CachedFrame(cached.frame, to_mmap(fused.proxy)), to_mmap(fused.occupancy))


def _resized(camera: Cameras, bounds: Bounds, view_px: int) -> Cameras:
    """The camera, reduced so that the longest side of a box spans at most about this many pixels of its image.

    A camera that is next to the box, or inside it, keeps its image.
    """
    on_host = camera.on_host
    depth_m = float(project(bounds.on_host.center[None], on_host)[1])
    side_m = float(bounds.on_host.size_m.max())
    if depth_m < side_m / 2:
        return camera
    scale = min(1.0, view_px * depth_m / (side_m * float(on_host.K[0, 0, 0])))
    width, height = camera.max_size_px
    return camera.resized(max(LEAST_SIDE_PX, round(scale * width)), max(LEAST_SIDE_PX, round(scale * height)))


def _predict(
    cached: CachedFrame, camera: Cameras, model: Inpainter, render: RenderConfig
) -> tuple[Cameras, DepthMap] | None:
    """The depth of the part of a view that shows the subject, and the camera of that part; None without cameras."""
    proxy = cached.proxy
    assert isinstance(proxy, GeometryProxy)
    margin_px = model.crop_margin_px(RenderQuality()) or 0
    crop = mesh_crop(proxy.mesh.vertices, camera, margin_px, grid_px(margin_px))
    part = crop.of_camera(camera)
    view, _ = render_view(cached.frame, proxy, part, render, (), cached.depth)
    context = ContextProvider(lambda time, names: cached.context(names), memory=lambda time: cached.encoded)
    found = model.predict_depth(view, context)
    return None if found is None else (part, found)


def _stacked(predicted: list[tuple[Cameras, DepthMap]]) -> DepthViews:
    """All views in one, padded to the largest."""
    height = max(found.depth.shape[0] for _, found in predicted)
    width = max(found.depth.shape[1] for _, found in predicted)
    cameras = concatenate_cameras([camera for camera, _ in predicted])
    images = []
    for _, found in predicted:
        rows, columns = found.depth.shape
        images.append(F.pad(torch.stack(found), (0, width - columns, 0, height - rows)))
    depth, confidence = torch.stack(images, 1)
    return DepthViews(cameras, depth, confidence)
