import json

import pytest

from viewmend.cli import main
from viewmend.data.native_capture import open_capture


def test_writes_captures_that_can_be_read(tmp_path, capsys):
    out = tmp_path / "made"
    options = ["--scenes", "2", "--cameras", "4", "--frames", "2", "--size", "48", "--seed", "10005"]
    assert main(["studio", str(out), *options, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert [c["seed"] for c in report["captures"]] == [10005, 10006]
    for entry in report["captures"]:
        capture = open_capture(entry["folder"])
        frame = capture.read(1)
        assert frame.rgb.shape == (4, 3, 48, 48) and len(capture.frame_ids) == 2 and capture.fps == 30
        assert frame.mask is not None and frame.depth is not None and capture.bounds is not None
    assert main(["studio", str(out), *options]) == 2
    assert "scene_10005" in capsys.readouterr().err


def test_who_was_stopped_is_told_how_to_go_on(tmp_path, capsys):
    small = ["--cameras", "4", "--frames", "1", "--size", "32"]
    assert main(["studio", str(tmp_path), *small, "--seed", "10005"]) == 0
    left = tmp_path / f".scene_10006.unfinished-{2**22 + 1}"
    left.mkdir()
    assert main(["studio", str(tmp_path), *small, "--seed", "10005", "--scenes", "3"]) == 2
    assert "continue with --seed 10006 --scenes 2, or choose another folder" in capsys.readouterr().err
    assert not left.exists()
    assert main(["studio", str(tmp_path), *small, "--seed", "10004", "--scenes", "2"]) == 2
    assert "choose another --seed or folder" in capsys.readouterr().err, "it has not begun there"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--frames", "0"], "--frames of at least 1, got 0"),
        (["--cameras", "3"], "--cameras of at least 4, got 3"),
        (["--seed", "-1"], "--seed of at least 0, got -1"),
        (["--performers", "nowhere", "--motions", "nowhere"], "nowhere"),
        (["--performers", "nowhere"], "no motions"),
    ],
)
def test_bad_options_leave_nothing_behind(tmp_path, capsys, options, message):
    out = tmp_path / "made"
    assert main(["studio", str(out), *options]) == 2
    assert message in capsys.readouterr().err
    assert not out.exists() or not any(out.iterdir())
