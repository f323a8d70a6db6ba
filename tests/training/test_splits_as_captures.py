"""A file of splits names what training may see: the captures for training, and of each one truth."""

import shutil
from dataclasses import replace

import pytest

from viewmend.capture.plain_writer import write_capture
from viewmend.leave_one_out.capture_splits import make_splits, read_splits, splits_json
from viewmend.studio.stage import Studio, StudioConfig
from viewmend.training.sources import scene_source


@pytest.fixture
def splits(tmp_path):
    takes = [tmp_path / name for name in ("ada", "bea", "cleo")]
    for number, take in enumerate(takes):
        write_capture(Studio(StudioConfig(seed=number, cameras=5, frames=2, size_px=64)), take, images="png")
    file = tmp_path / "splits.json"
    file.write_text(splits_json(make_splits(takes, tmp_path)))
    return file


def test_splits_leave_out_the_camera_that_they_name(plan, splits):
    training = {scene.name: scene.left_out for scene in read_splits(splits).scenes if scene.split == "training"}
    source = scene_source(replace(plan, sizes_px=(64,), captures=(splits,), captures_fraction=1.0), "0")
    assert [capture.name for capture in source.first.captures] == list(training), "nobody of the tests"
    seen = {sample.view.camera.names[0] for number in range(4) for sample in source.scene(number)}
    assert seen and seen <= set(training.values())


def test_splits_of_other_data_are_refused(plan, splits):
    for one, other in (("ada", "bea"), ("bea", "cleo")):
        shutil.copy(splits.parent / other / "cameras.json", splits.parent / one)
    with pytest.raises(ValueError, match="take that version of the data"):
        scene_source(replace(plan, captures=(splits,)), "0")
