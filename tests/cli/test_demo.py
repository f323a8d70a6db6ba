"""`viewmend demo`, small."""

import json

import cv2
import torch

from viewmend.cli import main
from viewmend.data.capture_folder import open_capture
from viewmend.mending import Mender
from viewmend.utils.contact_sheet import GAP_PX, LABEL_PX

SMALL = ["--frames", "3", "--size", "72", "--cameras", "4", "--model", "telea", "--seed", "10001"]


def test_the_demo_renders_mends_and_scores(tmp_path, capsys):
    assert main(["demo", "--out", str(tmp_path / "a"), "--json", *SMALL]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["frames"] == 3 and 0 < report["hole_fraction"] < 1
    assert report["psnr_holes"] == report["psnr_holes_telea"]
    assert report["psnr_whole"] > report["psnr_whole_rendered"]
    assert set(report["stage_ms"]) == {"geometry", "context", "rendering", "inpainting"}
    assert {f.name for f in (tmp_path / "a").iterdir()} == {".viewmend", "demo.mp4", "contact_sheet.png"}
    video = cv2.VideoCapture(str(tmp_path / "a" / "demo.mp4"))
    read, panel = video.read()
    assert read and int(video.get(cv2.CAP_PROP_FRAME_COUNT)) == 3
    # Three panels of 72 pixels with gaps, their captions above.
    assert panel.shape == (LABEL_PX + 72 + 2 * GAP_PX, 3 * (72 + GAP_PX) + GAP_PX, 3)
    assert panel[GAP_PX : GAP_PX + LABEL_PX].max() > 150


def test_every_frame_is_judged_by_the_truth_of_its_time_and_place(tmp_path, monkeypatch):
    seen = []
    mend = Mender.mend

    def watched(self, frame, target, truth):
        seen.append(
            (frame.time, truth.time, torch.equal(target.camera_from_world, truth.cameras.camera_from_world))
        )
        return mend(self, frame, target, truth)

    monkeypatch.setattr(Mender, "mend", watched)
    assert main(["demo", "--out", str(tmp_path / "a"), *SMALL]) == 0
    assert seen == [(0, 0, True), (1, 1, True), (2, 2, True)]


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
