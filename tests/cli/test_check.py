import json

import cv2
import pytest

from viewmend.cli import main


def described(capsys, *arguments):
    assert main(["check", *map(str, arguments), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_real_capture_in_figures_and_in_words(shared, capsys, tmp_path):
    folder = shared / "captures" / "utrecht"
    capture = described(capsys, folder, "--time", 3, "--out", tmp_path / "check.jpg")
    assert (capture["kind"], capture["name"], capture["frames"], capture["fps"]) == ("capture", "utrecht", 426, 50)
    assert [c["name"] for c in capture["cameras"]] == ["cam1", "cam2", "cam3", "cam4"]
    assert capture["checked_frame"] == "003" and capture["metres_per_unit"] == 0.001
    assert capture["hull_iou_min"] == min(c["hull_iou"] for c in capture["cameras"]) > 0.8
    assert capture["bounds_m"][1] == pytest.approx([4.5, 4.5, 2.5])
    assert 1 < max(capture["subject_extent_m"]) < 2.2
    assert cv2.imread(str(tmp_path / "check.jpg")).shape[1] > 3 * 400
    assert main(["check", str(folder)]) == 0
    words = capsys.readouterr().out
    for word in (
        "utrecht: a capture with 4 cameras",
        "644 x 486",
        "426, '000' to '425', 50 fps",
        "0.001 m",
        "hull IoU",
    ):
        assert word in words


@pytest.fixture
def model(tmp_path):
    from viewmend.models.checkpoint import build, save_inpainter
    from viewmend.models.paper.config import PaperConfig

    config = PaperConfig(widths=(8,) * 9, dim=32, heads=2, blocks=1)
    save_inpainter(build(config), tmp_path / "model", "# Tiny\nTrained on nothing.")
    return tmp_path / "model"


def test_a_model_is_described(model, capsys):
    description = described(capsys, model)
    assert description["kind"] == "model" and description["config"]["dim"] == 32
    assert description["parameters"] > 1000 and "Trained on nothing" in description["card"]
    assert main(["check", str(model)]) == 0
    words = capsys.readouterr().out
    assert "million parameters" in words and "Trained on nothing." in words


def test_a_damaged_model_is_one_line(model, capsys):
    weights = model / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:-100])
    assert main(["check", str(model)]) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1 and "model.safetensors" in message


def test_a_model_has_no_check_picture(model, capsys, tmp_path):
    assert main(["check", str(model), "--out", str(tmp_path / "x.png")]) == 2
    assert "--out" in capsys.readouterr().err


def test_what_is_neither(capsys, tmp_path):
    assert main(["check", str(tmp_path / "nothing")]) == 2
    message = capsys.readouterr().err
    for word in ("nothing", "cameras.json", "model", "check the path"):
        assert word in message


def test_a_picture_needs_a_picture_s_name(shared, capsys, tmp_path):
    assert main(["check", str(shared / "captures" / "utrecht"), "--out", str(tmp_path / "check.txt")]) == 2
    assert "the file name of an image" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
