"""The sets are fixed, and true motion is true."""

import hashlib
from dataclasses import replace

import pytest
import torch
from reference.ball import ring

from viewmend.data.errors import CaptureError
from viewmend.metrics.image_quality import warp_error
from viewmend.scenes.capture_scenes import capture_set, evenly_around
from viewmend.scenes.studio_scenes import RIG_TIMES, StudioScene, performer_set, procedural_set, rig_set
from viewmend.studio.stage import StudioConfig

P_SHA256 = "98fb42fd06fe55d11f1155fecbfd5175f729136f2808b09f00f36f65849f625e"
Q_SHA256 = "843bf079a02642c3d8aaa83c35404709f0d6207d523a149b583f3aaeee045103"
"""Of all that makes their scenes. Do not change these: figures of old reports stand on them."""


def sha256(scenes) -> str:
    facts = [
        (
            s.name,
            s.rig,
            s.style,
            s.held,
            s.tempo,
            s.config.seed,
            s.config.cameras,
            s.config.frames,
            s.config.size_px,
        )
        for s in scenes
    ]
    return hashlib.sha256(repr(facts).encode()).hexdigest()


def test_set_p_is_what_it_always_was():
    assert sha256(procedural_set()) == P_SHA256


def test_set_q_is_what_it_always_was(shared):
    assert sha256(performer_set(shared / "performers")) == Q_SHA256


def test_a_stage_behind_p_changes_the_images_and_neither_people_nor_rig():
    plain, staged = (procedural_set(1, 64, background)[0] for background in ("black", "stage"))
    assert (staged.name, staged.set, staged.held) == ("P-stage-10000", "P-stage", plain.held)
    black, behind = (next(scene.frames()).inputs for scene in (plain, staged))
    assert torch.equal(black.mask, behind.mask)
    outside = (black.mask == 0)[:, None].expand_as(black.rgb)
    assert not black.rgb[outside].any() and float(behind.rgb[outside].float().mean()) > 20


def test_definitions_tell_scenes_apart_and_know_no_paths(tmp_path):
    definitions = {s.definition for s in (*procedural_set(frames=2), *procedural_set(frames=3))}
    assert len(definitions) == 60
    for name in ("b.glb", "a.glb", "m.bvh"):
        (tmp_path / name).write_text(name)
    scenes = performer_set(tmp_path)
    assert [s.name for s in scenes] == ["Q-a-m-12", "Q-a-m-8", "Q-b-m-12", "Q-b-m-8"]
    assert not any(str(tmp_path) in s.definition for s in scenes)
    (tmp_path / "a.glb").write_text("changed")
    changed = [s.definition != t.definition for s, t in zip(scenes, performer_set(tmp_path), strict=True)]
    assert changed == [True, True, False, False]


def test_no_people_is_an_error_that_names_the_places(tmp_path):
    with pytest.raises(CaptureError, match=r"characters.*--performers"):
        performer_set(tmp_path)


def test_the_left_out_camera_is_none_of_the_inputs_and_true_motion_explains_the_truth():
    config = StudioConfig(seed=1, cameras=5, frames=2, size_px=96)
    scene = StudioScene(name="s", set="A", rig="", style="", config=config, held="cam02", tempo="calm")
    first, second = scene.frames()
    for frame in (first, second):
        assert frame.truth.cameras.names == (scene.held,) and scene.held not in frame.inputs.cameras.names
        assert frame.inputs.depth is None, "methods may not see true geometry"
    assert first.backward_flow_px is None and second.backward_flow_px is not None
    mask = second.truth.mask[0] > 127
    seen = second.backward_flow_px.isfinite().all(-1)
    assert (seen & mask).sum() > 0.7 * mask.sum() and not (seen & ~mask).sum() > 0.05 * mask.sum()
    now, before = (f.truth.rgb[0].float() / 255 for f in (second, first))
    assert warp_error(now, before, second.backward_flow_px, mask) < 0.03


def test_cameras_without_colour_give_the_same_masks_and_visibility():
    config = StudioConfig(seed=1, cameras=7, rig="layers", frames=4, size_px=48, samples_per_side=2)
    dense = StudioScene(
        name="s", set="A", rig="", style="", config=config, held="cam02", tempo="dance", scored_from=3
    )
    sparse = replace(dense, coloured=5)
    assert dense.definition != sparse.definition
    for whole, part in zip(dense.frames(), sparse.frames(), strict=True):
        names = part.inputs.cameras.names
        assert (
            len(names) == (5 if part.inputs.time == 3 else 4)
            and sparse.held not in part.carving.cameras.names
        )
        assert {*names, *part.carving.cameras.names} == set(whole.inputs.cameras.names)
        assert torch.equal(part.inputs.rgb, whole.inputs.select(names).rgb)
        assert torch.equal(part.carving.mask, whole.inputs.select(part.carving.cameras.names).mask)
        assert torch.equal(part.truth.rgb, whole.truth.rgb)
    order = [part.seen.names.index(name) for name in whole.seen.names]
    assert torch.equal(part.seen.seen[0, order], whole.seen.seen[0])
    sources = list(names[:3])
    assert torch.equal(part.seen.origins(sources).others, whole.seen.origins(sources).others)


def test_the_rigs_of_the_paper_leave_one_camera_out_and_draw_only_the_window():
    for name, count in (("R48", 48), ("R34", 34)):
        scenes = rig_set(name)
        assert len(scenes) == len({s.definition for s in scenes}) == 30
        assert len(scenes[0].studio().cameras) == count
        assert len({s.held for s in scenes}) > 10 and scenes[0].times == RIG_TIMES == (
            0,
            10,
            20,
            27,
            28,
            29,
            30,
        )


def test_the_rigs_of_the_paper_use_the_people_whose_views_have_holes(shared, tmp_path):
    assert [len(rig_set(name, shared / "performers")) for name in ("R48", "R34")] == [44, 52]
    for name in ("a.glb", "m.bvh"):
        (tmp_path / name).write_text(name)
    assert [s.name for s in rig_set("R48", tmp_path)][30:] == ["R48-a-m"]


def test_cameras_are_taken_evenly_around():
    cameras = ring(8)
    assert evenly_around(cameras, 4) == ("c0", "c2", "c4", "c6")
    assert evenly_around(cameras.select(["c0", "c4", "c2", "c6"]), 2) == ("c0", "c4")


def test_a_real_capture_leaves_each_camera_out(shared):
    scenes = capture_set(shared / "captures/wd2", "8")
    assert len(scenes) == 20 and {len(s.inputs) for s in scenes} == {7, 8}
    assert all(s.held not in s.inputs for s in scenes)
    assert len({s.definition for s in scenes}) == 20


@pytest.mark.parametrize(("inputs", "frames"), [("2", None), ("x", None), ("99", None), ("all", 0)])
def test_numbers_that_are_none_are_refused(shared, inputs, frames):
    with pytest.raises(ValueError, match="expected --"):
        capture_set(shared / "captures/wd2", inputs, frames)
