"""The lesson and the error rule run as they stand."""

import runpy
from pathlib import Path

import cv2

from viewmend.rendering.error_rules import ERROR_RULES

EXAMPLES = Path(__file__).parents[2] / "examples"


def test_the_first_lesson_mends_a_view(tmp_path, capsys):
    lesson = runpy.run_path(str(EXAMPLES / "01_mend_a_view.py"))
    picture = lesson["main"](tmp_path / "capture", frames=2, size_px=96)
    said = capsys.readouterr().out
    assert "pixels were missing" in said and "rendered, mended, truth" in said
    image = cv2.imread(str(picture))
    rendered, mended, truth = (image[:, i * 96 : (i + 1) * 96].astype(float) for i in range(3))
    assert image.shape == (96, 288, 3)
    assert ((mended - truth) ** 2).mean() < ((rendered - truth) ** 2).mean()


def test_a_rule_of_ones_own_asks_for_more():
    try:
        rule = runpy.run_path(str(EXAMPLES / "new_error_rule.py"))
        assert rule["missing"]("disagreement") > 1.5 * rule["missing"]("unseen") > 0
    finally:
        ERROR_RULES.pop("disagreement", None)
