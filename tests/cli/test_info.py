import json

import cv2
import numpy as np
import pytest
import torch

from viewmend.cli import main
from viewmend.cli.calibration_check import HULL_ONLY, MASK_ONLY, check_calibration, check_picture
from viewmend.contact_sheet import GAP_PX, LABEL_PX
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras
from viewmend.views import MultiViewFrame

WHITE = (255, 255, 255)


def described(capsys, *arguments):
    assert main(["info", *map(str, arguments), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


@pytest.fixture
def cube() -> MultiViewFrame:
    """Two cameras three metres from a cube of 0.8 m, which fills a square of 30 pixels in both."""
    K = torch.tensor([[110.0, 0, 50], [0, 110.0, 40], [0, 0, 1]])
    front = torch.eye(4)
    front[2, 3] = 3
    side = torch.tensor([[0.0, 0, -1, 0], [0, 1, 0, 0], [1, 0, 0, 3], [0, 0, 0, 1]])
    cameras = Cameras(("front", "side"), K.expand(2, 3, 3), torch.stack([front, side]), torch.tensor([[100, 80]] * 2))
    mask = torch.zeros(2, 80, 100, dtype=torch.uint8)
    mask[:, 25:55, 35:65] = 255
    return MultiViewFrame(cameras, torch.full((2, 3, 80, 100), 100, dtype=torch.uint8), mask, 0)


def tiles_of(sheet: np.ndarray, width: int, height: int) -> list[np.ndarray]:
    top = GAP_PX + LABEL_PX
    lefts = [GAP_PX, GAP_PX + width + GAP_PX]
    return [sheet[top : top + height, left : left + width].astype(int) for left in lefts]


def near(tile: np.ndarray, colour: tuple[int, int, int]) -> np.ndarray:
    return (np.abs(tile - colour) < 60).all(-1)


def test_masks_that_agree_score_high(cube):
    check = check_calibration(cube, None)
    assert set(check.iou) == {"front", "side"}
    assert min(check.iou.values()) > 0.9
    assert check.frame is cube and check.proxy is not None


def test_a_mask_that_disagrees_scores_low_and_shows(cube):
    cube.mask[1] = cube.mask[1].roll(12, 0)  # as if the second camera were turned
    check = check_calibration(cube, Bounds(-torch.ones(3), torch.ones(3)))
    assert max(check.iou.values()) < 0.75
    front, side = tiles_of(check_picture(check, None, tile_width=100), 100, 80)
    assert near(front, MASK_ONLY)[27:33, 38:62].mean() > 0.5  # the top of the front mask is carved away
    assert near(side, MASK_ONLY)[59:65, 38:62].mean() > 0.5  # and the bottom of the side mask
    assert near(front, HULL_ONLY).mean() < 0.02


def test_bounds_are_drawn_where_they_project(cube):
    check = check_calibration(cube, Bounds(-torch.ones(3) * 0.6, torch.ones(3) * 0.6))
    front, _ = tiles_of(check_picture(check, None, tile_width=100), 100, 80)
    far_left, far_top = 50 - 110 * 0.6 / 3.6, 40 - 110 * 0.6 / 3.6
    row = near(front, WHITE)[round(far_top) - 1 : round(far_top) + 2, 40:60]
    column = near(front, WHITE)[30:50, round(far_left) - 1 : round(far_left) + 2]
    assert row.any(0).all() and column.any(1).all()
    assert not near(front, WHITE)[45:50, 36:48].any()


def test_up_is_drawn_up(cube):
    check = check_calibration(cube, None)
    with_up, without = (
        tiles_of(check_picture(check, up, tile_width=100), 100, 80)[0] for up in (torch.tensor([0.0, -1.0, 0.0]), None)
    )
    rows = np.argwhere((with_up != without).any(-1))[:, 0]
    assert len(rows) and rows.max() <= 43  # from the middle of the cube towards smaller y


def test_a_capture_without_masks_is_checked_by_eye(cube):
    blind = MultiViewFrame(cube.cameras, cube.rgb, None, 0)
    check = check_calibration(blind, None)
    assert (check.iou, check.proxy, check.silhouettes) == ({}, None, None)
    torch.testing.assert_close(check.bounds.center, torch.zeros(3), atol=0.05, rtol=0)
    assert near(tiles_of(check_picture(check, None, tile_width=100), 100, 80)[0], WHITE).any()


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
    assert main(["info", str(folder)]) == 0
    words = capsys.readouterr().out
    for word in ("utrecht: a capture of 4 cameras", "644 x 486", "426, '000' to '425', 50 fps", "0.001 m", "hull IoU"):
        assert word in words


@pytest.fixture
def model(tmp_path):
    from viewmend.inpainting.chain import build
    from viewmend.inpainting.checkpoint import save_inpainter
    from viewmend.inpainting.config import InpainterConfig

    config = InpainterConfig(widths=(8,) * 9, dim=32, heads=2, blocks=1)
    save_inpainter(build(config), tmp_path / "model", "# Tiny\nTrained on nothing.")
    return tmp_path / "model"


def test_a_model_is_described(model, capsys):
    description = described(capsys, model)
    assert description["kind"] == "model" and description["config"]["dim"] == 32
    assert description["parameters"] > 1000 and "Trained on nothing" in description["card"]
    assert main(["info", str(model)]) == 0
    words = capsys.readouterr().out
    assert "million parameters" in words and "Trained on nothing." in words


def test_a_damaged_model_is_one_line(model, capsys):
    weights = model / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:-100])
    assert main(["info", str(model)]) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1 and "model.safetensors" in message


def test_a_model_has_no_check_picture(model, capsys, tmp_path):
    assert main(["info", str(model), "--out", str(tmp_path / "x.png")]) == 2
    assert "--out" in capsys.readouterr().err


def test_what_is_neither(capsys, tmp_path):
    assert main(["info", str(tmp_path / "nothing")]) == 2
    message = capsys.readouterr().err
    for word in ("nothing", "cameras.json", "model", "check the path"):
        assert word in message


def test_a_picture_needs_a_picture_s_name(shared, capsys, tmp_path):
    assert main(["info", str(shared / "captures" / "utrecht"), "--out", str(tmp_path / "check.txt")]) == 2
    assert "a picture's file name" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
