import json

import cv2
import pytest
import torch
from models.plates import tiny
from reference.ball import BallCapture, ring
from safetensors.torch import load_file, save_file

from viewmend.cli import main
from viewmend.cli.check import _capture_as_text
from viewmend.data.native_writer import write_capture
from viewmend.models.checkpoint import save_inpainter


def described(capsys, *arguments):
    assert main(["check", *map(str, arguments), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


@pytest.mark.slow
def test_real_capture_in_figures_and_in_words(shared, capsys, tmp_path):
    folder = shared / "captures" / "utrecht"
    capture = described(capsys, folder, "--frame", 3, "--out", tmp_path / "check.jpg")
    assert (capture["name"], capture["frames"], capture["fps"]) == ("utrecht", 426, 50)
    assert [c["name"] for c in capture["cameras"]] == ["cam1", "cam2", "cam3", "cam4"]
    assert capture["checked_frame"] == "003" and capture["metres_per_unit"] == 0.001
    assert capture["hull_iou_min"] == min(c["hull_iou"] for c in capture["cameras"]) > 0.8
    assert capture["bounds_m"][1] == pytest.approx([4.5, 4.5, 2.5])
    assert 1 < max(capture["subject_extent_m"]) < 2.2
    assert cv2.imread(str(tmp_path / "check.jpg")).shape[1] > 3 * 400
    words = "\n".join(_capture_as_text(capture))
    for word in (
        "utrecht: a capture with 4 cameras",
        "644 x 486",
        "'000' to '425', 50 fps",
        "0.001 m",
        "hull IoU",
    ):
        assert word in words


# A model whose weights make no finite numbers is refused by every command that takes one, in one line.


SMALL = ("--frames", "1", "--size", "64")


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("capture") / "ball"
    write_capture(BallCapture(ring(4)), folder, images="png")
    return folder


def model_with(folder, spoilt):
    save_inpainter(tiny(), folder, "# A card")
    weights = load_file(folder / "model.safetensors")
    save_file({name: spoilt(value) for name, value in weights.items()}, folder / "model.safetensors")
    return str(folder)


COMMANDS = {
    "demo": lambda model, capture, out: ["demo", "--out", out, "--model", model, *SMALL],
    "mend": lambda model, capture, out: ["mend", capture, "--out", out, "--path", "orbit", "--model", model],
    "evaluate": lambda model, capture, out: [
        *("evaluate", "P", "--scenes", "1", "--out", out, "--methods", model, "--error-rule", "all", *SMALL)
    ],
    "export-scene": lambda model, capture, out: [
        "export-scene",
        capture,
        out,
        "--model",
        model,
        "--views",
        "8",
    ],
    "serve": lambda model, capture, out: ["serve", "--port", "0", "--model", model],
    "train": lambda model, capture, out: [
        "train",
        "finetune",
        "--captures",
        capture,
        "--from",
        model,
        "--out",
        out,
    ],
}


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_weights_that_are_not_finite_are_refused(command, value, capture, tmp_path, capsys):
    model = model_with(tmp_path / "model", lambda weights: torch.full_like(weights, value))
    assert main(COMMANDS[command](model, str(capture), str(tmp_path / "out"))) == 2
    *before, line = capsys.readouterr().err.splitlines()
    assert command == "train" or not before, (
        "only fine-tuning says first what it holds out and how long it takes"
    )
    assert "not finite" in line and not (tmp_path / "out").exists()


@pytest.mark.parametrize("command", ["demo", "mend", "evaluate", "export-scene"])
def test_weights_that_make_no_finite_colours_are_refused(command, capture, tmp_path, capsys):
    model = model_with(tmp_path / "model", lambda weights: weights * 1e30)
    code = main(COMMANDS[command](model, str(capture), str(tmp_path / "out")))
    said = capsys.readouterr()
    (line,) = [line for line in said.err.splitlines() if "not finite" in line]
    if command == "evaluate":
        assert code == 1 and "failed: ValueError" in line, "its row says so, the other rows stand"
    else:
        assert code == 2 and line.startswith("viewmend: error: ") and not (tmp_path / "out").exists()
