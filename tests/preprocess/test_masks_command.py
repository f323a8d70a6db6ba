"""`viewmend masks` upon a capture folder without masks."""

import shutil

import cv2
import numpy as np
import pytest
import torch
from jaxtyping import UInt8
from torch import Tensor

from viewmend.cli import main
from viewmend.data.capture_folder import open_capture

SIZE = (160, 128)
"""Four times that of the folder `plain`."""


@pytest.fixture
def unmasked(plain):
    """The ball, red, before a stage of soft blotches; its masks lie in `truth`, and stages without it in `plates`."""
    rng = np.random.default_rng(3)
    shutil.move(plain.path / "masks", plain.path / "truth")
    for camera in plain.description["cameras"]:
        del camera["mask"]
        camera |= {"width": SIZE[0], "height": SIZE[1]}
        camera["K"] = (np.diag([4, 4, 1]) @ np.array(camera["K"])).tolist()
        stage = cv2.resize(rng.integers(60, 200, (4, 5, 3), np.uint8), SIZE, interpolation=cv2.INTER_CUBIC)
        plain.put(f"plates/{camera['name']}.png", stage)
        for frame in plain.description["frames"]:
            mask = cv2.resize(plain.get(f"truth/{camera['name']}_{frame}.png"), SIZE) > 127
            plain.put(f"truth/{camera['name']}_{frame}.png", mask.astype(np.uint8) * 255)
            image = np.where(mask[..., None], np.uint8([30, 30, 190]), stage) + rng.normal(
                0, 2, (*SIZE[::-1], 3)
            )
            plain.put(camera["image"].format(frame=frame), image.clip(0, 255).astype(np.uint8))
    plain.save()
    return plain


def agreement(unmasked, mask: UInt8[Tensor, "view height width"], frame: str) -> float:
    """The lowest IoU of masks and truth."""
    truth = np.stack([unmasked.get(f"truth/{name}_{frame}.png") for name in "abcd"]) > 127
    made = mask.numpy() > 127
    return float(((made & truth).sum((1, 2)) / (made | truth).sum((1, 2))).min())


@pytest.mark.parametrize("place", ["plates", "plates/{camera}.png"])
def test_plates_make_masks_that_commands_use(unmasked, tmp_path, capsys, place):
    before = {path: path.read_bytes() for path in unmasked.path.rglob("*") if path.is_file()}
    out = tmp_path / "masked"
    plates = str(unmasked.path / place)
    assert main(["masks", str(unmasked.path), str(out), "--method", "plate", "--plate", plates]) == 0
    assert {path: path.read_bytes() for path in unmasked.path.rglob("*") if path.is_file()} == before
    masked = open_capture(out)
    assert masked.has_masks and masked.frame_ids == ("000", "001")
    assert agreement(unmasked, masked.read(1).mask, "001") > 0.95
    assert main(["info", str(out)]) == 0
    assert "hull IoU  mean 0.9" in capsys.readouterr().out


def test_what_is_missing_is_said(unmasked, tmp_path, capsys):
    command = ["masks", str(unmasked.path), str(tmp_path / "out"), "--method", "plate"]
    assert main(command) == 2
    assert "--plate and --plate-frames" in capsys.readouterr().err
    (unmasked.path / "plates/b.png").unlink()
    assert main([*command, "--plate", str(unmasked.path / "plates")]) == 2
    assert "named after each camera (a, b, c, d)" in capsys.readouterr().err
    assert main([*command, "--plate", str(unmasked.path / "plates/{camera}.png")]) == 2
    assert "the clean plate of camera 'b', got no file" in capsys.readouterr().err
    unmasked.put("plates/b.png", np.zeros((5, 7, 3), np.uint8))
    assert main([*command, "--plate", str(unmasked.path / "plates")]) == 2
    assert "expected 160 x 128 pixels as the images have, got 7 x 5" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_the_frames_of_a_capture_can_be_its_plate(unmasked, tmp_path):
    """Frame 0 shows nobody: its images are the stages."""
    for name in "abcd":
        unmasked.put(f"images/{name}_000.png", unmasked.get(f"plates/{name}.png"))
    out = tmp_path / "masked"
    options = ["--method", "plate", "--plate-frames", "0:1", "--frames", "1:2"]
    assert main(["masks", str(unmasked.path), str(out), *options]) == 0
    assert agreement(unmasked, open_capture(out).read(0).mask, "001") > 0.95


def test_the_images_own_alpha_is_a_mask(unmasked, tmp_path, capsys):
    command = ["masks", str(unmasked.path), str(tmp_path / "out"), "--method", "alpha"]
    assert main(command) == 2
    assert "a_000.png: camera 'a': expected RGB and alpha, got 3 channels" in capsys.readouterr().err
    for name in "abcd":
        for frame in ("000", "001"):
            file = f"images/{name}_{frame}.png"
            unmasked.put(file, np.dstack([unmasked.get(file), unmasked.get(f"truth/{name}_{frame}.png")]))
    assert main(command) == 0
    assert agreement(unmasked, open_capture(tmp_path / "out").read(0).mask, "000") == 1


def test_a_screen_is_keyed(unmasked, tmp_path):
    for name in "abcd":
        for frame in ("000", "001"):
            mask = unmasked.get(f"truth/{name}_{frame}.png")[..., None] > 127
            unmasked.put(
                f"images/{name}_{frame}.png", np.where(mask, np.uint8([90, 90, 90]), np.uint8([60, 160, 30]))
            )
    out = tmp_path / "out"
    assert main(["masks", str(unmasked.path), str(out), "--method", "chroma", "--images", "png"]) == 0
    frame = open_capture(out).read(0)
    assert agreement(unmasked, frame.mask, "000") > 0.95
    inside = frame.mask > 127
    red, green, blue = (frame.rgb[:, c][inside].int() for c in range(3))
    assert int((green - torch.maximum(red, blue)).max()) <= 0  # no pixel of the subject is green


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--method", "plate", "--plate", "x", "--plate-frames", "0:1"], "--plate and --plate-frames"),
        (["--method", "chroma", "--plate", "x"], "expected plates only with --method plate or onnx"),
        (["--method", "onnx"], "expected --network with --method onnx"),
        (["--network", "x.onnx"], "expected --network with --method onnx"),
    ],
)
def test_options_that_do_not_go_together_are_refused(unmasked, tmp_path, capsys, options, told):
    assert main(["masks", str(unmasked.path), str(tmp_path / "out"), *options]) == 2
    assert told in capsys.readouterr().err


def test_whoever_needs_masks_hears_of_the_command(unmasked, tmp_path, capsys):
    assert main(["mend", str(unmasked.path), "--path", "orbit", "--out", str(tmp_path / "out")]) == 2
    assert f"viewmend masks {unmasked.path} OUT" in capsys.readouterr().err
    assert main(["info", str(unmasked.path)]) == 0
    assert "none (viewmend masks makes them)" in capsys.readouterr().out


def test_frames_without_a_subject_are_named_and_a_capture_of_such_alone_is_refused(
    unmasked, tmp_path, capsys
):
    for name in "abcd":
        unmasked.put(f"images/{name}_001.png", unmasked.get(f"plates/{name}.png"))
    options = ["--method", "plate", "--no-clean", "--plate", str(unmasked.path / "plates")]
    command = ["masks", str(unmasked.path), str(tmp_path / "out"), *options]
    assert main(command) == 0
    assert "1 of 2 frames have no subject ('001'); their masks are empty" in capsys.readouterr().err
    command[2] = str(tmp_path / "none")
    assert main([*command, "--frames", "1:2"]) == 2
    assert "expected a subject, got none in 1 frame; remove the folder" in capsys.readouterr().err
