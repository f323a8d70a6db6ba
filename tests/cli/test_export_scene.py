"""`viewmend export-scene` from end to end on a small capture of a ball."""

import importlib.util
import json
import shutil
import sys
from dataclasses import replace

import cv2
import numpy as np
import OpenEXR
import pytest
import torch
import trimesh
from pxr import Usd
from reference import tells_all
from reference.ball import RADIUS_M, BallCapture, camera_at, photograph, ring

from viewmend.cli import main
from viewmend.data.native_writer import write_capture
from viewmend.export.scene import extract_points
from viewmend.geometry.cameras import concatenate_cameras, project
from viewmend.geometry.rim import RIM_PX
from viewmend.models.registry import make_method
from viewmend.stream import Stream


def rig():
    """Twelve cameras at many heights: their hull is nearly the ball."""
    heights = (0.0, 3.0, -1.5, 1.0, -4.0, 0.5, 2.0, -1.0, 4.0, -0.5, 1.5, -2.5)
    return concatenate_cameras([camera_at(30 * n, f"c{n}", 64, height) for n, height in enumerate(heights)])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("scene") / "ball"
    write_capture(BallCapture(rig()), path, images="png")
    return path


@pytest.fixture(scope="module")
def scene(folder, tmp_path_factory):
    out = tmp_path_factory.mktemp("scene") / "out"
    assert main(["export-scene", str(folder), str(out), "--views", "4", "--model", "telea"]) == 0
    return out


def load(path):
    return trimesh.load(path, process=False)


def test_all_files_are_there(scene):
    written = (path for path in scene.rglob("*") if path.is_file() and ".viewmend" not in path.parts)
    times = ("000000", "000001")
    assert {str(path.relative_to(scene)) for path in written} == {
        *("cameras.usda", "open_in_blender.py"),
        *(f"hull/{time}.{kind}" for time in times for kind in ("glb", "ply")),
        *(f"points/{time}.ply" for time in times),
        *(f"{kind}/orbit{view:03d}/{time}.{suffix}" for view in range(4) for time in times
          for kind, suffix in (("rgba", "png"), ("depth", "exr"))),
    }  # fmt: skip


def test_the_hull_is_the_ball(scene):
    hull = trimesh.load(scene / "hull/000000.glb", force="mesh")
    assert hull.is_watertight and hull.volume > 0
    assert np.abs(np.linalg.norm(hull.vertices, axis=1) - RADIUS_M).mean() < 0.04
    first, second = (load(scene / f"hull/00000{n}.ply") for n in range(2))
    side = np.abs(first.vertices[:, 1]) < 0.2
    colours = first.visual.vertex_colors[side, :3] / 255
    assert np.abs(colours - (0.5 + 0.4 * first.vertices[side] / RADIUS_M)).mean() < 0.03
    brightness, later = (hull.visual.vertex_colors[:, :3].mean() for hull in (first, second))
    assert later == pytest.approx(0.9 * brightness, rel=0.02)


def test_points_lie_on_the_ball_in_its_colours(scene):
    cloud = load(scene / "points/000000.ply")
    assert len(cloud.vertices) > 3000
    assert np.abs(np.linalg.norm(cloud.vertices, axis=1) - RADIUS_M).mean() < 0.04
    side = np.abs(cloud.vertices[:, 1]) < 0.2
    assert np.abs(cloud.colors[side, :3] / 255 - (0.5 + 0.4 * cloud.vertices[side] / RADIUS_M)).mean() < 0.04


def completed_view():
    """A view of the ball, and its frame."""
    frame, stream = photograph(rig()), Stream(make_method("telea"))
    stream.add_frame(frame)
    return stream.view(camera_at(15, "view", 64)).completed, frame


@pytest.mark.parametrize("depth_m", [2.7, 50.0])
def test_points_outside_a_mask_are_left_out(depth_m):
    """A model may take a pixel for far behind the subject."""
    completed, frame = completed_view()
    depth = completed.view.depth.clone()
    depth[32, 30:34] = depth_m
    spoilt = extract_points(replace(completed, depth=depth), frame, 0.5)
    assert len(extract_points(completed, frame, 0.5)) - len(spoilt) == 4
    assert float(spoilt[:, :3].norm(dim=-1).max()) < 0.6


@pytest.mark.parametrize("window", [(0, 18, 64, 28), (18, 0, 28, 64)])
def test_cameras_that_show_a_part_judge_that_part(window):
    """Images wider or higher than they are square; what lies beside them says nothing."""
    completed, whole = completed_view()
    part = photograph(rig().cropped(*window))
    everywhere, some = (extract_points(completed, frame, 0.5) for frame in (whole, part))
    assert 0.3 * len(everywhere) < len(some) <= len(everywhere)
    cameras, mask = part.cameras, part.mask > 127
    uv = torch.stack([project(everywhere[:, :3], cameras[n])[0][0] for n in range(len(cameras))])
    for point in range(0, len(everywhere), 7):
        seen, outside = 0, 0
        for n in range(len(cameras)):
            u, v = uv[n, point].tolist()
            if 0 <= u < window[2] and 0 <= v < window[3]:
                seen += 1
                near = mask[n, max(int(v) - RIM_PX, 0) : int(v) + RIM_PX + 1]
                outside += not near[:, max(int(u) - RIM_PX, 0) : int(u) + RIM_PX + 1].any()
        assert bool((some == everywhere[point]).all(1).any()) == (seen >= 2 and not outside)


def test_pictures_and_depth_fit_each_other(scene):
    rgba = cv2.imread(str(scene / "rgba/orbit001/000001.png"), cv2.IMREAD_UNCHANGED)
    with OpenEXR.File(str(scene / "depth/orbit001/000001.exr")) as file:
        depth = file.channels()["Z"].pixels
    assert rgba.shape == (64, 64, 4) and depth.dtype == np.float32
    assert ((rgba[..., 3] > 127) == (depth > 0)).all() and (depth > 0).mean() > 0.1
    assert depth[depth > 0].min() == pytest.approx(
        float(rig().centers.norm(dim=-1).mean()) - RADIUS_M, abs=0.05
    )
    assert len(np.unique(depth)) > 200  # not rounded


def test_usd_opens(scene):
    stage = Usd.Stage.Open(str(scene / "cameras.usda"))
    assert len(stage.GetPrimAtPath("/scene/rig").GetChildren()) == 12
    assert len(stage.GetPrimAtPath("/scene/views").GetChildren()) == 4
    assert stage.GetEndTimeCode() == 1


@pytest.mark.slow
def test_views_of_a_rig_on_one_side_swing_only_there(tmp_path):
    side, out = str(tmp_path / "side"), str(tmp_path / "out")
    write_capture(BallCapture(ring(8, 48)[:3], 1), tmp_path / "side", images="png")
    assert main(["export-scene", side, out, "--views", "4", "--model", "telea"]) == 0
    stage = Usd.Stage.Open(f"{out}/cameras.usda")
    views = stage.GetPrimAtPath("/scene/views").GetChildren()
    places = torch.tensor([list(view.GetAttribute("xformOp:transform").Get()[3]) for view in views])
    assert float(torch.pdist(places[:, :3]).min()) > 0.3


@pytest.mark.slow
def test_unsure_pixels_are_no_points(folder, tmp_path, capsys):
    model = f"{tells_all.__file__}:TellsAll"
    counts = []
    for least in ("0", "1"):
        given = ["--views", "1", "--frames", "0:1", "--model", model, "--min-confidence", least]
        assert main(["export-scene", str(folder), str(tmp_path / least), *given]) == 0
        counts.append((tmp_path / least / "points/000000.ply").stat().st_size)
    assert counts[0] > counts[1] + 1000


@pytest.mark.slow
def test_views_of_a_path_are_in_the_captures_world(folder, tmp_path, capsys):
    far = np.array([412345.6, 4512345.6, 210.0])
    moved = tmp_path / "far"
    shutil.copytree(folder, moved)
    content = json.loads((moved / "cameras.json").read_text())
    pose = np.eye(4)
    pose[:3, :3] = np.array(content["cameras"][0]["R"]).T
    pose[:3, 3] = -pose[:3, :3] @ content["cameras"][0]["t"] + far
    for camera in content["cameras"]:
        camera["t"] = (np.array(camera["t"]) - np.array(camera["R"]) @ far).tolist()
    content["bounds"] = content.get("bounds") and (np.array(content["bounds"]) + far).tolist()
    (moved / "cameras.json").write_text(json.dumps(content))
    (tmp_path / "path.json").write_text(json.dumps([pose.tolist()]))
    given = ["--path", str(tmp_path / "path.json"), "--frames", "0:1", "--model", "telea"]
    assert main(["export-scene", str(moved), str(tmp_path / "out"), *given]) == 0
    assert "the scene's origin is at (" in capsys.readouterr().err
    alpha = cv2.imread(str(tmp_path / "out/rgba/view000/000000.png"), cv2.IMREAD_UNCHANGED)[..., 3]
    assert (alpha > 127).mean() > 0.05


def test_without_openexr_it_says_what_to_install(folder, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    assert main(["export-scene", str(folder), str(tmp_path / "out")]) == 2
    assert "viewmend[all]" in capsys.readouterr().err


def test_a_missing_compiler_is_said(tmp_path, capsys):
    from torch._inductor import config

    # monkeypatch would leave the setting deleted
    with config.patch({"cpp.cxx": (None, "no-such-compiler")}):
        assert main(["export", "views", "--format", "pt2", "--out", str(tmp_path / "m.pt2")]) == 2
    assert "expected a C++ compiler for --format pt2, found none" in capsys.readouterr().err


def test_a_missing_extra_is_said(tmp_path, capsys, monkeypatch):
    there = importlib.util.find_spec
    monkeypatch.setattr(
        "viewmend.export.model.find_spec", lambda name: None if name == "onnxscript" else there(name)
    )
    assert main(["export", "views", "--format", "onnx", "--out", str(tmp_path / "m.onnx")]) == 2
    assert (
        "expected onnxscript for --format onnx, got none; pip install 'viewmend[all]'"
        in capsys.readouterr().err
    )
