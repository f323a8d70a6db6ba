"""Fine-tuning holds back a camera and the last frames, and keeps the best weights."""

import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from reference.ball import AwayBall, BallCapture, ring
from reference.other_device import other_device
from reference.shared_scenes import TAKES
from training.conftest import RUN, SCENES, VIEWS_MODEL, VIEWS_SAMPLING, log_of

from viewmend.data.errors import CaptureError
from viewmend.data.images import write_image
from viewmend.data.native_writer import write_capture
from viewmend.metrics.lpips import load_lpips
from viewmend.models.checkpoint import load_network
from viewmend.models.views.model import ViewSynthNet
from viewmend.scenes.capture_scenes import make_splits, read_splits, splits_json
from viewmend.training import held_back
from viewmend.training.config import TrainConfig
from viewmend.training.held_back import (
    AUTO,
    HeldBack,
    HeldBackValidation,
    KeptWeights,
    _subject_box,
    compare,
    held_back_views,
)
from viewmend.training.loop import RunClock, train
from viewmend.training.scenes import rig_source
from viewmend.training.views import ViewsObjectiveConfig


@pytest.fixture(scope="session")
def place(takes):
    return takes / "ada"


def test_the_middle_camera_and_the_last_tenth_are_held_back():
    capture = BallCapture(ring(5), frames=31)
    assert HeldBack.of(capture, AUTO) == HeldBack("c2", 27)
    assert HeldBack.of(capture, "c4") == HeldBack("c4", 27)
    one_frame = BallCapture(ring(5), frames=1)
    assert HeldBack.of(one_frame, AUTO) == HeldBack("c2", 1)
    small = BallCapture(ring(4), frames=31)
    assert HeldBack.of(small, AUTO) == HeldBack(None, 27)
    left = AwayBall(ring(4), 20, {18, 19})
    assert HeldBack.of(left, AUTO) == HeldBack(None, 16), "a tenth of the frames with a subject"
    assert HeldBack.of(AwayBall(ring(4), 20, {*range(1, 20)}), AUTO) == HeldBack(None, 1)
    assert HeldBack.of(AwayBall(ring(4), 20, {*range(20)}), AUTO) == HeldBack(None, 18)
    with pytest.raises(CaptureError, match=r"--hold-out among c0, .*got 'front'"):
        HeldBack.of(capture, "front")
    with pytest.raises(CaptureError, match="at least 5 cameras to hold one back, got 4"):
        HeldBack.of(small, "c0")


def test_what_is_held_back_is_described():
    capture = BallCapture(ring(5), frames=31)
    text = HeldBack.of(capture, AUTO).describe(capture)
    assert "camera 'c2' and the last 4 frames" in text and "are held out" in text
    small = BallCapture(ring(4), frames=31)
    assert "the last 4 frames (from '027' on) are held out" in HeldBack.of(small, AUTO).describe(small)
    one_frame = BallCapture(ring(5), frames=1)
    assert "camera 'c2' is held out" in HeldBack.of(one_frame, AUTO).describe(one_frame)


def test_a_camera_with_an_empty_mask_is_not_held_back_and_has_no_row(balls, tmp_path):
    folder = shutil.copytree(balls / "ada", tmp_path / "ada")
    for file in sorted((folder / "mask/c2").iterdir()) + sorted((folder / "mask/c4").iterdir()):
        write_image(file, np.zeros(cv2.imread(str(file), 0).shape, np.uint8))
    table = [view.camera for view in held_back_views(folder, AUTO, table=True)]
    assert table[0] == "c1", "the camera next to the middle one"
    assert sorted(table) == ["c0", "c1", "c3"]


def validations(*scores):
    return [(60 * n, {"score": s, "psnr_whole": s + 8, "lpips_subject": 0.2}) for n, s in enumerate(scores)]


def test_the_report_says_which_weights_were_kept_and_why():
    kept = KeptWeights.of(validations(20.0, 20.5, 20.55, 20.2))
    assert (kept.step, kept.steps) == (60, 180)
    (text,) = kept.describe("views", 60)
    assert "kept the weights of step 60 of 180" in text and "PSNR 28.00 to 28.50 dB" in text
    first = KeptWeights.of(validations(20.0, 20.05, 19.0))
    assert first.step == 0
    (text,) = first.describe("views", 60)
    assert "kept the first weights: the result is 'views' unchanged" in text and "+0.05" in text
    brief = KeptWeights.of([*validations(20.0), (46, {"score": 19.9})])
    assert "46 steps are too few to judge" in brief.describe("views", 60)[1]
    assert KeptWeights.of([]) is None


def test_training_never_sees_what_is_held_back(balls):
    scenes = replace(SCENES, captures=(balls / "ada",), captures_fraction=1.0, hold_out="c3")
    source = rig_source(scenes, (0, 1), "tests")
    rigs = [source.rig(number).rig for number in range(12)]
    assert {time for rig in rigs for time in rig.frames} == {0, 1, 2}
    names = {name for rig in rigs for frame in rig.frames.values() for name in frame.cameras.names}
    assert names == {"c0", "c1", "c2", "c4"}


@pytest.mark.slow
def test_what_is_held_back_is_scored(place):
    views = list(held_back_views(place, AUTO))
    assert {view.camera for view in views} == {"cam02"} and not any(view.trained_on for view in views)
    assert 3 in {view.truth.time for view in views}
    assert all("cam02" not in view.inputs.frame.cameras.names for view in views)
    table = list(held_back_views(place, AUTO, table=True))
    assert [view.camera for view in table] == ["cam02", "cam00", "cam01", "cam03", "cam04"]
    assert {view.truth.time for view in table} == {3}


@pytest.mark.slow
@pytest.mark.parametrize("cameras", [4, 5])
@pytest.mark.parametrize("empty", [{19}, {18, 19}])
def test_the_subject_is_shown_also_if_it_has_left(empty, cameras, tmp_path):
    """Neither the validation of a small rig nor the table may use frames that were trained on."""
    capture = AwayBall(ring(cameras), 20, empty)
    write_capture(capture, tmp_path / "ball", images="png")
    first = HeldBack.of(capture, AUTO).first_frame
    table = list(held_back_views(tmp_path / "ball", AUTO, table=True))
    assert len(table) == cameras and not any(view.trained_on for view in table)
    validation = list(held_back_views(tmp_path / "ball", AUTO))
    late = {view.truth.time for view in table + (validation if cameras == 4 else [])}
    assert late and min(late) >= first and validation
    assert all(bool(view.truth.mask.any()) for view in table + validation)


@pytest.mark.slow
def test_of_a_splits_file_the_last_frames_are_held_back(balls, tmp_path):
    captures = [shutil.copytree(balls / name, tmp_path / name) for name in TAKES]
    file = tmp_path / "splits.json"
    file.write_text(splits_json(make_splits(captures, tmp_path)))
    scenes = replace(SCENES, captures=(file,), captures_fraction=1.0, hold_out=AUTO)
    source = rig_source(scenes, (0, 1), "tests")
    rigs = [source.rig(number) for number in range(12)]
    assert {time for own in rigs for time in own.rig.frames} == {0, 1, 2}
    training = {scene.left_out for scene in read_splits(file).scenes if scene.split == "training"}
    assert {own.held_out for own in rigs} == training
    views = list(held_back_views(file, AUTO))
    assert {view.truth.time for view in views} == {3} and not any(view.trained_on for view in views)
    assert len(list(held_back_views(file, AUTO, table=True))) == 5


@pytest.mark.slow
def test_the_table_tells_better_weights_from_worse_ones(place, tmp_path):
    good, bad = ViewSynthNet(VIEWS_MODEL).eval(), ViewSynthNet(VIEWS_MODEL).eval()
    with torch.no_grad():
        bad.blending[-1].weight.zero_()
        bad.blending[-1].bias.fill_(-9.0)  # everything is transparent
    models = {"before": bad, "after": good}
    lines = compare(place, AUTO, models, tmp_path / "sheet.png").splitlines()
    assert len(lines) == 7 and (tmp_path / "sheet.png").stat().st_size > 1000
    for line in lines[2:]:
        _, psnr_rendered, psnr_before, psnr_after, lpips_rendered, lpips_before, lpips_after = (
            part.strip() for part in line.strip("|").split("|")
        )
        assert float(psnr_after) > float(psnr_before) and float(lpips_after) < float(lpips_before)
        assert 10 < float(psnr_rendered) < float(psnr_after) and 0 < float(lpips_rendered) < 1


def test_a_model_on_any_device_is_scored(place, monkeypatch):
    torch.manual_seed(0)
    model, metric, view = ViewSynthNet(VIEWS_MODEL).eval(), load_lpips(), next(held_back_views(place, AUTO))
    with torch.no_grad():
        expected, _ = view.score(model, metric)
        with other_device(monkeypatch) as device:
            found, completed = view.score(model.to(device), metric)
    assert completed.rgb.device.type == "cpu"
    assert found.psnr_db == pytest.approx(expected.psnr_db, abs=0.05)
    assert found.lpips == pytest.approx(expected.lpips, abs=0.005)


def test_a_run_keeps_its_best_weights_and_stops(place, tmp_path, monkeypatch):
    scores = iter([1.0, 2.0, 2.05, 1.0, 1.2, 0.9, 0.8, 0.7, 0.6])
    monkeypatch.setattr(HeldBackValidation, "__call__", lambda *_: {"score": next(scores)})
    monkeypatch.setattr("viewmend.training.loop.PATIENCE", 3)
    monkeypatch.setattr(RunClock, "elapsed_s", lambda self: 300.0)
    config = finetuning(place, steps=40, validate_every=1)
    kept = []
    out = train(config, tmp_path / "run", report=lambda _: kept.append(first_weight(tmp_path / "run")))
    assert max(entry["step"] for entry in log_of(out)) == 4, "three validations after the best one"
    assert all(float(value) == float(kept[0]) for value in kept), (
        "step 1 was the best: step 2 gained too little"
    )
    assert "1 steps of 2 samples\nx 1 streams in 5 minutes" in (out / "README.md").read_text()
    train(config, out)
    assert float(first_weight(out)) == float(kept[0]), "a finished run stays as it is"


def test_a_resumed_run_knows_the_score_of_its_last_steps(place, tmp_path, monkeypatch):
    scores = iter(
        [1.0, 1.0, 3.0, 2.0, 2.0]
    )  # at the start, after step 2, at the end, then of the resumed run
    monkeypatch.setattr(HeldBackValidation, "__call__", lambda *_: {"score": next(scores)})
    config = finetuning(place, steps=3, validate_every=2)
    out = train(config, tmp_path / "run")
    best = float(first_weight(out))
    train(replace(config, steps=5), out)
    assert [entry["step"] for entry in log_of(out)][-1] == 5
    assert float(first_weight(out)) == best, "the weights of step 3 scored more than those of steps 4 and 5"


def test_a_run_that_was_killed_while_its_last_steps_were_scored_scores_them_later(
    place, tmp_path, monkeypatch
):
    scores = iter([1.0, 1.0, None, 3.0])

    def score(*_):
        found = next(scores)
        if found is None:
            raise KeyboardInterrupt
        return {"score": found}

    monkeypatch.setattr(HeldBackValidation, "__call__", score)
    config = finetuning(place, steps=3, validate_every=2)
    with pytest.raises(KeyboardInterrupt):
        train(config, tmp_path)
    first = float(first_weight(tmp_path))
    train(config, tmp_path)
    assert [entry["step"] for entry in log_of(tmp_path) if "validation" in entry] == [0, 2, 3]
    assert float(first_weight(tmp_path)) != first
    train(config, tmp_path)
    assert next(scores, None) is None, "nothing is scored twice"


def test_a_run_that_is_validated_only_when_resumed_goes_on(place, tmp_path, monkeypatch):
    monkeypatch.setattr(HeldBackValidation, "__call__", lambda *_: {"score": 1.0})
    monkeypatch.setattr("viewmend.training.loop.PATIENCE", 1)
    train(finetuning(place, steps=2, validate_every=0), tmp_path)
    train(finetuning(place, steps=4, validate_every=1), tmp_path)
    assert [entry["step"] for entry in log_of(tmp_path) if "losses" in entry] == [1, 2, 3, 4]


def test_a_run_without_captures_holds_nothing_back(tmp_path):
    options = ViewsObjectiveConfig(model=VIEWS_MODEL, sampling=VIEWS_SAMPLING)
    run = RUN | {"steps": 1, "validate_every": 1}
    config = TrainConfig(name="finetune", objective=options, scenes=replace(SCENES, hold_out=AUTO), **run)
    assert (train(config, tmp_path / "run") / "README.md").exists()


def finetuning(place, **changes):
    """Fine-tuning of a tiny model on a capture."""
    scenes = replace(SCENES, captures=(place,), captures_fraction=1.0, hold_out=AUTO)
    options = ViewsObjectiveConfig(model=VIEWS_MODEL, sampling=VIEWS_SAMPLING)
    return TrainConfig(name="finetune", objective=options, scenes=scenes, **RUN | {"ema": 0.0} | changes)


def first_weight(folder):
    return load_network(str(folder)).depth_logits.weight.detach().flatten()[0]


def test_psnr_and_lpips_are_both_weighed(place, tmp_path):
    found = HeldBackValidation([place], AUTO)(ViewSynthNet(VIEWS_MODEL), tmp_path / "shown.png")
    assert found["score"] == pytest.approx(found["psnr_whole"] - held_back.LPIPS_DB * found["lpips_subject"])
    assert (tmp_path / "shown.png").exists()


def test_lpips_is_of_the_subject_with_a_margin_and_of_all_without_a_subject():
    mask = torch.zeros(200, 300, dtype=torch.uint8)
    assert _subject_box(mask) == (slice(0, 200), slice(0, 300))
    mask[20:120, 150:160] = 255
    mask[20:30, 100:110] = 255
    rows, columns = _subject_box(mask)
    assert rows == slice(12, 128) and (columns.start, columns.stop) == (92, 168)
