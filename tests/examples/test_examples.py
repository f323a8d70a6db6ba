"""The examples run as they are."""

import json
import runpy
from dataclasses import replace
from pathlib import Path

import cv2
import torch

from viewmend import cli
from viewmend.models.base import Inpainter
from viewmend.models.checkpoint import load_inpainter
from viewmend.models.classical import Telea
from viewmend.models.registry import make_method

EXAMPLES = Path(__file__).parents[2] / "examples"


def test_the_first_example_improves_a_view(tmp_path, capsys):
    lesson = runpy.run_path(str(EXAMPLES / "01_mend_a_view.py"))
    picture = lesson["main"](tmp_path / "capture", frames=2, size_px=96)
    said = capsys.readouterr().out
    assert "pixels were missing" in said and "rendered, completed, truth" in said
    image = cv2.imread(str(picture))
    rendered, completed, truth = (image[:, i * 96 : (i + 1) * 96].astype(float) for i in range(3))
    assert image.shape == (96, 288, 3)
    assert ((completed - truth) ** 2).mean() < ((rendered - truth) ** 2).mean()


def test_views_of_another_renderer_are_completed_and_composited_on_a_background():
    renderer = runpy.run_path(str(EXAMPLES / "own_renderer.py"))
    completed, truth = renderer["run"](load_inpainter("views"), frames=2, size=96)
    view = completed.view
    holes, right = view.error > 0, view.error == 0
    assert 0.02 < float(holes.sum()) / float(view.mask.sum()) < 0.6
    assert torch.equal(completed.rgb[:, right], view.rgb[:, right])
    black = truth.rgb[0] / 255 * (truth.mask[0] / 255)
    left, mended = ((rgb - black)[:, holes].square().mean() for rgb in (view.rgb, completed.rgb))
    assert mended < 0.3 * left

    completed, _ = renderer["run"](Telea(), frames=1, size=64)
    alpha = torch.linspace(0, 1, 64).expand(64, 64)
    soft = replace(completed, rgb=0.5 * alpha.expand(3, -1, -1), alpha=alpha)
    over = renderer["composite"](soft, torch.tensor([1.0, 0.5, 0.0]))
    assert over[:, 0, 0].tolist() == [1, 0.5, 0] and over[:, 0, -1].tolist() == [0.5, 0.5, 0.5]
    assert torch.allclose(over[1], torch.tensor(0.5)), "grey on grey shows no outline"


def test_a_custom_rule_selects_more():
    rule = runpy.run_path(str(EXAMPLES / "new_error_rule.py"))
    own = f"{EXAMPLES / 'new_error_rule.py'}:disagreement"
    assert rule["selected"](own) > 1.5 * rule["selected"]("holes") > 0


def test_a_method_in_one_short_file_is_evaluated(tmp_path):
    example = EXAMPLES / "new_method.py"
    assert len(example.read_text().splitlines()) < 60
    name = f"{example}:Afterimage"
    assert isinstance(make_method(name), Inpainter)
    arguments = ["evaluate", "P", "--scenes", "1", "--frames", "2", "--size", "128", "--methods", f"unfilled,{name}"]
    assert cli.main([*arguments, "--out", str(tmp_path)]) == 0
    unfilled, own = json.loads((tmp_path / "report.json").read_text())["cells"]
    assert own["method"] == name and own["error"] is None and own["frames"] == 2
    assert own["psnr_whole"] != unfilled["psnr_whole"]
