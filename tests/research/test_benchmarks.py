"""What the benchmarks share: waiting for the right device, files of results, and scores of masks and views."""

import json
from argparse import Namespace
from dataclasses import replace

import baselines
import benchmarks_path  # noqa: F401
import measure
import pytest
import torch
import whole_views
from masks import overlaps
from reference.ball import BallCapture, ring

from viewmend.scenes.studio_scenes import StudioScene
from viewmend.studio.stage import StudioConfig


def test_the_device_that_is_timed_is_waited_for_and_named(monkeypatch):
    asked = []
    monkeypatch.setattr(torch.cuda, "synchronize", asked.append)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: f"the GPU of {device}")
    measure.timed(lambda: None, runs=1, warm_up=0, device="cuda:1")
    assert asked == ["cuda:1", "cuda:1"]
    assert measure.machine("cuda:1")["device"] == "the GPU of cuda:1"
    measure.synchronise("cpu")
    assert len(asked) == 2


def test_empty_masks_and_absent_cameras_have_no_overlap():
    frame = BallCapture(ring(4)).read(0)
    empty = frame.mask.clone()
    empty[1:3] = 0
    found = replace(frame, mask=empty)
    right = replace(frame, mask=torch.where(torch.arange(4)[:, None, None] == 1, 0, frame.mask).byte())
    assert overlaps(found, right.without(["c3"])) == {"c0": 1.0, "c2": 0.0}


def test_results_of_another_config_of_the_same_day_are_kept(tmp_path, monkeypatch):
    monkeypatch.setattr(measure, "RESULTS", tmp_path / "results")
    first = measure.write("views", "cpu", {"sets": ("P",)}, 1)
    second = measure.write("views", "cpu", {"sets": ("Q",)}, 2)
    assert first != second == measure.write("views", "cpu", {"sets": ("Q",)}, 3)
    assert [json.loads(path.read_text())["results"] for path in (first, second)] == [1, 3]


def test_parts_of_the_frame_rates_are_merged_with_their_own_settings(tmp_path, monkeypatch):
    monkeypatch.setattr(measure, "RESULTS", tmp_path)

    def measured(size, options, done):
        done({"methods": options.framings})
        return {"fps_of_ours_over": {}}

    monkeypatch.setattr(baselines, "measure", measured)
    for part in ("--framings win", "--framings mul", "--framings mul --precision bfloat16"):
        command = f"baselines.py --sizes 8x8 --networks dstt --write {part}"
        monkeypatch.setattr("sys.argv", command.split())
        baselines.main()
    (file,) = tmp_path.iterdir()
    found = json.loads(file.read_text())["results"].values()
    assert [(*one["methods"], one["precision"]["ours"]) for one in found] == [
        ("win", "float32"),
        ("mul", "float32"),
        ("mul", "bfloat16"),
    ]
    assert all("commit" in one and "threads" in one for one in found)


@pytest.mark.parametrize("proxy", ["depth", "splats"])
def test_models_behind_depth_maps_have_their_own_error_rule_and_fraction(proxy, monkeypatch):
    monkeypatch.setattr(whole_views, "POINTS", 4000)
    config = StudioConfig(seed=1, cameras=5, frames=1, size_px=96)
    scene = StudioScene(name="s", set="P", rig="ring of 5", style="calm", config=config, held="cam02")
    options = Namespace(
        models=["telea", "views", "views@0.15"],
        proxy=proxy,
        background="black",
        grow_masks=0,
        no_tighten_masks=True,
    )
    first, again = (
        {model: made.view for model, made, _ in whole_views.completed_views(scene, options, 0)}
        for _ in range(2)
    )
    telea, views, restricted = first.values()
    assert bool(telea.holes.any()) and torch.equal(telea.error > 0, telea.holes)
    covered = int((views.mask > 0).sum())
    assert int((views.error > 0).sum()) >= covered
    assert int(restricted.refine_mask.sum()) <= max(0.15 * covered, int(restricted.holes.sum())) < covered
    assert all(torch.equal(first[model].depth, again[model].depth) for model in first), "the same splats"
