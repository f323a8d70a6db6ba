"""`viewmend evaluate` and `viewmend weights` as a user calls them."""

import hashlib
import json
import math

import pytest

from viewmend import cli
from viewmend.cli.evaluate import RunOptions, scenes_of
from viewmend.metrics.weights import FOLDERS_VARIABLE

QUICK = ("--frames", "1", "--scenes", "1", "--size", "128", "--methods", "nearest,unfilled")


pytestmark = pytest.mark.usefixtures("no_weights")


def test_a_report_is_written_in_every_format_and_repeated_exactly(tmp_path, capsys):
    command = ["evaluate", "P", "--out", str(tmp_path / "out"), *QUICK, "--json"]
    assert cli.main(command) == 0
    first = json.loads(capsys.readouterr().out)
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        ".viewmend", "cells", "sheets", "report.md", "report.csv", "report.json", "report.html",
    }  # fmt: skip
    assert cli.main(command) == 0
    assert json.loads(capsys.readouterr().out) == first
    assert set(first["missing_networks"]) == {"lpips-vgg", "i3d"}
    assert [row["method"] for row in first["tables"][0]["rows"]] == ["nearest", "unfilled"]


def test_every_n_th_scene_covers_all_kinds(tmp_path):
    found = scenes_of("P", RunOptions(out=tmp_path, every=5, frames=1, size=64))
    assert len({(scene.rig, scene.style) for scene in found}) == len(found) == 6
    assert [s.name for s in scenes_of("P", RunOptions(out=tmp_path, every=5, scenes=2))] == [
        "P-10000",
        "P-10005",
    ]


@pytest.mark.parametrize("every", [1, 2, 3, 4, 6, 9, 10])
def test_one_scene_in_n_covers_both_rigs_and_all_tempos(tmp_path, every):
    everything = [scene.name for scene in scenes_of("P", RunOptions(out=tmp_path))]
    found = scenes_of("P", RunOptions(out=tmp_path, every=every))
    assert len(found) == math.ceil(30 / every) and len({scene.rig for scene in found}) == 2
    assert len({scene.style for scene in found}) == 3
    assert [name for name in everything if name in {s.name for s in found}] == [s.name for s in found]


def test_out_must_not_be_a_file(tmp_path, capsys):
    (tmp_path / "out").write_text("mine")
    assert cli.main(["evaluate", "P", "--out", str(tmp_path / "out"), *QUICK]) == 2
    assert "expected a folder for the results" in capsys.readouterr().err
    assert (tmp_path / "out").read_text() == "mine"


def test_weights_lists_known_files_and_searched_folders(tmp_path, monkeypatch, capsys):
    assert cli.main(["weights"]) == 0
    out = capsys.readouterr().out
    said = (
        "lpips-alex: verified",
        "i3d: missing",
        "dstt: missing",
        "weights get i3d",
        str(tmp_path / "nowhere"),
    )
    assert [word for word in said if word not in out] == []
    monkeypatch.setenv(FOLDERS_VARIABLE, str(tmp_path))
    (tmp_path / "DSTT.pth").touch()
    (tmp_path / "i3d.safetensors").write_bytes(b"another")
    assert cli.main(["weights", "--json"]) == 1
    found = {line["name"]: line for line in json.loads(capsys.readouterr().out)}
    assert found["dstt"]["status"].startswith("found") and found["dstt"]["path"] == str(tmp_path / "DSTT.pth")
    assert (
        found["i3d"]["status"] == "wrong" and hashlib.sha256(b"another").hexdigest() in found["i3d"]["error"]
    )
    assert found["lpips-vgg"]["status"] == "missing"


def test_a_failed_cell_fails_the_command(tmp_path, capsys):
    (tmp_path / "broken.py").write_text(
        "from viewmend.models.smooth_fill import SmoothFill\n\n"
        "class Broken(SmoothFill):\n"
        "    def __init__(self, device):\n        super().__init__()\n\n"
        "    def step(self, view, context, state):\n        raise RuntimeError('no idea')\n"
    )
    methods = f"unfilled,{tmp_path}/broken.py:Broken"
    command = ["evaluate", "P", "--out", str(tmp_path / "out"), *QUICK[:-1], methods, "--json"]
    assert cli.main(command) == 1
    said = capsys.readouterr()
    assert "Broken: failed: RuntimeError: no idea" in said.err
    failed = {row["method"]: row["failed"] for row in json.loads(said.out)["tables"][0]["rows"]}
    assert failed == {"unfilled": 0, f"{tmp_path}/broken.py:Broken": 1}


@pytest.mark.slow
@pytest.mark.parametrize("model", ["nearest", "views"])
def test_mend_and_evaluate_agree(folder, tmp_path, mend, capsys, model):
    _, mended, _ = mend(folder, tmp_path / "mend", "--leave-out", "c1", "--frames", "0:1", "--model", model)
    command = ["evaluate", str(folder), "--out", str(tmp_path / "evaluate"), "--scenes", "2", "--frames", "1"]
    assert cli.main([*command, "--methods", model, "--json"]) == 0
    cell = json.loads(capsys.readouterr().out)["cells"][1]
    names = {"psnr_whole_rendered": "psnr_rendered_whole", "alpha_iou": "alpha_iou_whole"}
    keys = [
        "psnr_whole",
        "psnr_whole_rendered",
        "ssim_whole",
        "psnr_subject",
        "alpha_iou",
        "psnr_valid",
        "psnr_holes",
    ]
    for key in [*keys, "psnr_holes_fg"]:
        assert cell[names.get(key, key)] == pytest.approx(mended[key], abs=1e-6), key
