"""Exports a capture as a scene for 3D engines: hulls, points, images, depth and cameras, in a world with +y up."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional as F

from viewmend.data.camera_path import STATIC_FPS
from viewmend.data.images import write_image
from viewmend.export.blender import blender_script
from viewmend.export.engine_cameras import engine_from_world
from viewmend.export.mesh_files import write_glb, write_ply
from viewmend.export.usd import usd_scene
from viewmend.frame_cache import CachedFrame
from viewmend.geometry.cameras import Cameras, pixel_centers, project, unproject
from viewmend.geometry.hull import FOREGROUND
from viewmend.geometry.orbit import upright
from viewmend.geometry.proxy import GeometryProxy
from viewmend.geometry.rim import RIM_PX
from viewmend.geometry.sampling import in_view
from viewmend.models.base import State
from viewmend.models.compositing import cutout
from viewmend.rendering.proxy_views import vertex_colours
from viewmend.stream import Stream
from viewmend.types import CompletedView, MultiViewFrame
from viewmend.utils.atomic_writes import write_atomically, write_text

RESULTS = ("hull", "points", "rgba", "depth", "cameras.usda", "open_in_blender.py")
"""Files and folders of an export."""


@dataclass(frozen=True)
class SceneCounts:
    """Numbers of what was written."""

    frames: int
    views: int
    vertices: int
    """The vertices of all frames' hulls."""
    points: int
    """The points of all frames' clouds."""


def export_scene(
    frames: Iterable[MultiViewFrame],
    stream: Stream,
    views: Cameras,
    rig: Cameras,
    out: Path,
    *,
    up: Float[Tensor, "3"] | None = None,
    fps: float = STATIC_FPS,
    min_confidence: float = 0.5,
) -> SceneCounts:
    """Write each frame's hull, and novel views of it, into the folder `out`.

    Files are numbered by position in `frames`, without gaps. The world is the capture's, rotated so that +y is up.

    Args:
        frames: the capture, frame by frame.
        stream: computes hulls and completes views.
        views: novel views, each rendered for every frame.
        rig: the capture's cameras, for the camera files.
        out: the folder.
        up: the capture's up direction; None to estimate it from the rig.
        fps: frames per second.
        min_confidence: pixels below this confidence make no points, if the model predicts a confidence.

    Raises:
        ValueError: a frame has no masks.
        OSError: a file cannot be written.
    """
    rotation = engine_from_world(upright(rig).cpu() if up is None else up.cpu())
    states: dict[str, State] = {}
    count = 0
    vertices = 0
    points = 0
    for number, frame in enumerate(frames):
        vertices += _write_hull(stream.add_frame(frame), rotation, out / "hull" / f"{number:06d}")
        clouds = [
            _export_view(stream, frame, views[index], states, out, number, min_confidence)
            for index in range(len(views))
        ]
        cloud = torch.cat(clouds)
        write_ply(out / "points" / f"{number:06d}.ply", cloud[:, :3] @ rotation.mT, cloud[:, 3:])
        count += 1
        points += len(cloud)
    groups = {"rig": rig.to("cpu"), "views": views.to("cpu")}
    images = {name: f"rgba/{name}/000000.png" for name in views.names}
    write_text(out / "cameras.usda", usd_scene(groups, rotation, fps, count))
    write_text(out / "open_in_blender.py", blender_script(groups, rotation, fps, count, images))
    return SceneCounts(count, len(views), vertices, points)


def _export_view(
    stream: Stream,
    frame: MultiViewFrame,
    camera: Cameras,
    states: dict[str, State],
    out: Path,
    number: int,
    min_confidence: float,
) -> Float[Tensor, "point 6"]:
    """Complete one view, write its image and depth, update its state, and return its points."""
    name = camera.names[0]
    view = stream.view(camera.to(frame.rgb.device), states.get(name), frame.time)
    states[name] = view.viewer
    write_image(out / "rgba" / name / f"{number:06d}.png", cutout(view.completed))
    write_exr_depth(out / "depth" / name / f"{number:06d}.exr", view.completed.surface_depth)
    return extract_points(view.completed, frame, min_confidence)


def extract_points(
    completed: CompletedView, frame: MultiViewFrame, min_confidence: float
) -> Float[Tensor, "point 6"]:
    """World positions, metres, and RGB in [0, 1] of pixels that show the subject, on the CPU.

    Such a pixel has depth, an opacity above a half and at least this confidence; at least two
    cameras have its point in view, and in none of these it is outside the mask.
    """
    depth = completed.surface_depth
    kept = (depth > 0) & (completed.opacity > 0.5)
    if completed.confidence is not None:
        kept &= completed.confidence >= min_confidence
    height, width = depth.shape
    uv = pixel_centers(width, height, depth.device)[kept]
    world = unproject(uv[None], depth[kept][None], completed.view.camera)[0]
    return (
        torch.cat([world, completed.straight_rgb[:, kept].mT], 1)[_within_masks(world, frame)].float().cpu()
    )


def check_openexr() -> None:
    """ValueError without the package OpenEXR."""
    try:
        import OpenEXR  # noqa: F401
    except ImportError:
        raise ValueError(
            "expected the package OpenEXR, which writes float depth, got none; pip install 'viewmend[all]'"
        ) from None


def write_exr_depth(path: Path, depth_m: Float[Tensor, "height width"]) -> None:
    """Write z-depth in metres as channel Z of an OpenEXR file: 32-bit float, lossless; 0 stays 0.

    Raises:
        OSError: the file cannot be written.
    """
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    channels = {"Z": depth_m.float().contiguous().cpu().numpy()}
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, lambda draft: OpenEXR.File(header, channels).write(str(draft)))


def _write_hull(cached: CachedFrame, rotation: Float[Tensor, "3 3"], path: Path) -> int:
    """Write a frame's hull as .glb and .ply; returns its number of vertices."""
    proxy = cached.proxy
    assert isinstance(proxy, GeometryProxy), "no other geometry was given"
    seen = cached.context(cached.frame.cameras.names)
    assert seen is not None, "a frame without cameras has no hull"
    colours = vertex_colours(proxy, seen).cpu()
    vertices, normals = (part.cpu() @ rotation.mT for part in (proxy.mesh.vertices, proxy.normals))
    write_glb(path.with_suffix(".glb"), vertices, proxy.mesh.faces, colours, normals)
    write_ply(path.with_suffix(".ply"), vertices, colours, proxy.mesh.faces)
    return len(vertices)


def _within_masks(points: Float[Tensor, "point 3"], frame: MultiViewFrame) -> Bool[Tensor, "point"]:
    """Points that at least two cameras have in view, in all of these at most `RIM_PX` outside the mask."""
    count = torch.zeros(len(points), dtype=torch.int, device=points.device)
    within = count == 0
    assert frame.mask is not None, "a hull needs masks"
    for view in range(len(frame.cameras)):
        camera = frame.cameras[view]
        uv, z = project(points, camera)
        near = F.max_pool2d((frame.mask[view] > FOREGROUND)[None].float(), 2 * RIM_PX + 1, 1, RIM_PX)
        column, row = uv[0].long().unbind(-1)
        hit = near[0, row.clamp(0, near.shape[1] - 1), column.clamp(0, near.shape[2] - 1)] > 0
        inside = in_view(uv, z, camera)[0]
        count += inside
        within &= hit | ~inside
    return within & (count >= 2)
