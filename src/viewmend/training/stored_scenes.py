"""Whole scenes on disk, small: one moment of a rig, its images compressed, and each held-out view with its truth.

A sample of whole views is some ten megabytes, most of which follows from images and a hull: those are kept, and the
rest is made again when it is read. So a scene's images are shared by all views of it, and renderings may vary.
"""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from random import Random

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from viewmend.baselines.classical import Unfilled
from viewmend.capture.images import MAX_PIXELS, decoded
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras
from viewmend.geometry.hull import HullConfig
from viewmend.geometry.mesh import Mesh, vertex_normals
from viewmend.geometry.proxy import GeometryProxy
from viewmend.leave_one_out.scenes import LeaveOneOut
from viewmend.rendering.view import RenderConfig
from viewmend.stream import Stream, StreamConfig
from viewmend.training.plan import DataPlan
from viewmend.training.samples import HeldOutCamera, Sample
from viewmend.training.scenes import SceneSource, StudioScenes
from viewmend.views import MultiViewFrame

STEPS = 65535
"""Vertices and depths are kept in so many steps of what they span."""
MAX_BYTES = 2**28
"""The most that a stored list of vertices or faces may say."""
AGAIN = "make the shard again"
FASTEST = 1
"""Level of compression: more costs time, and saves a tenth."""


@dataclass(frozen=True)
class StoredView:
    """A camera that was left out: what it should have seen, and what the others know."""

    name: str
    cameras: Cameras
    """The rig as it is known without this camera's image, this camera among it."""
    truth: UInt8[Tensor, "_byte"]
    """What it should have seen: RGB and mask, a PNG."""
    depth: UInt8[Tensor, "_byte"]
    """True z-depth in it, a PNG of 16 bit."""
    depth_step_m: float
    vertices: UInt8[Tensor, "_byte"]
    """The hull that the others carve, in steps of `bounds`."""
    faces: UInt8[Tensor, "_byte"]
    bounds: Bounds


@dataclass(frozen=True)
class StoredScene:
    """One moment of a rig, whose cameras were left out in turn."""

    images: tuple[UInt8[Tensor, "_byte"], ...]
    """RGB and mask of every camera, PNGs; black where the mask is."""
    depths: tuple[UInt8[Tensor, "_byte"], ...]
    """True z-depth of every second pixel, PNGs of 16 bit; () where nobody knows it."""
    depth_step_m: float
    held: tuple[StoredView, ...]

    def sample(self, number: int, render: RenderConfig, ray_views: int) -> Sample:
        """What `number` of the held views is, rendered; with the views of so many cameras near it.

        Raises:
            ValueError: what was stored is damaged.
        """
        if number >= len(self.held):
            raise ValueError(f"expected a scene of {number + 1} views or more, got {len(self.held)}; {AGAIN}")
        view = self.held[number]
        rig = view.cameras
        rgba = [_decoded(png) for png in self.images]
        frame = _frame(rgba, rig, [_depth(png, self.depth_step_m) for png in self.depths])
        stream = Stream(Unfilled(), StreamConfig(render=render, memory_mb=None))
        target = rig.select([view.name])
        observation = stream.push(frame.without([view.name]), _proxy(view))
        rendered = stream.render(target)
        names = rendered.closest_views(ray_views)
        context = observation.context(names)
        assert context is not None, "a rig has cameras beside the one that is left out"
        if frame.depth is not None:
            context = replace(context, frame=replace(context.frame, depth=frame.select(names).depth))
        truth = _frame([_decoded(view.truth)], target, [_depth(view.depth, view.depth_step_m)])
        assert truth.mask is not None and truth.depth is not None, "both were stored"
        alpha = truth.mask[0]
        black = (truth.rgb[0] * (alpha / 255)).round().to(torch.uint8)
        return Sample(rendered, (), context, black, alpha=alpha, depth=truth.depth[0])


def store(rig: LeaveOneOut, time: int, plan: DataPlan, random: Random) -> StoredScene:
    """One time of a rig without some of its cameras in turn.

    Args:
        rig: what it saw; the held views' truth has a depth.
        time: which of its times.
        plan: how many cameras are left out, and how the hull is carved.
        random: which.
    """
    frame = rig.frames[time]
    names, hull = frame.cameras.names, HullConfig(resolution=plan.hull_resolution)
    held = random.sample(names, min(plan.held_cameras, len(names)))
    step_m = 0.0 if frame.depth is None else float(frame.depth.amax().clamp_min(1e-3)) / STEPS
    depths = () if frame.depth is None else tuple(_coded_depth(d[::2, ::2], step_m) for d in frame.depth)
    images = tuple(_coded(*_own(frame, view)) for view in range(len(names)))
    return StoredScene(images, depths, step_m, tuple(_held_view(rig, name, time, hull) for name in held))


def _held_view(rig: LeaveOneOut, name: str, time: int, hull: HullConfig) -> StoredView:
    proxy, truth = HeldOutCamera(rig, name, hull).observation(time).proxy, rig.truth(name, time)
    assert isinstance(proxy, GeometryProxy) and truth.depth is not None, "hulls are carved, and true depth is known"
    step_m = float(truth.depth.amax().clamp_min(1e-3)) / STEPS
    low, size = proxy.bounds.low, proxy.bounds.size_m
    steps = (STEPS * (proxy.mesh.vertices - low) / size).round().clamp(0, STEPS).cpu().numpy().astype(np.uint16)
    faces = np.diff(proxy.mesh.faces.cpu().numpy().astype(np.int32).ravel(), prepend=0)
    return StoredView(
        name,
        rig.calibration(name, time),
        _coded(*_own(truth, 0)),
        _coded_depth(truth.depth[0], step_m),
        step_m,
        _bytes(zlib.compress(steps.tobytes(), FASTEST)),
        _bytes(zlib.compress(faces.astype(np.int32).tobytes(), FASTEST)),
        proxy.bounds,
    )


def _proxy(view: StoredView) -> GeometryProxy:
    steps = np.frombuffer(_inflated(view.vertices), np.uint16).reshape(-1, 3)
    faces = np.frombuffer(_inflated(view.faces), np.int32).cumsum(dtype=np.int32).reshape(-1, 3)
    if len(faces) and not 0 <= faces.min() <= faces.max() < len(steps):
        raise ValueError(f"expected faces of {len(steps)} stored vertices, got others; {AGAIN}")
    vertices = view.bounds.low + torch.from_numpy(steps.astype(np.float32)) / STEPS * view.bounds.size_m
    mesh = Mesh(vertices, torch.from_numpy(faces))
    return GeometryProxy(mesh, vertex_normals(mesh), view.bounds)


def _own(frame: MultiViewFrame, view: int) -> tuple[UInt8[Tensor, "3 height width"], UInt8[Tensor, "height width"]]:
    """A camera's image and mask, without the padding that others need."""
    width, height = (int(side) for side in frame.cameras.size_px[view])
    assert frame.mask is not None, "what trains has masks"
    return frame.rgb[view, :, :height, :width].cpu(), frame.mask[view, :height, :width].cpu()


def _frame(
    rgba: Sequence[UInt8[Tensor, "4 _h _w"]], cameras: Cameras, depths: Sequence[Float[Tensor, "_rows _columns"]]
) -> MultiViewFrame:
    """All images in one frame, padded; a depth of every second pixel is given to four."""
    width, height = cameras.max_size_px
    images = torch.zeros(len(rgba), 4, height, width, dtype=torch.uint8)
    depth = torch.zeros(len(rgba), height, width) if depths else None
    if len(rgba) != len(cameras) or len(depths) not in (0, len(cameras)):
        raise ValueError(f"expected an image and a depth of {len(cameras)} cameras, got {len(rgba)}; {AGAIN}")
    for view, image in enumerate(rgba):
        if [image.shape[2], image.shape[1]] != cameras.size_px[view].tolist():
            raise ValueError(f"expected a stored image of the camera's size, got {tuple(image.shape[1:])}; {AGAIN}")
        images[view, :, : image.shape[1], : image.shape[2]] = image
        if depth is not None:
            rows, columns = image.shape[1:]
            own = depths[view] if depths[view].shape == (rows, columns) else _twice(depths[view])[:rows, :columns]
            depth[view, :rows, :columns] = own
    return MultiViewFrame(cameras, images[:, :3], images[:, 3].contiguous(), 0, depth)


def _twice(image: Float[Tensor, "rows columns"]) -> Float[Tensor, "height width"]:
    return image.repeat_interleave(2, 0).repeat_interleave(2, 1)


def _coded(rgb: UInt8[Tensor, "3 height width"], mask: UInt8[Tensor, "height width"]) -> UInt8[Tensor, "_byte"]:
    return _png(torch.cat([rgb * (mask > 0), mask[None]]).movedim(0, -1).contiguous().numpy())


def _decoded(png: UInt8[Tensor, "_byte"]) -> UInt8[Tensor, "4 height width"]:
    return torch.from_numpy(_opened(png, np.uint8, 3)).movedim(-1, 0)


def _opened(png: UInt8[Tensor, "_byte"], kind: type, dimensions: int) -> np.ndarray:
    """A stored PNG of this kind; ValueError for anything else."""
    import cv2

    image = decoded(png.numpy().tobytes(), cv2.IMREAD_UNCHANGED, MAX_PIXELS)
    if image is None or image.dtype != kind or image.ndim != dimensions or image.shape[2:] not in ((), (4,)):
        raise ValueError(f"expected a stored PNG of {kind.__name__}, got {len(png)} bytes of something else; {AGAIN}")
    return image


def _inflated(data: UInt8[Tensor, "_byte"]) -> bytes:
    try:
        return zlib.decompressobj().decompress(data.numpy().tobytes(), MAX_BYTES)
    except zlib.error as error:
        raise ValueError(f"expected a stored mesh, got {error}; {AGAIN}") from None


def _coded_depth(depth: Float[Tensor, "height width"], step_m: float) -> UInt8[Tensor, "_byte"]:
    return _png((depth / step_m).round().clamp(0, STEPS).cpu().numpy().astype(np.uint16))


def _depth(png: UInt8[Tensor, "_byte"], step_m: float) -> Float[Tensor, "height width"]:
    return torch.from_numpy(_opened(png, np.uint16, 2).astype(np.float32)) * step_m


def _png(image: np.ndarray) -> UInt8[Tensor, "_byte"]:
    import cv2

    return _bytes(cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, FASTEST])[1].tobytes())


def _bytes(data: bytes) -> UInt8[Tensor, "_byte"]:
    return torch.frombuffer(bytearray(data), dtype=torch.uint8)


class StudioStore:
    """The studio's scenes, stored: one moment of each."""

    def __init__(self, scenes: StudioScenes) -> None:
        self.scenes = scenes

    def scene(self, number: int) -> list[StoredScene]:
        """Scene `number`."""
        rig, random = self.scenes.rig(number)
        return [store(rig, min(rig.frames), self.scenes.plan, random)]


class StoredSamples:
    """The samples of stored scenes: every held view, rendered from a number of cameras that the plan draws."""

    def __init__(self, scenes: SceneSource[StoredScene], plan: DataPlan, seed: str) -> None:
        self.scenes = scenes
        self.plan = plan
        self.seed = seed

    def scene(self, number: int) -> list[Sample]:
        """All views of scene, or shard, `number`."""
        random = Random(f"{self.seed}/views/{number}")
        plan, samples = self.plan, []
        for stored in self.scenes.scene(number):
            for view in range(len(stored.held)):
                cameras = random.choices(plan.context_cameras, weights=plan.context_weights)[0]
                render = RenderConfig(cameras=cameras, error_rule="all")
                samples.append(stored.sample(view, render, plan.ray_views))
        return samples
