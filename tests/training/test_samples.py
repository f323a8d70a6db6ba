"""Samples come from the production pipeline, know nothing of the camera that is left out, and follow from numbers."""

import tarfile
from dataclasses import replace
from pathlib import Path
from random import Random

import pytest
import torch

from viewmend.baselines.classical import Unfilled
from viewmend.capture.prepare import prepare
from viewmend.capture.reduction import reduced
from viewmend.evaluation.frame_scores import true_view
from viewmend.geometry.hull import HullConfig
from viewmend.leave_one_out.scenes import LeaveOneOut
from viewmend.leave_one_out.studio_scenes import P_SEEDS, Q_SEEDS, StudioScene
from viewmend.rendering.view import RenderConfig
from viewmend.stream import Stream
from viewmend.studio.stage import Studio, StudioConfig
from viewmend.training.capture_scenes import CaptureScenes, MixedScenes
from viewmend.training.replay import SampleReplay, samples_in_order
from viewmend.training.sample_files import (
    ShardError,
    ShardScenes,
    read_shard,
    sample_from_bytes,
    sample_to_bytes,
    write_shards,
)
from viewmend.training.samples import HeldOutCamera, Sample, widened
from viewmend.training.scenes import StudioScenes, random_stage, rig_samples
from viewmend.training.sources import scene_source


@pytest.fixture(scope="module")
def studio() -> Studio:
    return Studio(StudioConfig(seed=3, cameras=5, frames=2, size_px=96))


def same(a, b):
    return sample_to_bytes(a) == sample_to_bytes(b)


def test_the_last_of_just_enough_times_is_a_target(studio, plan):
    rig, plan = LeaveOneOut({time: studio.read(time) for time in (0, 1)}), replace(plan, times=(0, 1), held_cameras=1)
    samples = rig_samples(rig, replace(plan, least_past=1, min_hole_px=0), Random(0))
    assert samples and {sample.view.time for sample in samples} == {1}
    with pytest.raises(ValueError, match="more than 2 times"):
        rig_samples(rig, replace(plan, least_past=2), Random(0))


def test_a_sample_does_not_depend_on_what_the_camera_left_out_sees(studio):
    held = studio.cameras.names[2]
    frame = studio.read(1)
    vandalised = replace(frame, rgb=frame.rgb.clone(), mask=frame.mask.clone())
    vandalised.rgb[2] = 255
    vandalised.mask[2] = 255
    first, second = (
        HeldOutCamera(LeaveOneOut({1: f}), held, HullConfig(resolution=48)).sample(1, (1,), RenderConfig(), 0)
        for f in (frame, vandalised)
    )
    assert first is not None and second is not None
    assert torch.equal(first.view.rgb, second.view.rgb) and torch.equal(first.view.error, second.view.error)
    assert held not in first.view.source_views
    assert all(held not in views.frame.cameras.names for views in first.context)


def test_training_is_shown_what_evaluation_is():
    config = StudioConfig(seed=3, cameras=5, frames=2, size_px=96, background="stage")
    scene = StudioScene(name="s", set="A", rig="", style="", config=config, held="cam02")
    rig = LeaveOneOut({time: scene.studio().read(time) for time in range(2)})
    camera, stream = HeldOutCamera(rig, scene.held, HullConfig()), Stream(Unfilled())
    for frame in scene.frames("cpu"):
        observation, time = stream.push(frame.inputs), frame.inputs.time
        sample = camera.sample(time, (time,), RenderConfig(), 1, (0, 4))
        assert sample is not None and sample.truth.any()
        view, near = stream.render(frame.truth.cameras), observation.context(sample.view.candidate_views)
        truth = (255 * true_view(frame.truth, None).rgb).round().to(torch.uint8)
        assert (
            same(sample, Sample(view, sample.context, near, truth, alpha=frame.truth.mask[0])) and len(near.depth) == 4
        )


def test_truth_is_black_where_the_mask_is_and_context_is_past(plan):
    samples = StudioScenes(plan, "0").scene(0)
    assert samples
    for sample in samples:
        times = [views.frame.time for views in sample.context]
        assert times[0] == sample.view.time and times == sorted(times, reverse=True)
        assert float(sample.view.error.sum()) >= plan.min_hole_px
        assert not sample.truth[:, 0].any(), "the top row is background"


def test_a_clip_is_one_camera_at_consecutive_times(plan):
    samples = StudioScenes(replace(plan, clip_length=2), "0").scene(0)
    assert samples
    for sample in samples:
        before, now = sample.clip
        assert before.view.time == now.view.time - 1 and before.view.camera.names == now.view.camera.names
    with pytest.raises(ValueError, match="expected 3 consecutive times"):
        StudioScenes(replace(plan, clip_length=3), "0").scene(0)


def test_no_stage_takes_a_seed_that_is_kept_for_validation_or_tests(plan):
    random = Random(1)
    seeds = [random_stage(plan, random).seed for _ in range(300)]
    assert {*seeds} < {*range(9000)} and len(set(seeds)) > 250
    kept = [random_stage(plan, random, "validation").seed for _ in range(300)]
    assert {*kept} < {*range(9000, 10000)}
    assert all(min(scenes) >= 10000 for scenes in (P_SEEDS, Q_SEEDS))
    source = scene_source(replace(plan, shards=Path("any")), "validation", "validation")
    assert isinstance(source, StudioScenes) and source.split == "validation"


def test_training_refuses_what_is_kept_for_tests(plan, tmp_path):
    with pytest.raises(ValueError, match="got those for tests"):
        StudioScenes(plan, "0", "test")
    other, kept = tmp_path / "train", tmp_path / "test"
    for performers, motions in ((kept, other), (other, kept), (kept / "ann.glb", other)):
        with pytest.raises(ValueError, match="not kept for tests, got a folder named 'test'"):
            scene_source(replace(plan, performers=performers, motions=motions), "0")
    for split in ("training", "validation"):
        with pytest.raises(ValueError, match="not kept for tests"):
            scene_source(replace(plan, captures=(kept / "wd",)), "0", split)
    assert isinstance(scene_source(replace(plan, performers=other, motions=other), "0"), StudioScenes)


def test_a_staged_plan_has_a_stage_behind_everyone_and_differs_in_nothing_else(plan):
    plain, staged = (random_stage(replace(plan, staged=staged), Random(2)) for staged in (False, True))
    assert staged == replace(plain, background="stage") != plain


def test_rough_stages_are_only_more_wrong_than_imperfect_ones(plan):
    def stages(**changes):
        random = Random(3)
        return [random_stage(replace(plan, **changes), random).imperfections for _ in range(100)]

    assert {it.calibration_px for it in stages(imperfect_fraction=0.0, rough_fraction=1.0)} == {0.0}
    usual, rough = stages(imperfect_fraction=1.0), stages(imperfect_fraction=1.0, rough_fraction=1.0)
    assert max(it.calibration_px for it in usual) <= 1 < max(it.calibration_px for it in rough) <= 2.5
    assert max(it.mask_edge_px for it in usual) <= 1 < max(it.mask_edge_px for it in rough) <= 2


def test_samples_are_the_same_whoever_makes_them_and_wherever_one_begins(plan):
    source = StudioScenes(plan, "7")
    alone, helped = (samples_in_order(source, 0, workers) for workers in (0, 2))
    first = [next(alone) for _ in range(3)]
    for (scene, number, sample), (other_scene, other_number, other) in zip(first, helped, strict=False):
        assert (scene, number) == (other_scene, other_number) and same(sample, other)
    helped.close()
    feed = SampleReplay(source, "7", new_per_batch=1, replay_size=3, workers=0)
    batches = [feed.batch(step, 2) for step in range(4)]
    assert [len(batch) for batch in batches] == [1, 2, 2, 2] and feed.position.sample == 1, "in the middle of a scene"
    again = SampleReplay(source, "7", new_per_batch=1, replay_size=3, workers=0, start=feed.position)
    for one, other in zip(feed.batch(4, 2), again.batch(4, 2), strict=True):
        assert same(one, other)
    assert feed.position == again.position


def test_widened_holes_reach_so_far_and_stay_on_the_subject(plan):
    view = StudioScenes(plan, "0").scene(0)[0].view
    wider = widened(view, 2)
    missing = torch.nonzero(view.error > 0)
    for row, column in torch.nonzero(view.mask >= 0).tolist():
        reach = int((missing - torch.tensor([row, column])).abs().amax(1).min())
        widens = 0 < reach <= 2 and bool(view.mask[row, column] > 0)
        assert bool(wider.error[row, column] > 0) == (widens or reach == 0)
        if widens:
            assert not wider.rgb[:, row, column].any() and not wider.weights[:, row, column].any()
        elif reach:
            assert torch.equal(wider.rgb[:, row, column], view.rgb[:, row, column])
    assert int((wider.error > 0).sum()) > len(missing)
    assert torch.equal(widened(view, 0).error, view.error)


def test_dropped_cameras_are_missing_from_what_a_sample_sees(plan):
    plan = replace(plan, cameras=(8, 8), ray_views=8, targets_per_camera=2)
    whole, dropped = (StudioScenes(replace(plan, dropped_fraction=share), "0").scene(0) for share in (0.0, 1.0))
    assert whole and dropped
    assert {len(s.view.silhouettes.cameras) for s in whole} == {7}
    assert {len(s.view.silhouettes.cameras) for s in dropped} <= {5, 6, 7}
    assert min(len(s.view.silhouettes.cameras) for s in dropped) < 7


class Empty:
    def scene(self, number):
        return []


def test_scenes_without_holes_are_an_error_not_a_wait():
    with pytest.raises(ValueError, match="got none in 100 scenes"):
        SampleReplay(Empty(), "0", 1, 3, 0).batch(0, 1)


def test_samples_come_back_from_disk_bit_for_bit_and_damage_is_noticed(plan, tmp_path):
    samples = StudioScenes(replace(plan, clip_length=2), "0").scene(0)
    assert all(same(sample_from_bytes(sample_to_bytes(s)), s) for s in samples)
    paths = list(write_shards(samples, tmp_path, per_shard=1))
    assert [path.name for path in paths] == [f"shard-{n:05d}.tar" for n in range(len(samples))]
    scenes = ShardScenes(tmp_path, "0", (Sample,))
    drawn = [scenes.scene(number)[0] for number in range(len(samples))]
    assert {sample_to_bytes(s) for s in drawn} == {sample_to_bytes(s) for s in samples}
    paths[0].write_bytes(paths[0].read_bytes()[:3000])
    with pytest.raises(ShardError, match=r"shard-00000\.tar: expected a tar of samples"):
        read_shard(paths[0])
    with tarfile.open(tmp_path / "other.tar", "w") as tar:
        tar.add(__file__, "notes.txt")
    with pytest.raises(ShardError, match="expected a sample"):
        read_shard(tmp_path / "other.tar")
    with pytest.raises(ShardError, match="expected tar files, found none"):
        ShardScenes(tmp_path / "nowhere", "0", (Sample,))


def test_captures_are_scenes_whose_truth_is_the_camera_left_out(studio, plan):
    scenes = CaptureScenes([studio], replace(plan, sizes_px=(64,)), "0")
    samples = scenes.scene(0)
    assert samples and all(same(a, b) for a, b in zip(samples, scenes.scene(0), strict=True))
    for sample in samples:
        held = sample.view.camera.names[0]
        assert max(sample.truth.shape) == 64 and held not in sample.view.source_views
        seen = reduced(studio.read(sample.view.time), 64).select([held])
        expected = (seen.rgb[0].float() * (seen.mask[0].float() / 255)).round().to(torch.uint8)
        assert torch.equal(sample.truth, expected)


def test_a_capture_is_aligned_without_the_camera_that_is_left_out(plan):
    class Looked(Studio):
        """States principal points beside the true ones."""

        @property
        def cameras(self):
            return super().cameras.moved(0.7, 0.0)

        def read(self, time):
            return replace(super().read(time), cameras=self.cameras)

    capture = Looked(StudioConfig(seed=3, cameras=6, frames=2, size_px=96))
    samples = CaptureScenes([capture], replace(plan, sizes_px=(96,)), "0").scene(0)
    assert samples
    for sample in samples:
        held = sample.view.camera.names[0]
        expected = prepare(capture, [n for n in capture.cameras.names if n != held]).cameras
        assert torch.equal(sample.view.camera.K, expected.select([held]).K)
        near = sample.context[0].frame.cameras
        assert torch.equal(near.K, expected.select(near.names).K)
    assert not torch.equal(expected.K, capture.cameras.K), "there is a shift to undo"


def test_a_mix_takes_its_share_from_each(plan):
    class Counted(Empty):
        asked = ()

        def scene(self, number):
            self.asked = (*self.asked, number)
            return []

    real, studio = Counted(), Counted()
    mix = MixedScenes(real, studio, 0.75, "0")
    for number in (*range(400), *range(400)):
        mix.scene(number)
    assert 0.68 < len(real.asked) / 800 < 0.82
    assert real.asked[: len(real.asked) // 2] == real.asked[len(real.asked) // 2 :], "a number is always of one source"
    assert {*real.asked, *studio.asked} == {*range(400)} and not {*real.asked} & {*studio.asked}


def test_hulls_are_as_fine_as_the_plan_says(plan):
    coarse, fine = (StudioScenes(replace(plan, hull_resolution=n), "0").scene(0) for n in (12, 48))
    assert len(coarse) == len(fine) > 0
    covers = [[int((sample.view.mask > 0).sum()) for sample in samples] for samples in (coarse, fine)]
    assert sum(covers[0]) < 0.5 * sum(covers[1]), "large voxels lose what is thin"
    assert all(same(a, b) for a, b in zip(fine, StudioScenes(plan, "0").scene(0), strict=True))
