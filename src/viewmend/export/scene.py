"""Exports a capture as a scene for 3D engines: hulls, points, images, depth and cameras, in a world with +y up."""

import json
import re
import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

from viewmend.data.images import write_image
from viewmend.frame_cache import CachedFrame
from viewmend.geometry.cameras import Cameras, pixel_centers, project, unproject
from viewmend.geometry.hull import FOREGROUND
from viewmend.geometry.orbit import horizontal_axes, upright
from viewmend.geometry.proxy import GeometryProxy
from viewmend.geometry.rim import RIM_PX
from viewmend.geometry.sampling import in_view
from viewmend.models.base import State
from viewmend.models.compositing import cutout
from viewmend.rendering.proxy_views import vertex_colours
from viewmend.stream import Stream
from viewmend.types import CompletedView, MultiViewFrame
from viewmend.utils.atomic_writes import write_atomically, write_text
from viewmend.utils.srgb import linear_from_srgb

SENSOR_MM = 36.0
"""Sensor width of every camera: engines need one, but only its ratio to the focal length matters."""


def engine_from_world(up: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """The rotation of the capture's `up` to +y, and of azimuth 0 to +z: right-handed and y up, as in glTF."""
    up = up / up.norm()
    front, side = horizontal_axes(up)
    return torch.stack([side, up, front])


def engine_from_cameras(cameras: Cameras, rotation: Float[Tensor, "3 3"]) -> Float[Tensor, "view 4 4"]:
    """The cameras' poses in the engine's world, with OpenGL axes: x right, y up, looking along -z."""
    poses = cameras.world_from_camera.clone()
    poses[:, :3] = rotation @ poses[:, :3]
    return poses * poses.new_tensor([1.0, -1.0, -1.0, 1.0])


def usd_scene(groups: Mapping[str, Cameras], rotation: Float[Tensor, "3 3"], fps: float, frames: int) -> str:
    """Cameras as ASCII USD (.usda), metres, y up; skew is left out."""
    lines = ["#usda 1.0", "(", '    defaultPrim = "scene"', "    metersPerUnit = 1", '    upAxis = "Y"']
    lines += [f"    timeCodesPerSecond = {fps:g}", "    startTimeCode = 0", f"    endTimeCode = {frames - 1}", ")", ""]
    lines += ['def Xform "scene"', "{"]
    for group, cameras in groups.items():
        lines += [f'    def Scope "{group}"', "    {"]
        names = _prim_names(cameras.names)
        for view, pose in enumerate(engine_from_cameras(cameras, rotation).double().mT.tolist()):
            lines += [f"        {line}" for line in _usd_camera(names[view], cameras[view], pose)]
        lines.append("    }")
    return "\n".join([*lines, "}", ""])


def _usd_camera(prim: str, camera: Cameras, pose: list[list[float]]) -> list[str]:
    """One camera; USD has lengths of its sensor in tenths of the scene's unit."""
    (width, height), K = camera.size_px[0].tolist(), camera.K[0].double()
    aperture = SENSOR_MM / 100
    per_x, per_y = aperture / width, aperture / width * float(K[0, 0] / K[1, 1])
    rows = ", ".join(f"({', '.join(f'{value:.9g}' for value in row)})" for row in pose)
    values = {
        "focalLength": float(K[0, 0]) * per_x,
        "horizontalAperture": aperture,
        "verticalAperture": height * per_y,
        "horizontalApertureOffset": (width / 2 - float(K[0, 2])) * per_x,
        "verticalApertureOffset": (float(K[1, 2]) - height / 2) * per_y,
    }
    return [
        f'def Camera "{prim}" (displayName = {json.dumps(camera.names[0])})',
        "{",
        *(f"    float {name} = {value:.9g}" for name, value in values.items()),
        "    float2 clippingRange = (0.01, 1000)",
        f"    matrix4d xformOp:transform = ({rows})",
        '    uniform token[] xformOpOrder = ["xformOp:transform"]',
        "}",
    ]


def _prim_names(names: tuple[str, ...]) -> list[str]:
    """Unique identifiers that USD allows."""
    found: list[str] = []
    for n, name in enumerate(names):
        plain = re.sub(r"\W", "_", name, flags=re.ASCII)
        plain = plain if plain and not plain[0].isdigit() else f"camera_{plain}"
        found.append(f"{plain}_{n}" if plain in found else plain)
    return found


def blender_script(
    groups: Mapping[str, Cameras], rotation: Float[Tensor, "3 3"], fps: float, frames: int, images: Mapping[str, str]
) -> str:
    """A script that opens the exported scene in Blender: cameras with background images, and the animated hull."""
    cameras = [
        _blender_camera(own[view]) | {"group": group, "image": images.get(own.names[view]), "engine_from_camera": pose}
        for group, own in groups.items()
        for view, pose in enumerate(engine_from_cameras(own, rotation).tolist())
    ]
    scene = {"fps": fps, "frames": frames, "sensor_mm": SENSOR_MM, "cameras": cameras}
    return BLENDER.replace("SCENE", json.dumps(json.dumps(scene)))


def _blender_camera(camera: Cameras) -> dict[str, object]:
    """Name, size and intrinsics; the sensor's shift is in image widths."""
    (width, height), K = camera.size_px[0].tolist(), camera.K[0]
    return {
        "name": camera.names[0],
        "size_px": [width, height],
        "lens": SENSOR_MM * float(K[0, 0]) / width,
        "shift_x": 0.5 - float(K[0, 2]) / width,
        "shift_y": (float(K[1, 2]) - height / 2) / width,
    }


BLENDER = '''"""Opens this folder in Blender: blender --python open_in_blender.py"""

import json
from pathlib import Path

import bpy
from mathutils import Matrix

HERE = Path(__file__).resolve().parent
scene = json.loads(SCENE)
z_up = Matrix(((1, 0, 0, 0), (0, 0, -1, 0), (0, 1, 0, 0), (0, 0, 0, 1)))  # from +y up

bpy.context.scene.render.fps = max(1, round(scene["fps"]))
bpy.context.scene.frame_start, bpy.context.scene.frame_end = 0, scene["frames"] - 1
collections = {}
for given in scene["cameras"]:
    if given["group"] not in collections:
        collections[given["group"]] = bpy.data.collections.new(given["group"])
        bpy.context.scene.collection.children.link(collections[given["group"]])
    data = bpy.data.cameras.new(given["name"])
    data.sensor_fit, data.sensor_width, data.lens = "HORIZONTAL", scene["sensor_mm"], given["lens"]
    data.shift_x, data.shift_y = given["shift_x"], given["shift_y"]
    camera = bpy.data.objects.new(given["name"], data)
    camera.matrix_world = z_up @ Matrix(given["engine_from_camera"])
    collections[given["group"]].objects.link(camera)
    if given["image"]:
        image = bpy.data.images.load(str(HERE / given["image"]))
        image.source = "SEQUENCE"
        background = data.background_images.new()
        background.image, data.show_background_images = image, True
        background.image_user.frame_start, background.image_user.frame_offset = 0, -1
        background.image_user.frame_duration = scene["frames"]
        bpy.context.scene.camera = camera
        bpy.context.scene.render.resolution_x, bpy.context.scene.render.resolution_y = given["size_px"]

for frame, file in enumerate(sorted((HERE / "hull").glob("*.glb"))):
    bpy.ops.import_scene.gltf(filepath=str(file))  # converts to +z up itself
    for hull in bpy.context.selected_objects:
        for hidden, at in ((True, frame - 1), (False, frame), (True, frame + 1)):
            hull.hide_viewport = hull.hide_render = hidden
            hull.keyframe_insert("hide_viewport", frame=at)
            hull.keyframe_insert("hide_render", frame=at)
'''


FLOAT, UINT16, UINT32 = 5126, 5123, 5125
ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963
"""Component types and buffer targets of glTF 2.0, section 3.6."""


def write_glb(
    path: Path,
    vertices: Float[Tensor, "vertex 3"],
    faces: Int[Tensor, "face 3"],
    colours: Float[Tensor, "vertex 3"],
    normals: Float[Tensor, "vertex 3"],
) -> None:
    """Writes a mesh as binary glTF 2.0; without vertices, a scene without a mesh.

    Args:
        path: the file.
        vertices: metres, y up.
        faces: counter-clockwise from outside.
        colours: sRGB in [0, 1]. They are written as linear 16-bit vertex colours, on an unlit material: they include
            the captured light.
        normals: unit, outward.

    Raises:
        OSError: the file cannot be written.
    """
    linear = np.rint(65535 * linear_from_srgb(colours.clamp(0, 1)).cpu().numpy()).astype("<u2")
    rgba = np.concatenate([linear, np.full((len(linear), 1), 65535, "<u2")], 1)
    position = vertices.cpu().numpy().astype("<f4")
    parts = {
        "POSITION": (position, "VEC3", FLOAT),
        "NORMAL": (normals.cpu().numpy().astype("<f4"), "VEC3", FLOAT),
        "COLOR_0": (rgba, "VEC4", UINT16),
        "indices": (faces.cpu().numpy().astype("<u4").reshape(-1), "SCALAR", UINT32),
    }
    data = b"".join(array.tobytes() for array, _, _ in parts.values()) if len(position) else b""
    _write_chunks(path, json.dumps(_gltf(parts), separators=(",", ":")).encode(), data)


def _gltf(parts: Mapping[str, tuple[np.ndarray, str, int]]) -> dict[str, object]:
    """The JSON of a mesh whose attributes and indices follow each other in the binary data, in the order of `parts`."""
    document: dict[str, object] = {"asset": {"version": "2.0", "generator": "viewmend"}, "scene": 0}
    document["scenes"] = [{"nodes": [0]}]
    position = parts["POSITION"][0]
    if not len(position):
        return document | {"nodes": [{"name": "hull"}]}
    views, accessors, offset = [], [], 0
    for name, (array, kind, component) in parts.items():
        target = ELEMENT_ARRAY_BUFFER if name == "indices" else ARRAY_BUFFER
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": array.nbytes, "target": target})
        accessors.append({"bufferView": len(views) - 1, "componentType": component, "count": len(array), "type": kind})
        accessors[-1] |= {"normalized": True} if name == "COLOR_0" else {}
        offset += array.nbytes
    accessors[0] |= {"min": position.min(0).tolist(), "max": position.max(0).tolist()}
    attributes = {name: n for n, name in enumerate(parts) if name != "indices"}
    return document | {
        "nodes": [{"name": "hull", "mesh": 0}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": len(attributes), "material": 0}]}],
        "materials": [{"name": "captured", "extensions": {"KHR_materials_unlit": {}}}],
        "extensionsUsed": ["KHR_materials_unlit"],
        "buffers": [{"byteLength": offset}],
        "bufferViews": views,
        "accessors": accessors,
    }


def _write_chunks(path: Path, text: bytes, data: bytes) -> None:
    """Writes header, JSON padded with blanks, and binary data, whose parts are multiples of 4 bytes."""
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(data), b"BIN\0") + data if data else b""
    whole = struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, lambda draft: draft.write_bytes(whole))


def write_ply(
    path: Path,
    vertices: Float[Tensor, "vertex 3"],
    colours: Float[Tensor, "vertex 3"],
    faces: Int[Tensor, "face 3"] | None = None,
) -> None:
    """Writes points, or a mesh of counter-clockwise faces, as binary PLY: metres, and sRGB in [0, 1] as 8 bit.

    Raises:
        OSError: the file cannot be written.
    """
    points = np.zeros(len(vertices), [("position", "<f4", 3), ("colour", "u1", 3)])
    points["position"] = vertices.cpu().numpy()
    points["colour"] = np.rint(255 * colours.clamp(0, 1).cpu().numpy())
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    lines += [f"property float {axis}" for axis in "xyz"] + [f"property uchar {c}" for c in ("red", "green", "blue")]
    triangles = np.zeros(0 if faces is None else len(faces), [("corners", "u1"), ("vertex", "<i4", 3)])
    if faces is not None:
        triangles["corners"], triangles["vertex"] = 3, faces.cpu().numpy()
        lines += [f"element face {len(triangles)}", "property list uchar int vertex_indices"]
    head = "\n".join([*lines, "end_header", ""]).encode()
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, lambda draft: draft.write_bytes(head + points.tobytes() + triangles.tobytes()))


RESULTS = ("hull", "points", "rgba", "depth", "cameras.usda", "open_in_blender.py")
"""Files and folders of an export."""


@dataclass(frozen=True)
class SceneCounts:
    """Numbers of what was written."""

    frames: int
    views: int
    vertices: int
    """Of the hulls of all frames."""
    points: int
    """Of the point clouds of all frames."""


def export_scene(
    frames: Iterable[MultiViewFrame],
    stream: Stream,
    views: Cameras,
    rig: Cameras,
    out: Path,
    *,
    up: Float[Tensor, "3"] | None = None,
    fps: float | None = None,
    min_confidence: float = 0.5,
) -> SceneCounts:
    """Writes each frame's hull, and novel views of it, into the folder `out`.

    Files are numbered by position in `frames`. The world is the capture's, rotated so that +y is up.

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
    count = vertices = points = 0
    for number, frame in enumerate(frames):
        vertices += _write_hull(stream.add_frame(frame), rotation, out / "hull" / f"{number:06d}")
        clouds = []
        for name, view in ((name, views[n]) for n, name in enumerate(views.names)):
            seen = stream.view(view.to(frame.rgb.device), states.get(name), frame.time)
            states[name] = seen.viewer
            write_image(out / "rgba" / name / f"{number:06d}.png", cutout(seen.completed))
            write_exr_depth(out / "depth" / name / f"{number:06d}.exr", seen.completed.surface_depth)
            clouds.append(extract_points(seen.completed, frame, min_confidence))
        cloud = torch.cat(clouds)
        write_ply(out / "points" / f"{number:06d}.ply", cloud[:, :3] @ rotation.mT, cloud[:, 3:])
        count, points = count + 1, points + len(cloud)
    groups = {"rig": rig.to("cpu"), "views": views.to("cpu")}
    images = {name: f"rgba/{name}/000000.png" for name in views.names}
    write_text(out / "cameras.usda", usd_scene(groups, rotation, fps or 1.0, count))
    write_text(out / "open_in_blender.py", blender_script(groups, rotation, fps or 1.0, count, images))
    return SceneCounts(count, len(views), vertices, points)


def extract_points(completed: CompletedView, frame: MultiViewFrame, min_confidence: float) -> Float[Tensor, "point 6"]:
    """World positions, metres, and RGB in [0, 1] of pixels that show the subject, on the CPU.

    Such a pixel has depth, an opacity above a half and at least this confidence; at least two cameras have its point in
    view, and in none of these it is outside the mask.
    """
    depth = completed.surface_depth
    kept = (depth > 0) & (completed.opacity > 0.5)
    if completed.confidence is not None:
        kept &= completed.confidence >= min_confidence
    height, width = depth.shape
    uv = pixel_centers(width, height, depth.device)[kept]
    world = unproject(uv[None], depth[kept][None], completed.view.camera)[0]
    return torch.cat([world, completed.straight_rgb[:, kept].mT], 1)[_within_masks(world, frame)].float().cpu()


def check_openexr() -> None:
    """ValueError without the package OpenEXR."""
    try:
        import OpenEXR  # noqa: F401
    except ImportError:
        raise ValueError(
            "expected the package OpenEXR, which writes float depth, got none; pip install 'viewmend[all]'"
        ) from None


def write_exr_depth(path: Path, depth_m: Float[Tensor, "height width"]) -> None:
    """Writes z-depth in metres as channel Z of an OpenEXR file: 32-bit float, lossless; 0 stays 0.

    Raises:
        OSError: the file cannot be written.
    """
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    channels = {"Z": depth_m.float().contiguous().cpu().numpy()}
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, lambda draft: OpenEXR.File(header, channels).write(str(draft)))


def _write_hull(cached: CachedFrame, rotation: Float[Tensor, "3 3"], path: Path) -> int:
    """Writes a frame's hull as .glb and .ply; returns its number of vertices."""
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
