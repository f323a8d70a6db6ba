"""Compact scenes on disk: one frame of a rig, and for each held-out camera the hull of the others and its ground truth.

A training view takes some ten megabytes, most of which follows from the images and a hull. Only
these are stored, and views are rendered when the scene is read: all views share the images, and
each reading may render differently.
"""

from dataclasses import dataclass, replace
from random import Random

import torch
from jaxtyping import Float, Int32, UInt16
from torch import Tensor

from viewmend.frame_cache import CachedFrame
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras
from viewmend.geometry.hull import HullConfig
from viewmend.geometry.mesh import Mesh, vertex_normals
from viewmend.geometry.proxy import GeometryProxy
from viewmend.models.base import Inpainter
from viewmend.models.classical import Unfilled
from viewmend.rendering.view import RenderConfig, render_depth
from viewmend.stream import Stream, StreamConfig
from viewmend.training.config import SamplingConfig, SceneConfig, SceneSource
from viewmend.training.depth_geometry import DepthErrors, DepthMaps
from viewmend.training.samples import HeldOutCamera, Sample, black_image, draw_source_views
from viewmend.training.scenes import RigSource, Scene
from viewmend.training.shards import storable
from viewmend.types import MultiViewFrame

HELD_FRACTION = 1 / 4
"""This fraction of a rig's cameras, at most, is held out together and shares its fused geometry."""
STEPS = 65535
"""Vertices and depths are quantised to this number of steps over their range."""
ADVICE = "write the shard again"


@storable
@dataclass(frozen=True)
class StoredDepth:
    """Quantised z-depth of some views; 0 where there is no surface."""

    steps: UInt16[Tensor, "view rows columns"]
    step_m: float

    @classmethod
    def of(cls, depth: Float[Tensor, "view rows columns"] | None) -> "StoredDepth | None":
        """Quantise a depth in metres, if there is one."""
        if depth is None:
            return None
        step_m = float(depth.amax().clamp_min(1e-3)) / STEPS
        return cls((depth / step_m).round().clamp(0, STEPS).to(torch.uint16), step_m)

    def metres(self) -> Float[Tensor, "view rows columns"]:
        """The depth."""
        return self.steps.float() * self.step_m


@storable
@dataclass(frozen=True)
class StoredView:
    """A held-out camera: its ground truth, and the hull of the others."""

    name: str
    cameras: Cameras
    """All cameras of the rig, this one included, as calibrated without its image."""
    truth: MultiViewFrame
    """RGB and mask that the camera should see; black outside the mask."""
    depth: StoredDepth | None
    """True depth of its view; None if unavailable."""
    vertices: UInt16[Tensor, "vertex 3"]
    """Vertices of the other cameras' hull or fused geometry, in steps of `bounds`."""
    faces: Int32[Tensor, "index"]
    """Differences of consecutive vertex indices of the faces, which compress better than the indices."""
    bounds: Bounds
    left_out: tuple[str, ...] = ()
    """All cameras that were held out together, this one included; () if it was held out alone."""


@storable
@dataclass(frozen=True)
class StoredScene:
    """One frame of a rig, with some of its cameras held out in turn."""

    frame: MultiViewFrame
    """RGB and mask of all cameras; black outside the masks."""
    depth: StoredDepth | None
    """True depth of every second pixel of all cameras; None if unavailable."""
    held: tuple[StoredView, ...]

    def sample(
        self, number: int, render: RenderConfig, num_ray_views: int, errors: DepthErrors | None = None
    ) -> Sample:
        """The sample of held-out view `number`, with this number of cameras near it.

        With `errors`, and true depth, it is rendered from depth maps with such errors instead of
        the hull. Raises ValueError if the stored scene is damaged.
        """
        if number >= len(self.held):
            raise ValueError(
                f"expected a scene of {number + 1} views or more, got {len(self.held)}; {ADVICE}"
            )
        view = self.held[number]
        _check(self.frame, view.cameras)
        _check(view.truth, view.truth.cameras)
        depth = None if self.depth is None else _upsampled(self.depth.metres(), self.frame)
        frame = replace(self.frame, cameras=view.cameras, depth=depth)
        others = replace(frame, depth=None).without(view.left_out or (view.name,))
        target = view.cameras.select([view.name])
        true_depth = None if view.depth is None else view.depth.metres()[0]
        if errors is None or depth is None or true_depth is None:
            stream = Stream(Unfilled(), StreamConfig(render=render, memory_mb=None))
            cached = stream.add_frame(others, _proxy(view))
            rendered = stream.render(target)
        else:
            generator = errors.generator()
            with_errors = torch.stack([errors.apply(own, generator) for own in depth])
            cached = CachedFrame(others, DepthMaps(frame.cameras.names, with_errors))
            own_depth = errors.apply(true_depth, generator)
            rendered, _ = render_depth(others, target, own_depth, cached.depth, render)
        names = rendered.closest_views(num_ray_views)
        context = cached.context(names)
        assert context is not None, "a rig has cameras besides the held-out one"
        if depth is not None:
            context = replace(context, frame=replace(context.frame, depth=frame.select(names).depth))
        assert view.truth.mask is not None, "it was checked"
        truth = black_image(view.truth)
        return Sample(rendered, (), context, truth, alpha=view.truth.mask[0], depth=true_depth)


def _check(frame: MultiViewFrame, cameras: Cameras) -> None:
    """Raise ValueError unless a stored frame has an image and a mask of the size of each camera."""
    size = (len(cameras), *reversed(cameras.max_size_px)) if len(cameras) else ()
    shapes = {(len(frame.rgb), *frame.rgb.shape[2:]), () if frame.mask is None else tuple(frame.mask.shape)}
    if shapes != {size}:
        raise ValueError(
            f"expected stored images and masks of the cameras' sizes {size}, got {shapes}; {ADVICE}"
        )


def store_scene(scene: Scene, config: SceneConfig, depth_model: Inpainter | None = None) -> StoredScene:
    """The first frame of a rig, with some of its cameras held out.

    With a model that predicts depth, the geometry of `fused_fraction` of the scenes is fused, which
    takes seconds: their cameras are held out together, `HELD_FRACTION` of the rig, and share it. In
    other scenes they are held out in turn, each behind the hull of all the others.
    """
    rig = scene.rig
    time = min(scene.rig.frames)
    frame = rig.frames[time]
    names = [name for name in frame.cameras.names if scene.held_out in (None, name)]
    held = scene.random.sample(names, min(config.num_holdout_views, len(names)))
    depth = StoredDepth.of(None if frame.depth is None else frame.depth[:, ::2, ::2])
    hull = HullConfig(resolution=config.hull_resolution)
    if depth_model is not None and scene.random.random() < config.fused_fraction:
        together = tuple(held[: max(1, int(HELD_FRACTION * len(names)))])
        proxy = _fused_geometry(scene, together, time, hull, depth_model)
        views = tuple(_store_view(scene, name, time, proxy, together) for name in together)
    else:
        views = tuple(_store_view(scene, name, time, _hull(scene, name, time, hull)) for name in held)
    return StoredScene(_on_black(frame), depth, views)


def _hull(scene: Scene, name: str, time: int, hull: HullConfig) -> GeometryProxy:
    """The hull of all cameras but one."""
    proxy = HeldOutCamera(scene.rig, name, hull).frame(time).proxy
    assert isinstance(proxy, GeometryProxy), "the proxy of a held-out camera is a hull"
    return proxy


def _fused_geometry(
    scene: Scene, held: tuple[str, ...], time: int, hull: HullConfig, depth_model: Inpainter
) -> GeometryProxy:
    """The hull of all cameras but some, tightened by the depth that the model predicts."""
    config = StreamConfig(geometry="fused", hull=hull, memory_mb=None)
    stream = Stream(Unfilled(), config, scene.rig.bounds, error_model=depth_model)
    others = scene.rig.inputs(held[0], time).without(held[1:])
    proxy = stream.add_frame(others).proxy
    assert isinstance(proxy, GeometryProxy), "the stream computes it"
    return proxy


def _store_view(
    scene: Scene, name: str, time: int, proxy: GeometryProxy, left_out: tuple[str, ...] = ()
) -> StoredView:
    mesh = proxy.mesh
    truth = scene.rig.truth(name, time)
    bounds = proxy.bounds
    vertices = (STEPS * (mesh.vertices - bounds.low) / bounds.size_m).round().clamp(0, STEPS).to(torch.uint16)
    indices = mesh.faces.flatten().int()
    return StoredView(
        name,
        scene.rig.calibration(name, time),
        _on_black(truth),
        StoredDepth.of(truth.depth),
        vertices,
        torch.diff(indices, prepend=indices.new_zeros(1)),
        bounds,
        left_out,
    )


def _on_black(frame: MultiViewFrame) -> MultiViewFrame:
    """The frame without depth, black outside its masks."""
    assert frame.mask is not None, "scenes for training have masks"
    return replace(frame, rgb=frame.rgb * (frame.mask > 0)[:, None], depth=None, time=0)


def _upsampled(
    depth: Float[Tensor, "view rows columns"], frame: MultiViewFrame
) -> Float[Tensor, "view height width"]:
    """A depth of every second pixel, repeated for the others."""
    height, width = frame.rgb.shape[2:]
    if depth.shape != (len(frame.rgb), -(-height // 2), -(-width // 2)):
        raise ValueError(
            f"expected the depth of every second pixel, got the shape {tuple(depth.shape)}; {ADVICE}"
        )
    return depth.repeat_interleave(2, 1).repeat_interleave(2, 2)[:, :height, :width]


def _proxy(view: StoredView) -> GeometryProxy:
    faces = view.faces.cumsum(0, dtype=torch.int32).reshape(-1, 3)
    if len(faces) and not 0 <= int(faces.min()) <= int(faces.max()) < len(view.vertices):
        raise ValueError(
            f"expected faces of {len(view.vertices)} stored vertices, got other indices; {ADVICE}"
        )
    mesh = Mesh(view.bounds.low + view.vertices.float() / STEPS * view.bounds.size_m, faces)
    return GeometryProxy(mesh, vertex_normals(mesh), view.bounds)


@dataclass(frozen=True)
class StoredSceneMaker:
    """The rigs of a source as stored scenes."""

    rigs: RigSource
    config: SceneConfig
    depth_model: Inpainter | None = None
    """Predicts the depth from which geometry is fused; without it, all views are behind hulls."""

    def scene(self, number: int) -> list[StoredScene]:
        """Scene `number`."""
        return [store_scene(self.rigs.rig(number), self.config, self.depth_model)]


@dataclass(frozen=True)
class StoredSamples:
    """The samples of stored scenes: every held-out view, rendered from a random number of source views."""

    scenes: SceneSource[StoredScene]
    sampling: SamplingConfig
    seed: str

    def scene(self, number: int) -> list[Sample]:
        """All views of scene `number`."""
        random = Random(f"{self.seed}/views/{number}")
        samples = []
        for stored in self.scenes.scene(number):
            for view in range(len(stored.held)):
                render = RenderConfig(cameras=draw_source_views(self.sampling, random), error_rule="all")
                errors = DepthErrors.draw(random) if random.random() < self.sampling.depth_fraction else None
                samples.append(stored.sample(view, render, self.sampling.num_ray_views, errors))
        return samples
