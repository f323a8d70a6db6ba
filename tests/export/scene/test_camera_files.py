"""Engines' cameras see each point where ours do."""

import json
import sys
from dataclasses import replace
from types import ModuleType, SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch
from pxr import Gf, Usd, UsdGeom
from reference.ball import ring

from viewmend.export.blender import blender_script
from viewmend.export.engine_cameras import engine_from_world
from viewmend.export.usd import usd_scene
from viewmend.geometry.cameras import Cameras, project

POINTS = torch.tensor([[0.1, 0.2, 0.3], [-0.3, 0.1, 0.0], [0.0, -0.2, 0.1]])


def odd_rig() -> Cameras:
    """Names that are no identifiers, pixels that are not square, a principal point off the middle."""
    rig = ring(3, 64)
    K = rig.K.clone()
    K[:, 0, 0] *= 1.2
    K[:, :2, 2] += torch.tensor([5.0, -3.0])
    return Cameras(("1 a", "1-a", "bühne"), K, rig.camera_from_world, torch.tensor([[64, 48]] * 3))


RIG, ROTATION = odd_rig(), engine_from_world(torch.tensor([0.0, 0.3, 1.0]))


def test_up_becomes_y():
    up = torch.tensor([0.0, 0.3, 1.0])
    assert torch.allclose(ROTATION @ (up / up.norm()), torch.tensor([0.0, 1.0, 0.0]), atol=1e-6)
    assert float(torch.linalg.det(ROTATION)) == pytest.approx(1)
    assert torch.equal(engine_from_world(torch.tensor([0.0, 2.0, 0.0])), torch.eye(3))


def test_usd_cameras_project_as_ours():
    layer = usd_scene({"rig": RIG, "views": ring(1)}, ROTATION, 25.0, 7)
    stage = Usd.Stage.CreateInMemory()
    assert stage.GetRootLayer().ImportFromString(layer)
    assert UsdGeom.GetStageUpAxis(stage) == "Y" and UsdGeom.GetStageMetersPerUnit(stage) == 1
    assert (stage.GetTimeCodesPerSecond(), stage.GetEndTimeCode()) == (25, 6)
    scope = stage.GetPrimAtPath("/scene/rig")
    assert [p.GetName() for p in scope.GetChildren()] == ["camera_1_a", "camera_1_a_2", "b_hne"]
    assert [p.GetDisplayName() for p in scope.GetChildren()] == list(RIG.names)
    uv, _ = project(POINTS, RIG)
    for view, prim in enumerate(scope.GetChildren()):
        frustum = UsdGeom.Camera(prim).GetCamera(0).frustum
        matrix = frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()
        for point, own in zip(POINTS @ ROTATION.mT, uv[view], strict=True):
            x, y, _ = matrix.Transform(Gf.Vec3d(*point.tolist()))
            assert [32 * (1 + x), 24 * (1 - y)] == pytest.approx(own.tolist(), abs=1e-2)


def test_usd_names_are_unique_whatever_the_cameras_are_called():
    rig = replace(RIG, names=("a b", "a_b_2", "a-b"))
    stage = Usd.Stage.CreateInMemory()
    assert stage.GetRootLayer().ImportFromString(usd_scene({"rig": rig}, ROTATION, 25.0, 1))
    names = [prim.GetDisplayName() for prim in stage.GetPrimAtPath("/scene/rig").GetChildren()]
    assert names == list(rig.names)


class Matrix(np.ndarray):
    """What the script uses of mathutils.Matrix."""

    def __new__(cls, rows):
        return np.asarray(rows, float).view(cls)


def opened(script, folder, monkeypatch):
    """The cameras and the hull's keyframes that Blender would be told."""
    bpy, mathutils = MagicMock(), ModuleType("mathutils")
    mathutils.Matrix = Matrix
    made, shown = {}, []

    def named(name, data=None):
        made[name] = SimpleNamespace(data=data, background_images=MagicMock())
        return made[name]

    bpy.data.cameras.new.side_effect = lambda name: SimpleNamespace(background_images=MagicMock())
    bpy.data.objects.new.side_effect = named
    hull = MagicMock()
    hull.keyframe_insert.side_effect = lambda what, frame: shown.append((what, frame, getattr(hull, what)))
    bpy.context.selected_objects = [hull]
    monkeypatch.setitem(sys.modules, "bpy", bpy)
    monkeypatch.setitem(sys.modules, "mathutils", mathutils)
    exec(compile(script, "open_in_blender.py", "exec"), {"__file__": str(folder / "open_in_blender.py")})
    return made, shown, bpy


def test_blender_cameras_project_as_ours(tmp_path, monkeypatch):
    (tmp_path / "hull").mkdir()
    for n in range(2):
        (tmp_path / "hull" / f"{n:06d}.glb").touch()
    square = replace(RIG, K=RIG.K.clone())
    square.K[:, 1, 1] = square.K[:, 0, 0]
    script = blender_script({"rig": square}, ROTATION, 29.97, 2, {"bühne": "rgba/bühne/000000.png"})
    made, shown, bpy = opened(script, tmp_path, monkeypatch)
    render = bpy.context.scene.render
    assert render.fps == 30 and render.fps / render.fps_base == pytest.approx(29.97)
    uv, _ = project(POINTS, square)
    for view, name in enumerate(square.names):
        camera = made[name]
        to_z_up = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
        world = (POINTS @ ROTATION.mT).numpy() @ to_z_up.T
        own = np.linalg.inv(camera.matrix_world) @ np.concatenate([world, np.ones((3, 1))], 1).T
        lens = camera.data.lens / camera.data.sensor_width
        x = 64 * (0.5 - camera.data.shift_x + lens * own[0] / -own[2])
        y = 24 + 64 * (camera.data.shift_y - lens * own[1] / -own[2])
        assert np.stack([x, y], 1) == pytest.approx(uv[view].numpy(), abs=1e-2)
    files = [str(call.kwargs["filepath"])[-10:] for call in bpy.ops.import_scene.gltf.call_args_list]
    assert files == ["000000.glb", "000001.glb"]
    assert {("hide_render", 1, False), ("hide_render", 2, True), ("hide_viewport", 0, True)} <= set(shown)
    assert bpy.data.images.load.call_args.args == (str(tmp_path / "rgba/bühne/000000.png"),)


def test_the_script_is_data_and_code_apart(tmp_path):
    name = 'x"); import os; ("'
    script = blender_script({"rig": replace(RIG[0], names=(name,))}, ROTATION, 1.0, 1, {})
    line = next(line for line in script.splitlines() if line.startswith("scene = "))
    scene = json.loads(json.loads(line.removeprefix("scene = json.loads(").removesuffix(")")))
    assert scene["cameras"][0]["name"] == name
