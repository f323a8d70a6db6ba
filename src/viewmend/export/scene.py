"""A capture as a scene that engines take: hull, points, pictures, depth, cameras."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional as F

from viewmend.atomic_writes import write_text
from viewmend.capture.images import write_image
from viewmend.export.camera_files import blender_script, usd_scene
from viewmend.export.cutout import cutout
from viewmend.export.depth_files import write_exr_depth
from viewmend.export.engine_world import engine_from_world
from viewmend.export.mesh_files import write_glb, write_ply
from viewmend.geometry.cameras import Cameras, pixel_centers, project, unproject
from viewmend.geometry.hull import FOREGROUND
from viewmend.geometry.proxy import GeometryProxy
from viewmend.geometry.sampling import in_view
from viewmend.geometry.upright import upright
from viewmend.inpainting.protocol import State
from viewmend.observation import Observation
from viewmend.rendering.vertex_colours import vertex_colours
from viewmend.stream import Stream
from viewmend.views import RIM_PX, CompletedView, MultiViewFrame

RESULTS = ("hull", "points", "rgba", "depth", "cameras.usda", "open_in_blender.py")
"""What an export consists of."""


@dataclass(frozen=True)
class SceneCounts:
    """What was written."""

    times: int
    views: int
    vertices: int
    """All times' hulls have so many."""
    points: int
    """All times' clouds have so many."""


def export_scene(
    frames: Iterable[MultiViewFrame],
    stream: Stream,
    views: Cameras,
    rig: Cameras,
    out: Path,
    *,
    up: Float[Tensor, "3"] | None = None,
    fps: float | None = None,
    least_confidence: float = 0.5,
) -> SceneCounts:
    """Write every time's hull, and what the stream makes of these views of it, into the folder `out`.

    Files are numbered by their place in `frames`. The world is the capture's, turned so that +y is up.

    Args:
        frames: what the cameras saw, time by time.
        stream: carves, renders and mends.
        views: novel views, each mended at every time.
        rig: the capture's cameras, for the files of cameras alone.
        out: the folder.
        up: the capture's up; None for the rig's own idea of it.
        fps: frames a second.
        least_confidence: pixels less sure than this are no points, where the model tells.

    Raises:
        ValueError: a time has no masks, or no foreground.
        OSError: a file cannot be written.
    """
    rotation = engine_from_world(upright(rig).cpu() if up is None else up.cpu())
    viewers: dict[str, State] = {}
    times = vertices = points = 0
    for number, frame in enumerate(frames):
        vertices += _write_hull(stream.push(frame), rotation, out / "hull" / f"{number:06d}")
        clouds = []
        for name, view in ((name, views[n]) for n, name in enumerate(views.names)):
            seen = stream.view(view.to(frame.rgb.device), viewers.get(name), frame.time)
            viewers[name] = seen.viewer
            write_image(out / "rgba" / name / f"{number:06d}.png", cutout(seen.completed))
            write_exr_depth(out / "depth" / name / f"{number:06d}.exr", seen.completed.surface_depth)
            clouds.append(points_of(seen.completed, frame, least_confidence))
        cloud = torch.cat(clouds)
        write_ply(out / "points" / f"{number:06d}.ply", cloud[:, :3] @ rotation.mT, cloud[:, 3:])
        times, points = times + 1, points + len(cloud)
    _write_cameras({"rig": rig.to("cpu"), "views": views.to("cpu")}, rotation, fps or 1.0, times, out)
    return SceneCounts(times, len(views), vertices, points)


def _write_cameras(
    groups: dict[str, Cameras], rotation: Float[Tensor, "3 3"], fps: float, times: int, out: Path
) -> None:
    pictures = {name: f"rgba/{name}/000000.png" for name in groups["views"].names}
    texts = {
        "cameras.usda": usd_scene(groups, rotation, fps, times),
        "open_in_blender.py": blender_script(groups, rotation, fps, times, pictures),
    }
    for name, text in texts.items():
        write_text(out / name, text)


def _write_hull(observation: Observation, rotation: Float[Tensor, "3 3"], path: Path) -> int:
    """One time's hull as .glb and .ply; how many vertices it has."""
    proxy, names = observation.proxy, observation.frame.cameras.names
    assert isinstance(proxy, GeometryProxy), "no other geometry was pushed"
    seen = observation.context(names)
    assert seen is not None, "a frame without cameras has no hull"
    colours = vertex_colours(proxy, seen).cpu()
    vertices, normals = (part.cpu() @ rotation.mT for part in (proxy.mesh.vertices, proxy.normals))
    write_glb(path.with_suffix(".glb"), vertices, proxy.mesh.faces, colours, normals)
    write_ply(path.with_suffix(".ply"), vertices, colours, proxy.mesh.faces)
    return len(vertices)


def points_of(completed: CompletedView, frame: MultiViewFrame, least_confidence: float) -> Float[Tensor, "point 6"]:
    """World positions, metres, and RGB in [0, 1] of the pixels that show the subject, on the CPU.

    A pixel counts where it has depth, is more than half subject, is as sure as `least_confidence`, and where at
    least two cameras have it in view and none has it outside of its mask.
    """
    depth = completed.surface_depth
    kept = (depth > 0) & (completed.opacity > 0.5)
    if completed.confidence is not None:
        kept &= completed.confidence >= least_confidence
    height, width = depth.shape
    uv = pixel_centers(width, height, depth.device)[kept]
    world = unproject(uv[None], depth[kept][None], completed.view.camera)[0]
    points = torch.cat([world, completed.straight_rgb[:, kept].mT], 1)
    return points[_within_masks(world, frame)].float().cpu()


def _within_masks(points: Float[Tensor, "point 3"], frame: MultiViewFrame) -> Bool[Tensor, "point"]:
    """Points that two cameras or more have in view, none of them farther than `RIM_PX` from its mask."""
    seen = torch.zeros(len(points), dtype=torch.int, device=points.device)
    within = seen == 0
    assert frame.mask is not None, "a hull was carved"
    for view in range(len(frame.cameras)):
        camera = frame.cameras[view]
        uv, z = project(points, camera)
        near = F.max_pool2d((frame.mask[view] > FOREGROUND)[None].float(), 2 * RIM_PX + 1, 1, RIM_PX)
        column, row = uv[0].long().unbind(-1)
        hit = near[0, row.clamp(0, near.shape[1] - 1), column.clamp(0, near.shape[2] - 1)] > 0
        inside = in_view(uv, z, camera)[0]
        seen += inside
        within &= hit | ~inside
    return within & (seen >= 2)
