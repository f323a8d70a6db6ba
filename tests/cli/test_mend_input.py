"""`viewmend mend` says what is wrong with its input in one line, and leaves nothing half-written."""

import json
import shutil

import pytest
import torch
from reference.capture_folder import remove_masks

from viewmend.cli import main
from viewmend.cli.checks import chosen_times
from viewmend.data.capture_folder import CaptureFolder, open_capture
from viewmend.data.prepare import adjustments

AS_IT_IS = ("--no-align", "--no-match-colours")
POSES = [torch.eye(4).tolist()]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "expected JSON"),
        ("[]", "world_from_camera: expected a list that is not empty"),
        ("[[[1, 0], [0, 1]]]", "world_from_camera[0]: expected a list of length 4"),
        (json.dumps([(2 * torch.eye(4)).tolist()]), "pose 0: expected a rotation"),
        (json.dumps({"world_from_camera": POSES, "width": 30}), "'height'"),
        (json.dumps(POSES * 3), "one per frame (2 frames), got 3"),
        (json.dumps({"world_from_camera": POSES, "K": [[0] * 3] * 3}), "expected 'K' as"),
        (
            json.dumps({"world_from_camera": POSES, "width": 10**8, "height": 9}),
            "expected a whole number <= 16384",
        ),
        (json.dumps({"world_from_camera": POSES, "width": 9, "height": 1}), "expected a whole number >= 2"),
        ("[" * 100_000, "expected JSON"),
    ],
)
def test_a_bad_path_is_named_before_frames_are_read(folder, tmp_path, mend, monkeypatch, content, message):
    monkeypatch.setattr(CaptureFolder, "read", lambda *_: pytest.fail("a frame was read"))
    file = tmp_path / "path.json"
    file.write_text(content)
    code, _, err = mend(folder, tmp_path / "out", "--path", file, *AS_IT_IS)
    assert code == 2 and message in err
    assert [f.name for f in tmp_path.iterdir()] == ["path.json"]


def test_frames_with_too_few_cameras_are_left_out(folder, tmp_path, mend):
    few = shutil.copytree(folder, tmp_path / "few")
    for name in ("c1", "c2", "c3", "c4", "c5"):
        (few / "image" / name / "001.png").unlink()
    code, scores, err = mend(few, tmp_path / "out", "--leave-out", "held")
    assert code == 0 and scores["frames"] == 1
    assert (
        "1 of 2 frames have fewer than two input cameras and are skipped, which shortens the result; " in err
    )
    code, _, err = mend(few, tmp_path / "out", "--leave-out", "held", "--frames", "1:2")
    assert code == 2 and "expected a frame with two input cameras, got none" in err


@pytest.mark.parametrize(
    ("text", "times", "said"),
    [
        (None, range(10), ""),
        ("8:", range(8, 10), ""),
        (":-4", range(6), ""),
        ("-2:", range(8, 10), ""),
        ("8:100", range(8, 10), "--frames 8:100: there are 10 frames, so 8:10 is used\n"),
        ("-12:3", range(3), "--frames -12:3: there are 10 frames, so 0:3 is used\n"),
    ],
)
def test_fewer_frames_than_asked_for_are_said(capsys, text, times, said):
    assert chosen_times(text, 10) == times
    assert capsys.readouterr().err == said


def test_a_capture_without_masks_is_refused(folder, tmp_path, mend):
    bare = shutil.copytree(folder, tmp_path / "bare")
    remove_masks(bare)
    code, _, err = mend(bare, tmp_path / "out", "--leave-out", "held")
    assert code == 2 and "expected a 'mask'" in err and not (tmp_path / "out").exists()


def test_an_unreadable_frame_leaves_nothing_half_written(folder, tmp_path, mend):
    broken = shutil.copytree(folder, tmp_path / "broken")
    last = broken / "image" / "c5" / "001.png"
    last.write_bytes(b"no picture")
    code, _, err = mend(broken, tmp_path / "out", "--leave-out", "held")
    assert code == 2 and last.name in err
    assert [f.name for f in tmp_path.iterdir()] == ["broken"]


def test_what_is_not_of_an_earlier_run_is_not_replaced(folder, tmp_path, mend):
    notes = tmp_path / "holes/notes.txt"
    notes.parent.mkdir()
    notes.write_text("precious")
    given = ("--leave-out", "held", "--frames", "0:1", *AS_IT_IS)
    code, _, err = mend(folder, tmp_path, *given)
    assert code == 2 and "notes.txt: expected no such file, or an unchanged one from an earlier run" in err
    assert notes.read_text() == "precious"
    notes.unlink()
    for said in (False, True):  # its own results are
        code, _, err = mend(folder, tmp_path, *given)
        assert code == 0 and (f"{tmp_path}: the results of an earlier run will be replaced" in err) == said
    written = {".viewmend", "holes", "completed", "rendered", "true", "contact_sheet.png"}
    assert {f.name for f in tmp_path.iterdir()} == written


def test_check_says_what_mend_would_change(folder, shifted, capsys):
    (change,) = adjustments(open_capture(shifted), open_capture(shifted).read(0), ())
    assert "principal points moved by (-" in change
    for capture, said in ((shifted, True), (folder, False)):
        assert main(["check", str(capture)]) == 0
        words = capsys.readouterr().out
        assert (change in words) == ("mend, serve and evaluate change:" in words) == said


def test_a_shift_of_all_images_is_said_and_undone(folder, shifted, tmp_path, mend):
    _, exact, nothing = mend(folder, tmp_path / "exact", "--leave-out", "held")
    _, undone, said = mend(shifted, tmp_path / "undone", "--leave-out", "held")
    _, left, also_nothing = mend(shifted, tmp_path / "left", "--leave-out", "held", "--no-align")
    assert "principal points moved by (-" in said and "first_pixel_center" in said
    assert "principal points" not in nothing + also_nothing
    assert undone["hull_iou"]["held"] == pytest.approx(exact["hull_iou"]["held"], abs=0.02)
    assert left["hull_iou"]["held"] < undone["hull_iou"]["held"] - 0.02
