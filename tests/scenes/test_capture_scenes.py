"""What a camera of a capture saw that is left out is the truth, and helps nobody before."""

import json
import shutil
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from reference.ball import AwayBall, BallCapture, ring
from reference.capture_folder import edit_description

from viewmend.cli import main
from viewmend.cli.evaluate import RunOptions, scenes_of
from viewmend.data.native_writer import write_capture
from viewmend.scenes import capture_scenes
from viewmend.scenes.capture_scenes import (
    SplitScene,
    capture_set,
    is_splits,
    make_splits,
    read_splits,
    split_scenes,
)
from viewmend.scenes.held_out import PROCEDURAL_SEEDS, recordings
from viewmend.scenes.studio_scenes import P_SEEDS, Q_SEEDS


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """A ball, and the same ball with the images and masks of one camera shifted by nine pixels."""
    exact = tmp_path_factory.mktemp("scenes") / "ball"
    write_capture(BallCapture(ring(6)), exact, images="png")
    other = exact.with_name("other")
    shutil.copytree(exact, other)
    for kind in ("image", "mask"):
        for file in (other / kind / "c2").iterdir():
            cv2.imwrite(str(file), np.roll(cv2.imread(str(file), cv2.IMREAD_UNCHANGED), 9, 1))
    return exact, other


def test_what_the_camera_left_out_saw_changes_the_truth_alone(folders):
    exact, other = (list(capture_set(folder)[2].frames()) for folder in folders)
    assert [frame.truth.cameras.names for frame in exact] == [("c2",)] * 2
    for one, two in zip(exact, other, strict=True):
        assert one.inputs.cameras.names == two.inputs.cameras.names == ("c0", "c1", "c3", "c4", "c5")
        assert torch.equal(one.inputs.cameras.K, two.inputs.cameras.K), "the rig is aligned without it"
        assert torch.equal(one.inputs.rgb, two.inputs.rgb) and torch.equal(one.inputs.mask, two.inputs.mask)
        assert torch.equal(one.truth.cameras.K, two.truth.cameras.K)
        assert torch.equal(one.truth.rgb.roll(9, 3), two.truth.rgb) and not torch.equal(
            one.truth.rgb, two.truth.rgb
        )
    assert not torch.equal(exact[0].truth.rgb, exact[1].truth.rgb), "each time is another"


def test_it_is_aligned_by_those_that_are_looked_at(folders):
    """The camera that lies beside pulls all others with it, where it is not left out."""
    pulled, clean = (next(capture_set(folders[1])[held].frames()).inputs.cameras for held in (0, 2))
    assert float((pulled.select(["c3"]).K - clean.select(["c3"]).K).abs().max()) > 0.3


# No split shares a seed with another, and none but the test's looks into the test's folders.


def test_no_seed_is_in_two_splits():
    for one, other in combinations(PROCEDURAL_SEEDS.values(), 2):
        assert one.stop <= other.start or other.stop <= one.start
    assert range(10000, 10030) == P_SEEDS and Q_SEEDS.start == 20000
    assert all(seeds[0] in PROCEDURAL_SEEDS["test"] for seeds in (P_SEEDS, Q_SEEDS))


@pytest.mark.parametrize(
    "place", ["people/test", "people/test/ann.glb", "captures/test/stage", "people/train/../test"]
)
def test_what_is_kept_for_tests_is_for_tests_alone(place):
    places = (Path("motions/train"), Path(place))
    assert recordings("test", places) == places
    message = "not kept for tests, got a folder named 'test'; give the one for training"
    for split in ("training", "validation"):
        with pytest.raises(ValueError, match=message):
            recordings(split, places)


def test_training_is_given_the_rest():
    places = (Path("people/train"), Path("people/testers/ann.glb"), Path("latest"))
    assert recordings("training", places) == places


# Splits of captures: subjects apart, one camera a scene, the same on every machine, refused where data changed.


@pytest.fixture(scope="module")
def captures(tmp_path_factory):
    """Two takes each of three people, and one of a fourth."""
    folder = tmp_path_factory.mktemp("data")
    for name in ("0001_01", "0001_02", "0002_01", "0002_02", "0003_01", "0003_02", "0004_01"):
        write_capture(BallCapture(ring(5)), folder / name, images="png")
    return folder


def made(captures, **options):
    return make_splits(sorted(captures.glob("0*")), captures, subject="^(.*)_", **options)


@settings(max_examples=8, deadline=None, database=None, derandomize=True)
@given(st.integers(0, 10**6), st.floats(0.01, 0.9))
def test_no_subject_is_in_both_parts(captures, seed, share):
    splits = made(captures, seed=seed, test_fraction=share)
    parts = {split: {s.subject for s in splits.scenes if s.split == split} for split in ("training", "test")}
    assert parts["training"] and parts["test"] and not parts["training"] & parts["test"]
    tested = sum(scene.split == "test" for scene in splits.scenes)
    assert tested >= share * 7 or len(parts["training"]) == 1
    for scene in splits.scenes:
        assert scene.left_out not in scene.closest and len(set(scene.closest)) == 3


def test_the_closest_are_those_beside_it_on_a_ring(captures):
    names = ring(5).names
    for scene in made(captures).scenes:
        held = names.index(scene.left_out)
        assert set(scene.closest[:2]) == {names[(held + 1) % 5], names[(held - 1) % 5]}


def test_another_capture_changes_nobodys_camera(captures):
    every = {scene.name: scene.left_out for scene in made(captures).scenes}
    fewer = make_splits(sorted(captures.glob("0*"))[2:], captures, subject="^(.*)_")
    assert all(every[scene.name] == scene.left_out for scene in fewer.scenes)
    assert len({made(captures, seed=seed).scenes[0].left_out for seed in range(12)}) > 1


def test_the_command_writes_what_evaluate_takes(captures, tmp_path, capsys):
    out = captures / "splits.json"
    try:
        everything = [str(path) for path in sorted(captures.glob("0*"))]
        assert main(["splits", *everything, "--out", str(out), "--subject", "^(.*)_"]) == 0
        assert "test: " in capsys.readouterr().out and is_splits(out)
        assert json.loads(out.read_text())["protocol"].startswith("No subject is in both splits")
        test = [scene for scene in read_splits(out).scenes if scene.split == "test"]
        scenes = split_scenes(out)
        assert [scene.held for scene in scenes] == [scene.left_out for scene in test]
        assert all(len(scene.inputs) == 4 and scene.held not in scene.inputs for scene in scenes)
        assert scenes_of(str(out), RunOptions(out=tmp_path)) == list(scenes)
        for other in ({"inputs": "8"}, {"format": "bundle"}):
            with pytest.raises(ValueError, match="expected neither --inputs nor --format"):
                scenes_of(str(out), RunOptions(out=tmp_path, **other))
        frame = next(iter(scenes[0].frames()))
        assert frame.truth.cameras.names == (scenes[0].held,) and len(frame.inputs.cameras) == 4
        assert main(["splits", *everything, "--out", str(out)]) == 2
        assert "published splits must not change" in capsys.readouterr().err
    finally:
        out.unlink(missing_ok=True)


def test_data_that_changed_are_refused(captures, tmp_path):
    write_capture(BallCapture(ring(5)), tmp_path / "0001_01", images="png")
    write_capture(BallCapture(ring(5)), tmp_path / "0002_01", images="png")
    paths = [tmp_path / "0001_01", tmp_path / "0002_01"]
    out = tmp_path / "splits.json"
    assert main(["splits", *map(str, paths), "--out", str(out)]) == 0
    for path in paths:
        edit_description(path, lambda d: d["cameras"][0].update(t=[x + 0.01 for x in d["cameras"][0]["t"]]))
    with pytest.raises(ValueError, match=r"expected the calibration that splits\.json was made with"):
        split_scenes(out)
    for path in paths:
        path.rename(path.with_name(path.name + "x"))
    with pytest.raises(
        ValueError, match=r"expected the capture .*, got none; put the file where its paths hold"
    ):
        split_scenes(out)


def test_what_cannot_be_split_is_refused(captures, tmp_path, capsys):
    one = [str(captures / "0001_01"), str(captures / "0001_02")]
    for arguments, message in (
        ([*one, "--subject", "^(.*)_"], "two subjects or more, got the subjects ['0001']"),
        ([one[0], one[0]], "got ['0001_01'] twice"),
        ([*one, "--subject", "^x(.*)"], "expected a subject by --subject '^x(.*)' in '0001_01'"),
        ([*one, "--subject", "("], "expected a regular expression for --subject"),
        ([*one, "--test-fraction", "1"], "expected --test-fraction between 0 and 1"),
    ):
        assert main(["splits", *arguments, "--out", str(tmp_path / "a.json")]) == 2
        assert message in capsys.readouterr().err
        assert not (tmp_path / "a.json").exists()


def test_by_default_7_of_79_are_for_tests_and_scenes_are_a_random_subset(captures, monkeypatch):
    def scene(path, *_):
        same = dict.fromkeys(("name", "path", "subject"), path.name)
        return SplitScene(**same, split="training", left_out="a", closest=(), calibration_sha256="")

    monkeypatch.setattr(capture_scenes, "_scene", scene)
    paths = [captures / f"{number:04d}" for number in range(100)]
    for count in (79, 158):
        many = make_splits([captures / f"{number:04d}" for number in range(count)], captures)
        assert sum(scene.split == "test" for scene in many.scenes) == 7 * count // 79
    drawn = [
        {s.name for s in make_splits(paths, captures, seed=seed, scenes=10).scenes} for seed in (0, 0, 1)
    ]
    assert drawn[0] == drawn[1] != drawn[2] and len(drawn[0]) == len(drawn[2]) == 10
    assert drawn[0] != {path.name for path in paths[:10]}
    with pytest.raises(ValueError, match=r"at least the 101 captures of --scenes, got 100"):
        make_splits(paths, captures, scenes=101)


def test_frames_without_a_subject_are_not_scored(tmp_path):
    write_capture(AwayBall(ring(6), 4, {0, 2}), tmp_path / "ball", images="png")
    assert [frame.inputs.time for frame in capture_set(tmp_path / "ball")[2].frames()] == [1, 3]
