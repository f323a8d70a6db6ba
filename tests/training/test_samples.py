"""Samples come from the production pipeline, do not depend on the held-out camera, and follow from numbers."""

import shutil
import tarfile
from dataclasses import replace
from pathlib import Path
from random import Random

import pytest
import torch
from reference.shared_scenes import TAKES
from training.conftest import SAMPLING, SCENES, studio_samples

from viewmend.data.prepare import prepare
from viewmend.data.source import limit_size
from viewmend.evaluation.scores import true_view
from viewmend.geometry.hull import HullConfig
from viewmend.models.classical import Unfilled
from viewmend.rendering.view import RenderConfig
from viewmend.scenes.capture_scenes import make_splits, read_splits, splits_json
from viewmend.scenes.held_out import LeaveOneOut
from viewmend.scenes.studio_scenes import P_SEEDS, Q_SEEDS, StudioScene
from viewmend.stream import Stream
from viewmend.studio.stage import Studio, StudioConfig
from viewmend.training import scenes as scenes_module
from viewmend.training.config import SceneConfig
from viewmend.training.held_back import HeldBack
from viewmend.training.replay import SampleReplay, samples_in_order
from viewmend.training.samples import HeldOutCamera, Sample, rig_samples
from viewmend.training.scenes import (
    HARD_CALIBRATION,
    HARD_MASKS,
    CaptureRigs,
    MixedRigs,
    SampleScenes,
    Scene,
    StudioRigs,
    random_studio,
    rig_source,
    sample_scenes,
)
from viewmend.training.shards import (
    ShardError,
    ShardScenes,
    read_shard,
    sample_from_bytes,
    sample_to_bytes,
    write_shards,
)


@pytest.fixture(scope="module")
def studio() -> Studio:
    return Studio(StudioConfig(seed=3, cameras=5, frames=2, size_px=96))


def same(a, b):
    return sample_to_bytes(a) == sample_to_bytes(b)


def capture_samples(capture, **changes):
    """Samples of one capture."""
    scenes = replace(SCENES, **changes)
    return SampleScenes(CaptureRigs([(capture, None)], scenes, (0, 1), "0"), scenes, SAMPLING)


def test_the_last_frame_with_enough_history_is_a_target(studio):
    rig, scenes = (
        LeaveOneOut({time: studio.read(time) for time in (0, 1)}),
        replace(SCENES, num_holdout_views=1),
    )
    samples = rig_samples(rig, scenes, replace(SAMPLING, min_history=1, min_hole_px=0), Random(0))
    assert samples and {sample.view.time for sample in samples} == {1}
    with pytest.raises(ValueError, match="with 2 frames before"):
        rig_samples(rig, scenes, replace(SAMPLING, min_history=2), Random(0))


def test_a_sample_does_not_depend_on_the_image_of_the_held_out_camera(studio):
    held = studio.cameras.names[2]
    frame = studio.read(1)
    changed = replace(frame, rgb=frame.rgb.clone(), mask=frame.mask.clone())
    changed.rgb[2] = 255
    changed.mask[2] = 255
    first, second = (
        HeldOutCamera(LeaveOneOut({1: f}), held, HullConfig(resolution=48)).sample(
            1, (1,), RenderConfig(), SAMPLING
        )
        for f in (frame, changed)
    )
    assert first is not None and second is not None
    assert torch.equal(first.view.rgb, second.view.rgb) and torch.equal(first.view.error, second.view.error)
    assert held not in first.view.source_views
    assert all(held not in views.frame.cameras.names for views in first.context)


def test_training_views_equal_evaluated_views():
    config = StudioConfig(seed=3, cameras=5, frames=2, size_px=96, background="stage")
    scene = StudioScene(name="s", set="A", rig="", style="", config=config, held="cam02")
    studio = scene.studio()
    rig = LeaveOneOut(
        {time: studio.read(time) for time in range(2)},
        true_view=lambda held, time: studio.truth(studio.true_cameras.select([held]), time),
    )
    camera, stream = HeldOutCamera(rig, scene.held, HullConfig()), Stream(Unfilled())
    for frame in scene.frames():
        cached, time = stream.add_frame(frame.inputs), frame.inputs.time
        sample = camera.sample(time, (time,), RenderConfig(), replace(SAMPLING, num_ray_views=4))
        assert sample is not None and sample.truth.any()
        view, near = stream.render(frame.truth.cameras), cached.context(sample.view.candidate_views)
        truth = (255 * true_view(frame.truth).rgb).round().to(torch.uint8)
        assert same(sample, Sample(view, sample.context, near, truth, alpha=frame.truth.mask[0]))
        assert len(near.depth) == 4


def test_the_truth_is_on_black_and_the_context_is_in_the_past():
    samples = studio_samples().scene(0)
    assert samples
    for sample in samples:
        times = [views.frame.time for views in sample.context]
        assert times[0] == sample.view.time and times == sorted(times, reverse=True)
        assert float(sample.view.error.sum()) >= SAMPLING.min_hole_px
        assert not sample.truth[:, 0].any(), "the top row is background"


@pytest.mark.slow
def test_some_scenes_have_the_last_frame_only():
    sampling = replace(SAMPLING, frames=(0, 3), min_history=1, window_fraction=0.5)
    scenes, whole = (sample_scenes(SCENES, replace(sampling, window_fraction=f), "w") for f in (0.5, 1.0))
    times = [{v.frame.time for s in scenes.scene(n) for v in s.context} for n in range(6)]
    assert {3} in times and {0, 3} in times and all(found in ({3}, {0, 3}, set()) for found in times)
    short = times.index({3})
    [single, *_], [full, *_] = scenes.scene(short), whole.scene(short)
    assert len(single.context) == 1 and len(full.context) == 2
    assert torch.equal(single.context[0].frame.rgb, full.context[0].frame.rgb)


def test_a_clip_is_one_camera_at_consecutive_frames():
    samples = studio_samples(clip_length=2).scene(0)
    assert samples
    for sample in samples:
        before, now = sample.clip
        assert before.view.time == now.view.time - 1 and before.view.camera.names == now.view.camera.names
    with pytest.raises(ValueError, match="expected clips of 3 consecutive frames"):
        studio_samples(clip_length=3).scene(0)


def test_no_studio_uses_a_seed_reserved_for_validation_or_tests():
    random = Random(1)
    seeds, validation = (
        {random_studio(SCENES, 1, random, split).seed for _ in range(60)}
        for split in ("training", "validation")
    )
    assert seeds < {*range(9000)} and len(seeds) > 50
    assert validation < {*range(9000, 10000)}
    assert all(seeds.start >= 10000 and seeds.step > 0 for seeds in (P_SEEDS, Q_SEEDS))


def test_hard_scenes_have_larger_errors_of_calibration_and_masks():
    usual = SceneConfig(imperfect_fraction=1.0)
    factors = {
        "calibration_px": HARD_CALIBRATION,
        "calibration_m": HARD_CALIBRATION,
        "mask_edge_px": HARD_MASKS,
    }
    for seed in range(10):
        errors = random_studio(usual, 2, Random(seed)).imperfections
        hard_errors = random_studio(replace(usual, hard_fraction=1.0), 2, Random(seed)).imperfections
        for name, largest in factors.items():
            assert 1 <= getattr(hard_errors, name) / getattr(errors, name) <= largest


def test_training_refuses_test_data(tmp_path):
    with pytest.raises(ValueError, match="training or validation, got test"):
        StudioRigs(SCENES, (0,), "0", "test")
    other, test = tmp_path / "train", tmp_path / "test"
    for performers, motions in ((test, other), (other, test), (test / "ann.glb", other)):
        with pytest.raises(ValueError, match="got a folder named 'test'"):
            rig_source(replace(SCENES, performers=performers, motions=motions), (0,), "0")
    for split in ("training", "validation"):
        with pytest.raises(ValueError, match="got a folder named 'test'"):
            rig_source(replace(SCENES, captures=(test / "wd",)), (0,), "0", split)
    assert isinstance(rig_source(replace(SCENES, performers=other, motions=other), (0,), "0"), StudioRigs)


@pytest.mark.slow
def test_samples_depend_neither_on_workers_nor_on_where_a_stream_resumes():
    source = studio_samples("7")
    alone, helped = (samples_in_order(source, 0, workers) for workers in (0, 2))
    first = [next(alone) for _ in range(3)]
    for (scene, number, sample), (other_scene, other_number, other) in zip(first, helped, strict=False):
        assert (scene, number) == (other_scene, other_number) and same(sample, other)
        assert not other.truth.is_shared(), "containers have little shared memory"
    helped.close()
    stream = SampleReplay(source, "7", new_per_batch=1, replay_size=3, workers=0)
    batches = [stream.batch(step, 2) for step in range(4)]
    assert [len(batch) for batch in batches] == [1, 2, 2, 2] and stream.position.sample == 1, "within a scene"
    again = SampleReplay(source, "7", new_per_batch=1, replay_size=3, workers=0, start=stream.position)
    for one, other in zip(stream.batch(4, 2), again.batch(4, 2), strict=True):
        assert same(one, other)
    assert stream.position == again.position


class Counted:
    """A source of empty scenes or rigs that records what is requested."""

    def __init__(self):
        self.requested = []

    def scene(self, number):
        return []

    def rig(self, number):
        self.requested.append(number)
        return Scene(LeaveOneOut({}), Random(number))


def test_scenes_without_holes_are_an_error():
    with pytest.raises(ValueError, match="got none in 100 scenes"):
        SampleReplay(Counted(), "0", 1, 3, 0).batch(0, 1)


def test_a_mix_has_the_requested_fractions():
    real, studio = Counted(), Counted()
    mix = MixedRigs(real, studio, 0.75, "0")
    for number in (*range(400), *range(400)):
        mix.rig(number)
    assert 0.68 < len(real.requested) / 800 < 0.82
    assert real.requested[: len(real.requested) // 2] == real.requested[len(real.requested) // 2 :]
    assert {*real.requested, *studio.requested} == {*range(400)} and not {*real.requested} & {
        *studio.requested
    }


def test_samples_are_stored_losslessly_and_damage_is_detected(tmp_path):
    samples = studio_samples(clip_length=2).scene(0)
    assert all(same(sample_from_bytes(sample_to_bytes(s)), s) for s in samples)
    paths = list(write_shards(samples, tmp_path, shard_size=1))
    assert [path.name for path in paths] == [f"shard-{n:05d}.tar" for n in range(len(samples))]
    scenes = ShardScenes(tmp_path, "0", Sample)
    drawn = [scenes.scene(number)[0] for number in range(len(samples))]
    assert {sample_to_bytes(s) for s in drawn} == {sample_to_bytes(s) for s in samples}
    with pytest.raises(ShardError, match="expected clips of 3 frames, got 2"):
        ShardScenes(tmp_path, "0", Sample, clip_length=3).scene(0)
    paths[0].write_bytes(paths[0].read_bytes()[:3000])
    with pytest.raises(ShardError, match=r"shard-00000\.tar: expected a tar of samples"):
        read_shard(paths[0])
    with tarfile.open(tmp_path / "other.tar", "w") as tar:
        tar.add(__file__, "notes.txt")
    with pytest.raises(ShardError, match=r"other\.tar: expected a tar of samples"):
        read_shard(tmp_path / "other.tar")
    with pytest.raises(ShardError, match="expected tar files, found none"):
        ShardScenes(tmp_path / "nowhere", "0", Sample)


def test_the_truth_of_a_capture_is_the_image_of_the_held_out_camera(studio):
    scenes = capture_samples(studio, sizes_px=(64,))
    samples = scenes.scene(0)
    assert samples and all(same(a, b) for a, b in zip(samples, scenes.scene(0), strict=True))
    for sample in samples:
        held = sample.view.camera.names[0]
        assert max(sample.truth.shape) == 64 and held not in sample.view.source_views
        image = limit_size(studio.read(sample.view.time), 64).select([held])
        expected = (image.rgb[0].float() * (image.mask[0].float() / 255)).round().to(torch.uint8)
        assert torch.equal(sample.truth, expected)


def test_a_capture_is_aligned_once_without_the_camera_that_is_held_back(monkeypatch):
    class Shifted(Studio):
        """States wrong principal points."""

        def __init__(self, config):
            super().__init__(config)
            self.cameras = self.cameras.moved(0.7, 0.0)

        def read(self, time):
            return replace(super().read(time), cameras=self.cameras)

    capture = Shifted(StudioConfig(seed=3, cameras=6, frames=2, size_px=96))
    back = capture.cameras.names[2]
    used = []

    def record(source, inputs, **options):
        used.append(list(inputs))
        return prepare(source, inputs, **options)

    monkeypatch.setattr(scenes_module, "prepare", record)
    rigs = CaptureRigs([(capture, None)], SCENES, (0, 1), "0", [HeldBack(back, 2)])
    made = SampleScenes(rigs, SCENES, SAMPLING)
    samples = made.scene(0) + made.scene(1)
    others = [name for name in capture.cameras.names if name != back]
    assert samples and used == [others]
    expected = prepare(capture, others).cameras
    for sample in samples:
        held = sample.view.camera.names[0]
        assert held != back
        assert torch.equal(sample.view.camera.K, expected.select([held]).K)
        near = sample.context[0].frame.cameras
        assert torch.equal(near.K, expected.select(near.names).K)
    assert not torch.equal(expected.K, capture.cameras.K), "there is a shift to correct"


def test_hulls_have_the_configured_resolution():
    coarse, fine = (studio_samples(scenes=replace(SCENES, hull_resolution=n)).scene(0) for n in (12, 48))
    assert len(coarse) == len(fine) > 0
    covered = [sum(int((sample.view.mask > 0).sum()) for sample in samples) for samples in (coarse, fine)]
    assert covered[0] < 0.5 * covered[1], "large voxels lose thin parts"


@pytest.fixture
def splits(takes, tmp_path) -> Path:
    captures = [shutil.copytree(takes / name, tmp_path / name) for name in TAKES]
    file = tmp_path / "splits.json"
    file.write_text(splits_json(make_splits(captures, tmp_path)))
    return file


@pytest.mark.slow
def test_of_a_splits_file_only_the_training_captures_are_used(splits):
    training = {
        scene.name: scene.left_out for scene in read_splits(splits).scenes if scene.split == "training"
    }
    config = replace(SCENES, sizes_px=(64,), captures=(splits,), captures_fraction=1.0)
    rigs = rig_source(config, (0, 1), "0")
    assert [capture.name for capture, _ in rigs.first.captures] == list(training)
    samples = SampleScenes(rigs, config, SAMPLING)
    held = {sample.view.camera.names[0] for number in range(4) for sample in samples.scene(number)}
    assert held and held <= set(training.values())
    for one, other in (("ada", "bea"), ("bea", "cleo")):
        shutil.copy(splits.parent / other / "cameras.json", splits.parent / one)
    with pytest.raises(ValueError, match="take that version of the data"):
        rig_source(config, (0,), "0")
