"""The examples run as they are, on small scenes, and use public names only."""

import ast
import json
import runpy
import sys
import types
from dataclasses import replace
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import torch
from live.live_servers import running
from reference.ball import BallCapture, ring

import viewmend
from viewmend import cli
from viewmend.data import formats
from viewmend.data.capture_folder import open_capture
from viewmend.data.native_writer import write_capture
from viewmend.live.push import PushSource
from viewmend.models.base import Inpainter
from viewmend.models.checkpoint import save_inpainter
from viewmend.models.registry import make_method
from viewmend.models.views.config import ViewsConfig
from viewmend.models.views.model import ViewSynthNet
from viewmend.studio.stage import Studio, StudioConfig

ROOT = Path(__file__).parents[2]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
TINY = ViewsConfig(num_views=4, width=8, sample_channels=4, features=8, fine_features=8, coarse_fill="rays")


def example(number: int) -> dict:
    """The names that an example defines."""
    [file] = (ROOT / "examples").glob(f"{number:02}_*.py")
    return runpy.run_path(str(file))


@pytest.fixture
def tiny(tmp_path):
    torch.manual_seed(0)
    save_inpainter(ViewSynthNet(TINY), tmp_path / "tiny", "# tiny\n")
    return tmp_path / "tiny"


@pytest.mark.parametrize("file", EXAMPLES, ids=lambda file: file.stem)
def test_an_example_is_short_uses_public_names_and_has_a_page(file):
    text = file.read_text(encoding="utf-8")
    imports = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.ImportFrom)]
    ours = [node for node in imports if (node.module or "").split(".")[0] == "viewmend"]
    assert {node.module for node in ours} == {"viewmend"}
    assert {alias.name for node in ours for alias in node.names} <= set(viewmend.__all__)
    assert 20 < len(text.splitlines()) <= 85
    page = (ROOT / "docs/examples" / f"{file.stem}.md").read_text(encoding="utf-8")
    assert f'--8<-- "examples/{file.name}"' in page


def test_a_capture_becomes_a_picture(tmp_path, capsys):
    picture = example(1)["main"](tmp_path / "capture", frames=2, size_px=96)
    said = capsys.readouterr().out
    assert "pixels were missing" in said and "rendered, completed, truth" in said
    image = cv2.imread(str(picture))
    rendered, completed, truth = (image[:, i * 96 : (i + 1) * 96].astype(float) for i in range(3))
    assert image.shape == (96, 288, 3)
    assert ((completed - truth) ** 2).mean() < ((rendered - truth) ** 2).mean()


def test_a_capture_of_one_frame_becomes_a_picture(tmp_path):
    write_capture(Studio(StudioConfig(cameras=6, frames=1, size_px=96)), tmp_path / "take")
    assert example(1)["main"](tmp_path / "take").is_file()


def test_views_of_another_renderer_are_completed(tmp_path):
    rendered, completed, truth = example(2)["main"](tmp_path / "row.png", size_px=96)
    missing = (rendered == 0).all(0) & (truth > 0).any(0)
    assert 100 < int(missing.sum()) < 0.6 * int((truth > 0).any(0).sum())
    before, after = ((rgb - truth)[:, missing].square().mean() for rgb in (rendered, completed))
    assert after < 0.3 * before
    known = (rendered > 0).all(0)
    assert torch.equal(completed[:, known], rendered[:, known])
    row = cv2.imread(str(tmp_path / "row.png"))
    assert row.shape == (96, 192, 3)
    assert (row[0, -1] == 127).all(), "the completed view is on grey"


def test_a_method_in_one_short_file_is_evaluated(tmp_path):
    name = f"{ROOT / 'examples/03_own_method.py'}:Afterimage"
    assert isinstance(make_method(name), Inpainter)
    arguments = [
        "evaluate",
        "P",
        "--scenes",
        "1",
        "--frames",
        "2",
        "--size",
        "128",
        "--methods",
        f"unfilled,{name}",
    ]
    assert cli.main([*arguments, "--out", str(tmp_path)]) == 0
    unfilled, own = json.loads((tmp_path / "report.json").read_text())["cells"]
    assert own["method"] == name and own["error"] is None and own["frames"] == 2
    assert own["psnr_whole"] != unfilled["psnr_whole"]


def test_a_custom_rule_selects_more():
    selected = example(4)["selected"]
    own = f"{ROOT / 'examples/04_own_error_rule.py'}:disagreement"
    assert selected(own) > 1.5 * selected("holes") > 0


def test_a_rig_is_pushed(capsys):
    with running(PushSource(), ready=False) as server:
        assert example(5)["main"](server.ws, count=2, size_px=48) == 2


def test_a_path_becomes_a_film(tmp_path):
    example(6)["main"](tmp_path / "film.mp4", frames=3, size_px=64)
    with av.open(str(tmp_path / "film.mp4")) as film:
        images = [image.to_ndarray(format="rgb24") for image in film.decode(video=0)]
    assert len(images) == 3 and images[0].shape == (64, 64, 3)
    assert np.abs(images[0].astype(float) - images[2]).mean() > 1


def test_masks_are_nearly_the_true_ones(tmp_path):
    assert example(7)["main"](tmp_path / "masks", size_px=96, frames=2) > 0.7


@pytest.mark.slow
def test_a_fine_tuned_model_is_compared(takes, tmp_path):
    options = (
        "--steps",
        "1",
        "--batch",
        "1",
        "--workers",
        "0",
        "--sizes-px",
        "96",
        "--num-holdout-views",
        "1",
    )
    before, after = example(8)["main"](takes / "ada", tmp_path / "out", *options)
    assert before > 15
    assert after == pytest.approx(before, abs=1), "one step changes little"
    assert (tmp_path / "out/model.safetensors").is_file()


def test_methods_are_scored():
    scores = example(9)["main"](["unfilled", "views"], frames=1, size_px=96)
    assert scores["views"] > scores["unfilled"] + 0.5


@pytest.mark.slow
def test_onnx_runtime_computes_what_the_model_computes(tiny, tmp_path):
    assert example(10)["main"](tmp_path / "tiny.onnx", str(tiny), size_px=96) < 1e-4


def test_the_camera_of_viser_becomes_ours(monkeypatch):
    """Also without viser: the conversion needs only four attributes of its camera."""
    monkeypatch.setitem(sys.modules, "viser", types.ModuleType("viser"))
    for name in ("CameraHandle", "ClientHandle", "ViserServer"):
        setattr(sys.modules["viser"], name, object)
    camera = types.SimpleNamespace(wxyz=(0.5, 0.5, 0.5, 0.5), position=(1.0, 2.0, 3.0), fov=0.8, aspect=1.5)
    view = example(11)["view_camera"](camera, 100)
    assert view.max_size_px == (150, 100)
    assert torch.allclose(view.centers[0], torch.tensor([1.0, 2.0, 3.0]), atol=1e-6)
    forward = view.camera_from_world[0, 2, :3]
    assert torch.allclose(forward, torch.tensor([1.0, 0.0, 0.0]), atol=1e-6), "this rotation takes z to x"


def test_viser_starts():
    pytest.importorskip("viser", reason="needs the extra: pip install 'viewmend[examples]'")
    server = example(11)["main"](height=48, port=0)
    server.stop()


def write_own_format(folder: Path) -> BallCapture:
    """A ball in the format of the twelfth example."""
    source = BallCapture(ring(4), frames=2)
    (folder / "rig").mkdir(parents=True)
    for view, name in enumerate(source.cameras.names):
        world_from_camera = source.cameras.camera_from_world[view].inverse()[:3]
        world_from_camera[:, 3] *= 100  # centimetres
        numbers = world_from_camera.flatten().tolist()
        text = f"48 48 {float(source.cameras.K[view, 0, 0])}\n{' '.join(map(str, numbers))}\n"
        (folder / f"rig/{name}.txt").write_text(text)
        for time, frame_id in enumerate(source.frame_ids):
            frame = source.read(time)
            for kind, image in (("shots", frame.rgb[view].movedim(0, -1)), ("mattes", frame.mask[view])):
                viewmend.write_image(folder / kind / name / f"{frame_id}.png", image.contiguous().numpy())
    return source


@pytest.mark.parametrize("registered", [False, True], ids=["converted", "registered"])
def test_a_format_of_ones_own_is_read(registered, tmp_path, monkeypatch):
    source = write_own_format(tmp_path / "take")
    own = example(12)
    if registered:
        monkeypatch.setitem(formats.FORMATS, "own", formats.Format(own["find"], own["content"]))
    else:
        own["main"](tmp_path / "take")
    capture = open_capture(tmp_path / "take")
    assert capture.cameras.names == source.cameras.names and capture.frame_ids == source.frame_ids
    assert torch.allclose(capture.cameras.K, source.cameras.K, atol=1e-3)
    assert torch.allclose(capture.cameras.camera_from_world, source.cameras.camera_from_world, atol=1e-5)
    found = capture.read(1)
    expected = replace(source.read(1), cameras=found.cameras)
    assert torch.equal(found.rgb, expected.rgb) and torch.equal(found.mask, expected.mask)


def test_a_file_of_the_wrong_length_is_refused(tmp_path):
    write_own_format(tmp_path / "take")
    (tmp_path / "take/rig/c0.txt").write_text("48 48 50 1 0 0")
    with pytest.raises(ValueError, match=r"expected 15 numbers in c0.txt, got 6"):
        example(12)["content"](tmp_path / "take", tmp_path / "take/rig/c0.txt")
