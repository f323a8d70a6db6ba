"""The example method runs in an evaluation."""

import json
from pathlib import Path

from viewmend import cli
from viewmend.models.base import Inpainter
from viewmend.models.registry import make_method

EXAMPLE = Path(__file__).parents[2] / "examples" / "new_method.py"


def test_a_method_in_one_short_file_is_evaluated(tmp_path):
    assert len(EXAMPLE.read_text().splitlines()) < 60
    name = f"{EXAMPLE}:Afterimage"
    assert isinstance(make_method(name), Inpainter)
    arguments = ["evaluate", "P", "--scenes", "1", "--frames", "2", "--size", "128", "--methods", f"unfilled,{name}"]
    assert cli.main([*arguments, "--out", str(tmp_path)]) == 0
    report = json.loads((tmp_path / "report.json").read_text())
    unfilled, own = report["cells"]
    assert own["method"] == name and own["error"] is None and own["frames"] == 2
    assert own["psnr_whole"] != unfilled["psnr_whole"]
