"""`viewmend demo`, small."""

import json

import cv2
import torch

from viewmend.cli import main
from viewmend.evaluation.mending import Mender
from viewmend.utils.contact_sheet import GAP_PX, LABEL_PX

SMALL = ["--frames", "3", "--size", "72", "--cameras", "4", "--model", "telea", "--seed", "10001"]


def test_the_demo_renders_mends_and_scores(tmp_path, capsys):
    assert main(["demo", "--out", str(tmp_path / "a"), "--json", *SMALL]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["frames"] == 3 and 0 < report["hole_fraction"] < 1
    assert report["ours"] == report["telea"]
    assert report["telea"]["psnr_holes_fg"] > report["unfilled"]["psnr_holes_fg"] + 1
    assert set(report["stage_ms"]) == {"geometry", "context", "rendering", "inpainting"}
    assert {f.name for f in (tmp_path / "a").iterdir()} == {".viewmend", "demo.mp4", "contact_sheet.png"}
    video = cv2.VideoCapture(str(tmp_path / "a" / "demo.mp4"))
    read, panel = video.read()
    assert read and int(video.get(cv2.CAP_PROP_FRAME_COUNT)) == 3
    # Three panels of 72 pixels with gaps, their captions above.
    assert panel.shape == (LABEL_PX + 72 + 2 * GAP_PX, 3 * (72 + GAP_PX) + GAP_PX, 3)
    captions = panel[GAP_PX : GAP_PX + LABEL_PX]
    assert captions.max() > 150


def test_every_frame_is_judged_by_the_truth_of_its_time_and_place(tmp_path, monkeypatch):
    seen = []
    mend = Mender.mend

    def watched(self, frame, target, truth):
        seen.append((frame.time, truth.time, torch.equal(target.camera_from_world, truth.cameras.camera_from_world)))
        return mend(self, frame, target, truth)

    monkeypatch.setattr(Mender, "mend", watched)
    assert main(["demo", "--out", str(tmp_path / "a"), *SMALL]) == 0
    assert seen == [(0, 0, True), (1, 1, True), (2, 2, True)]


def test_the_same_seed_gives_the_same_picture(tmp_path, capsys):
    pictures = []
    for out in "ab":
        assert main(["demo", "--out", str(tmp_path / out), *SMALL]) == 0
        pictures.append((tmp_path / out / "contact_sheet.png").read_bytes())
    assert pictures[0] == pictures[1]
    assert "Telea" in capsys.readouterr().out


def test_counts_must_be_positive(tmp_path, capsys):
    assert main(["demo", "--out", str(tmp_path / "a"), "--frames", "0"]) == 2
    assert "positive --frames" in capsys.readouterr().err
    assert not (tmp_path / "a").exists()
