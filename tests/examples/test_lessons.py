"""The examples run as they are."""

import runpy
from dataclasses import replace
from pathlib import Path

import cv2
import torch

from viewmend.models.classical import Telea

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


def test_a_view_is_composited_on_a_background():
    renderer = runpy.run_path(str(EXAMPLES / "own_renderer.py"))
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
