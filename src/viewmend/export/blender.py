"""A script that opens an exported scene in Blender."""

import json
from collections.abc import Mapping

from jaxtyping import Float
from torch import Tensor

from viewmend.export.engine_cameras import SENSOR_MM, engine_from_cameras
from viewmend.geometry.cameras import Cameras

SCRIPT = '''"""Opens this folder in Blender: blender --python open_in_blender.py"""

import json
from pathlib import Path

import bpy
from mathutils import Matrix

HERE = Path(__file__).resolve().parent
scene = json.loads(SCENE)
z_up = Matrix(((1, 0, 0, 0), (0, 0, -1, 0), (0, 1, 0, 0), (0, 0, 0, 1)))  # from +y up

render = bpy.context.scene.render
render.fps = max(1, round(scene["fps"]))
render.fps_base = render.fps / scene["fps"]
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
"""The script; `SCENE` stands for its data as JSON text."""


def blender_script(
    groups: Mapping[str, Cameras],
    rotation: Float[Tensor, "3 3"],
    fps: float,
    frames: int,
    images: Mapping[str, str],
) -> str:
    """A script that opens the exported scene in Blender: cameras with background images, and the animated hull."""
    cameras = [
        _blender_camera(own[view])
        | {"group": group, "image": images.get(own.names[view]), "engine_from_camera": pose}
        for group, own in groups.items()
        for view, pose in enumerate(engine_from_cameras(own, rotation).tolist())
    ]
    scene = {"fps": fps, "frames": frames, "sensor_mm": SENSOR_MM, "cameras": cameras}
    return SCRIPT.replace("SCENE", json.dumps(json.dumps(scene)))


def _blender_camera(camera: Cameras) -> dict[str, object]:
    """Name, size and intrinsics; the sensor's shift is in image widths."""
    width, height = camera.size_px[0].tolist()
    K = camera.K[0]
    return {
        "name": camera.names[0],
        "size_px": [width, height],
        "lens": SENSOR_MM * float(K[0, 0]) / width,
        "shift_x": 0.5 - float(K[0, 2]) / width,
        "shift_y": (float(K[1, 2]) - height / 2) / width,
    }
