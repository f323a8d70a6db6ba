"""`viewmend publish`: what the folder contains, its size limit, and the command."""

import json
import re

import pytest
import torch
from live.live_servers import CAMERAS
from live.test_assets import read_image, read_shape
from published_ball import FRAMES, publish_ball, published  # noqa: F401
from reference.ball import BallCapture, proxy

from viewmend.cli import main
from viewmend.completed_cameras import place_around, with_finer_images
from viewmend.data.native_writer import write_capture
from viewmend.geometry.mesh import simplify, vertex_normals
from viewmend.publishing import SCENE_BYTES

CENTER = torch.zeros(3)


def bytes_in(folder):
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def test_the_folder_has_the_page_and_every_frame(published):  # noqa: F811
    scene = json.loads((published / "scene.json").read_text())
    assert scene["frames"] == FRAMES and scene["rig"]["fps"] == 10 and scene["rig"]["name"] == "A <ball>"
    assert (published / "poster.jpg").read_bytes()[:2] == b"\xff\xd8"
    for number in range(FRAMES):
        folder = published / "frames" / str(number)
        header, _, arrays = read_shape((folder / "shape.bin").read_bytes())
        assert len(arrays["positions"]) > 100
        assert [camera.get("completed", False) for camera in header["cameras"]] == [False] * 6 + [True] * 4
        for n, camera in enumerate(header["cameras"]):
            rgb, mask = read_image((folder / f"{n}.bin").read_bytes(), camera)
            assert (
                rgb is not None
                and rgb.shape[:2] == mask.shape == (camera["height"], camera["width"])
                and mask.max() > 200
            )


def test_all_addresses_are_relative_and_lead_to_files(published):  # noqa: F811
    html = (published / "index.html").read_text()
    named = re.findall(r'(?:href|src|content)="([\w/.]+\.(?:js|css|svg|jpg))"', html)
    assert len(named) > 30 and all((published / name).is_file() for name in named)
    for path in [published / "index.html", *(published / "page").rglob("*.js")]:
        text = path.read_text()
        assert not re.search(r'(?:href|src)="/|https?://(?!localhost)', text), path.name
        for name in re.findall(r'(?:from|new URL\() ?"(\.{1,2}/[\w/.]+\.js)"', text):
            assert (path.parent / name).is_file(), f"{path.name} imports {name}"
    assert "A &lt;ball&gt;" in html and "<ball>" not in html


def test_a_smaller_limit_gives_coarser_files_that_fit(tmp_path):
    fine = publish_ball(tmp_path / "fine")
    assert fine.size_bytes == bytes_in(tmp_path / "fine") and fine.detail.image_scale == 1
    assert fine.first_bytes < fine.size_bytes
    frames = bytes_in(tmp_path / "fine/frames")
    limit_mb = (fine.size_bytes - 0.3 * frames + SCENE_BYTES) / 1e6
    coarse = publish_ball(tmp_path / "coarse", limit_mb)
    assert coarse.size_bytes == bytes_in(tmp_path / "coarse") <= 1e6 * limit_mb
    assert coarse.detail.image_scale < 1 and coarse.detail.jpeg_quality < fine.detail.jpeg_quality


def test_what_cannot_fit_is_an_error_that_says_what_to_change(tmp_path):
    with pytest.raises(ValueError, match=r"MB are left; raise --max-mb"):
        publish_ball(tmp_path / "out", max_mb=0.1)


def test_completed_cameras_stand_around_or_on_the_rigs_side():
    around = place_around(CAMERAS, CENTER, None, 8).centers
    assert float((around - CENTER).norm(dim=1).std()) < 1e-4
    assert float(around.mean(0).norm()) < 0.05, "a whole turn"
    side = place_around(CAMERAS[[0, 1, 2]], CENTER, None, 8).centers  # 60 degrees
    steps = (side[1:] - side[:-1]).norm(dim=1)
    assert float(steps.min()) > 1e-3 and float((side[-1] - side[0]).norm()) < 2.2, "there, but not back"


def test_completed_images_are_finer_up_to_a_limit():
    finer = with_finer_images(CAMERAS)
    assert finer.size_px.tolist() == [[67, 67]] * 6 and finer.names == CAMERAS.names
    large = with_finer_images(CAMERAS.resized(900, 600))
    assert large.size_px[0].tolist() == [1024, 683]
    assert with_finer_images(CAMERAS.resized(2000, 1000)).size_px[0].tolist() == [2000, 1000]


def test_simplified_meshes_keep_their_shape():
    mesh = proxy(24).mesh
    coarse = simplify(mesh, 0.15)
    assert len(coarse.vertices) < len(mesh.vertices) / 2
    assert float((coarse.vertices.norm(dim=1) - 0.5).abs().max()) < 0.08
    a, b, c = coarse.faces.unbind(1)
    assert not bool(((a == b) | (b == c) | (c == a)).any())
    outward = (vertex_normals(coarse) * coarse.vertices).sum(1)
    assert float((outward > 0).float().mean()) > 0.98
    assert len(simplify(mesh, 1e-6).vertices) > 1100, "only the poles, whose vertices coincide, are merged"


@pytest.mark.slow
def test_the_command_publishes_a_range_of_a_capture(tmp_path, capsys):
    write_capture(BallCapture(CAMERAS, 3), tmp_path / "ball", images="png")
    arguments = [
        str(tmp_path / "ball"),
        str(tmp_path / "out"),
        "--model",
        "telea",
        "--completed-cameras",
        "0",
    ]
    assert main(["publish", *arguments, "--frames", "1:3", "--title", "Two"]) == 0
    said = capsys.readouterr().err
    assert "2 frames" in said and "images at full size" in said and "python -m http.server" in said
    assert json.loads((tmp_path / "out/scene.json").read_text())["frames"] == 2
    assert main(["publish", *arguments, "--max-mb", "0.1"]) == 2
    assert "raise --max-mb" in capsys.readouterr().err
    assert json.loads((tmp_path / "out/scene.json").read_text())["rig"]["name"] == "Two", "nothing is lost"


@pytest.mark.parametrize(
    "option, text",
    [
        ("--max-mb=0", "--max-mb above 0"),
        ("--completed-cameras=25", "at most 24"),
        ("--fps=0", "--fps above 0"),
    ],
)
def test_options_out_of_range_are_refused(tmp_path, capsys, option, text):
    write_capture(BallCapture(CAMERAS, 1), tmp_path / "ball", images="png")
    assert main(["publish", str(tmp_path / "ball"), str(tmp_path / "out"), "--model", "telea", option]) == 2
    assert text in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_frames_of_one_camera_are_skipped(tmp_path, capsys):
    capture = tmp_path / "ball"
    write_capture(BallCapture(CAMERAS, 3), capture, images="png")
    for name in CAMERAS.names[1:]:
        sorted((capture / "image" / name).iterdir())[0].unlink()
    arguments = [str(capture), "--model", "telea", "--geometry", "hull"]
    assert main(["publish", *arguments, str(tmp_path / "page"), "--completed-cameras", "0"]) == 0
    said = (
        "1 of 3 frames have fewer than two usable cameras and were skipped, which shortens the result; "
        "the first is '000'"
    )
    assert said in capsys.readouterr().err
    assert json.loads((tmp_path / "page/scene.json").read_text())["frames"] == 2
    assert main(["export-scene", *arguments, str(tmp_path / "scene"), "--views", "1", "--fps", "29.97"]) == 0
    assert said in capsys.readouterr().err
    assert len(list((tmp_path / "scene/hull").glob("*.glb"))) == 2
    assert "timeCodesPerSecond = 29.97\n" in (tmp_path / "scene/cameras.usda").read_text()
    for command in ("publish", "export-scene"):
        assert main([command, *arguments, str(tmp_path / command), "--frames", "0:1"]) == 2
        assert "ball: expected a frame with two usable cameras, got none" in capsys.readouterr().err
        assert not (tmp_path / command).exists()


def test_a_camera_without_an_image_in_the_first_frame_belongs_to_the_rig(tmp_path):
    capture = tmp_path / "ball"
    write_capture(BallCapture(CAMERAS, 2), capture, images="png")
    sorted((capture / "image" / CAMERAS.names[-1]).iterdir())[0].unlink()
    arguments = [str(capture), str(tmp_path / "page"), "--model", "telea", "--geometry", "hull"]
    assert main(["publish", *arguments, "--completed-cameras", "0"]) == 0
    rig = json.loads((tmp_path / "page/scene.json").read_text())["rig"]
    assert [camera["name"] for camera in rig["cameras"]] == list(CAMERAS.names)


@pytest.mark.parametrize("command", ["publish", "export-scene"])
def test_the_model_that_predicts_depth_has_the_precision_that_was_asked_for(tmp_path, command, monkeypatch):
    write_capture(BallCapture(CAMERAS, 1), tmp_path / "ball", images="png")
    asked = []
    monkeypatch.setattr("viewmend.models.registry.error_model_for", lambda *given: asked.append(given[1:]))
    given = ["--model", "telea", "--geometry", "fused", "--precision", "float32"]
    assert main([command, str(tmp_path / "ball"), str(tmp_path / "out"), *given]) == 2
    assert asked == [("cpu", "float32")]
