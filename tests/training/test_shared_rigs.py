"""Held-out cameras of a rig share its hull, and their samples are what a stream of all images gives."""

from dataclasses import replace
from random import Random

import pytest
import torch

from viewmend.geometry.hull import HullConfig
from viewmend.models.classical import Unfilled
from viewmend.stream import Stream, StreamConfig
from viewmend.studio.stage import Studio
from viewmend.training.config import SamplingConfig, SceneConfig
from viewmend.training.loop import memorised_gain
from viewmend.training.scenes import random_studio
from viewmend.training.shared_rigs import SharedRigScenes, WrongMasks, _SharedRig
from viewmend.types import MultiViewFrame, Silhouettes

SCENES = SceneConfig(
    sizes_px=(64,),
    cameras=(12, 12),
    rigs=("layers",),
    shared_hull=True,
    num_holdout_views=2,
    imperfect_fraction=1.0,
)
SAMPLING = SamplingConfig(
    frames=(0, 2),
    min_history=1,
    with_context=True,
    num_source_views=(3,),
    source_view_weights=(1,),
    min_hole_px=3,
)


def drawn(number: int) -> tuple[Studio, Random]:
    random = Random(f"0/{number}")
    return Studio(random_studio(SCENES, 3, random)), random


def test_masks_alone_are_those_of_the_images():
    studio, _ = drawn(0)
    names = studio.cameras.names[3:6]
    frame = studio.read(2)
    assert torch.equal(studio.silhouettes(2, names).mask, frame.select(names).mask)
    assert torch.equal(studio.read(2, names).rgb, frame.select(names).rgb), "errors belong to the camera"


@pytest.mark.parametrize("protocol", ["strict", "target-mask", "hull-with-target-mask"])
def test_samples_are_those_of_a_stream_of_all_images(protocol):
    studio, random = drawn(1)
    scenes = replace(SCENES, protocols=(protocol,))
    rig = _SharedRig(studio, scenes, SAMPLING, random)
    samples = rig.samples(SAMPLING.frames)
    assert samples
    for sample in samples:
        stream = Stream(
            Unfilled(), StreamConfig(hull=HullConfig(resolution=scenes.hull_resolution), memory_mb=None)
        )
        for time in SAMPLING.frames:
            frame: MultiViewFrame = studio.read(time)
            held = frame.select(rig.held)
            carving = Silhouettes(held.mask, held.cameras) if protocol == "hull-with-target-mask" else None
            stream.add_frame(frame.select(rig.others), carving=carving)
        view = stream.render(sample.view.camera, 2, target_mask=sample.view.target_mask)
        assert sample.view.source_views == view.source_views
        # The hull is carved by the same cameras in another order.
        assert float((sample.view.depth - view.depth).abs().max()) < 1e-4
        assert torch.allclose(sample.view.rgb, view.rgb, atol=1e-3)
        assert [seen.frame.time for seen in sample.context] == [2, 0]
        for seen in sample.context:
            true = stream.cached_frame(seen.frame.time).context(view.source_views)
            assert torch.equal(seen.frame.rgb, true.frame.rgb)


def test_scenes_follow_from_their_numbers_and_need_enough_holes():
    scenes = SharedRigScenes(SCENES, SAMPLING, "0")
    first, again = scenes.scene(1), SharedRigScenes(SCENES, SAMPLING, "0").scene(1)
    assert [s.view.camera.names for s in first] == [s.view.camera.names for s in again]
    assert all(torch.equal(a.truth, b.truth) for a, b in zip(first, again, strict=True))
    assert all(int((s.view.missing > 0).sum()) >= SAMPLING.min_hole_px for s in first)


def test_rigs_of_few_cameras_are_mixed_in_and_give_no_mask():
    config = replace(SCENES, few_cameras_fraction=1.0, protocols=("target-mask",))
    samples = SharedRigScenes(config, SAMPLING, "0").scene(1)
    assert samples
    assert all(sample.view.target_mask is None for sample in samples)
    given = SharedRigScenes(replace(config, few_cameras_fraction=0.0), SAMPLING, "0").scene(1)
    assert all(sample.view.target_mask is not None for sample in given)


def test_clips_and_test_people_are_refused():
    with pytest.raises(ValueError, match="clips"):
        SharedRigScenes(SCENES, replace(SAMPLING, clip_length=2), "0")
    with pytest.raises(ValueError, match="test"):
        SharedRigScenes(SCENES, SAMPLING, "0", "test")


def test_wrong_masks_are_larger_or_smaller():
    mask = torch.zeros(40, 40)
    mask[10:30, 10:30] = 1
    wrong = WrongMasks(1.0, 3)
    sizes = {int(wrong.apply(mask, Random(seed)).sum()) for seed in range(20)}
    assert sizes == {(20 + 2 * by) ** 2 for by in (-3, -2, -1, 1, 2, 3)}
    assert torch.equal(WrongMasks(0.0).apply(mask, Random(0)), mask)


def test_gains_on_seen_views_are_compared_with_those_on_new_views_of_the_same_people():
    first = {"holes": 9.0, "holes_alike": 10.0, "holes_seen": 12.0}
    assert memorised_gain({"holes": 9.0, "holes_alike": 11.0, "holes_seen": 13.5}, first) == 0.5
    assert memorised_gain({"holes": 11.0, "holes_alike": 11.0, "holes_seen": None}, first) is None
