"""A camera that stands a few centimetres beside where it says is found by the outlines of all."""

from dataclasses import replace

import pytest
import torch

from viewmend.capture.diagnosis import diagnose
from viewmend.capture.outline_check import odd_outline
from viewmend.studio.stage import Studio, StudioConfig


@pytest.fixture(scope="module")
def studio():
    return Studio(StudioConfig(seed=10002, cameras=8, frames=1, size_px=192))


def displaced(frame, name, step_m):
    """The frame with one camera's centre moved sideways."""
    view = frame.cameras.names.index(name)
    pose = frame.cameras.camera_from_world.clone()
    pose[view, :3, 3] += torch.tensor(step_m)
    return replace(frame, cameras=replace(frame.cameras, camera_from_world=pose))


@pytest.mark.parametrize("name", ["cam00", "cam03", "cam06"])
@pytest.mark.parametrize("step_m", [(0.06, 0.0, 0.0), (0.0, -0.05, 0.0), (-0.04, 0.04, 0.0)])
def test_a_displaced_camera_is_the_one_without_which_outlines_fit(studio, name, step_m):
    found = odd_outline(displaced(studio.read(0), name, step_m), studio.bounds)
    assert found is not None and found[0] == (name,) and found[1] > 4


def test_a_good_rig_has_no_odd_outline(studio):
    assert odd_outline(studio.read(0), studio.bounds) is None


@pytest.mark.parametrize("seed", [10022, 10030])
def test_what_pixels_alone_miss_is_nobodys_fault(seed):
    """In these one camera's outline stands out among small misses."""
    scene = Studio(StudioConfig(seed=seed, cameras=8, frames=1, size_px=192))
    assert odd_outline(scene.read(0), scene.bounds) is None


def test_what_moves_all_cameras_alike_names_none(studio):
    frame = studio.read(0)
    assert odd_outline(replace(frame, cameras=frame.cameras.moved(1.5, -1.0)), studio.bounds) is None


def test_four_cameras_cannot_tell(studio):
    frame = studio.read(0)
    few = displaced(frame, "cam00", (0.06, 0.0, 0.0)).select(frame.cameras.names[:7:2])
    assert len(few.cameras) == 4 and odd_outline(few, studio.bounds) is None


def test_frames_without_outlines_name_none(studio):
    frame = studio.read(0)
    for mask in (torch.zeros_like(frame.mask), torch.full_like(frame.mask, 255)):
        assert odd_outline(replace(frame, mask=mask), studio.bounds) is None
    assert odd_outline(replace(frame, mask=None), studio.bounds) is None


@pytest.mark.parametrize(("step_m", "words"), [(0.06, "alone takes"), (0.02, "outlines of all others fit together")])
def test_the_diagnosis_names_it_once(studio, step_m, words):
    """A large step is seen in the hull; a small one in the outlines alone."""
    said = [finding.text for finding in diagnose(displaced(studio.read(0), "cam03", (step_m, 0.0, 0.0)), studio.bounds)]
    assert len(said) == 1 and "'cam03'" in said[0] and words in said[0] and "its calibration" in said[0]


def rough(frame, px, seed):
    """The frame with all cameras' principal points wrong by a normal deviation of so many pixels."""
    K = frame.cameras.K.clone()
    K[:, :2, 2] += px * torch.randn(len(K), 2, generator=torch.Generator().manual_seed(seed))
    return replace(frame, cameras=replace(frame.cameras, K=K))


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("px", [0.5, 1.0])
def test_of_a_rig_that_never_fits_no_camera_is_named(studio, px, seed):
    assert odd_outline(rough(studio.read(0), px, seed), studio.bounds) is None


@pytest.mark.parametrize("seed, name", [(1, "cam00"), (2, "cam03")])
def test_a_displaced_camera_of_a_rig_that_never_fits_is_named(studio, seed, name):
    """More than half of what outlines miss is left without it, but clearly less than without any other."""
    found = odd_outline(displaced(rough(studio.read(0), 0.5, seed), name, (0.04, 0.0, 0.0)), studio.bounds)
    assert found is not None and name in found[0] and 1.5 < found[1] < 2
