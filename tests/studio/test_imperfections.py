from dataclasses import replace

import pytest
import torch

from viewmend.geometry.cameras import Cameras, project
from viewmend.studio.imperfections import Imperfections, imperfect_cameras, imperfect_frame
from viewmend.studio.rigs import ring_rig
from viewmend.types import MultiViewFrame

SWITCHES = (
    "exposure_stops white_balance shot_noise read_noise spill jpeg_quality mask_edge_px mask_holes mask_blobs"
)
STRENGTHS = (0.3, 0.1, 0.05, 0.02, 0.5, 40, 2.0, 3.0, 3.0)


RADIUS = torch.hypot(torch.arange(64) - 25.0, torch.arange(48)[:, None] - 20.0)
"""How far pixels are from the middle of the disc, (48, 64)."""


@pytest.fixture
def frame(rng) -> MultiViewFrame:
    """A textured disc on black, in two cameras of different size."""
    ring = ring_rig(2, (64, 48))
    cameras = Cameras(ring.names, ring.K, ring.camera_from_world, torch.tensor([[64, 48], [50, 40]]))
    disc = (RADIUS < 15).to(torch.uint8)
    rgb = torch.randint(60, 200, (2, 3, 48, 64), generator=rng).to(torch.uint8) * disc
    return MultiViewFrame(cameras, rgb, disc.expand(2, -1, -1) * 255, 4, disc.expand(2, -1, -1) * 3.0)


def background(frame: MultiViewFrame) -> torch.Tensor:
    return torch.full(frame.rgb.shape, 0.3)


def test_all_off_changes_nothing(frame):
    out = imperfect_frame(frame, Imperfections(), 1, background(frame))
    assert torch.equal(out.rgb, frame.rgb) and torch.equal(out.mask, frame.mask)
    assert imperfect_cameras(frame.cameras, Imperfections(), 1) is frame.cameras


@pytest.mark.parametrize(("switch", "strength"), list(zip(SWITCHES.split(), STRENGTHS, strict=True)))
def test_each_switch_is_seeded_and_does_its_own(frame, switch, strength):
    wrong = replace(Imperfections(), **{switch: strength})
    a, b = (imperfect_frame(frame, wrong, 3, background(frame)) for _ in range(2))
    assert torch.equal(a.rgb, b.rgb) and torch.equal(a.mask, b.mask)
    of_mask = switch.startswith("mask")
    assert torch.equal(a.mask, frame.mask) != of_mask
    assert torch.equal(a.rgb, frame.rgb) == of_mask
    assert torch.equal(a.depth, frame.depth)
    assert int(a.rgb[1, :, 40:].sum()) == 0 and int(a.mask[1, :, 50:].sum()) == 0, "padding stays empty"
    if switch not in ("jpeg_quality", "spill"):
        other = imperfect_frame(frame, wrong, 4, background(frame))
        assert not (torch.equal(a.rgb, other.rgb) and torch.equal(a.mask, other.mask))


def test_every_hole_begins_in_the_subject(frame):
    """A hole next to it would change nothing: a small subject loses as many as a large one."""
    small = replace(frame, mask=torch.zeros_like(frame.mask))
    small.mask[:, 18:22, 23:27] = 255
    hit = [
        imperfect_frame(small, Imperfections(mask_holes=8.0), seed).mask[0].sum() < 16 * 255
        for seed in range(20)
    ]
    assert all(hit)


def test_hard_masks_are_cut_at_one_half(frame):
    soft = replace(frame, mask=(frame.mask.float() * torch.linspace(0, 1, 64)).to(torch.uint8))
    hard = imperfect_frame(soft, Imperfections(mask_hard=True), 2)
    assert torch.equal(hard.mask, (soft.mask > 127).to(torch.uint8) * 255) and torch.equal(hard.rgb, soft.rgb)


def test_mask_outlines_wander_by_about_what_they_say(frame):
    areas = []
    for seed in range(30):
        mask = imperfect_frame(frame, Imperfections(mask_edge_px=1.0), seed).mask[0]
        assert int(mask[RADIUS > 20].max()) == 0 and int(mask[RADIUS < 10].min()) == 255
        areas.append(float(mask.sum()) / 255)
    radii = (torch.tensor(areas) / torch.pi).sqrt()
    assert 0.4 < float(radii.std()) < 1.2 and abs(float(radii.mean()) - 15) < 0.5


def test_spill_stains_the_outline_alone(frame):
    out = imperfect_frame(frame, Imperfections(spill=0.8), 2, background(frame)).rgb
    changed = (out != frame.rgb).any(1)
    assert bool(changed[0][(RADIUS > 12) & (RADIUS < 14.5)].any())
    assert not bool(changed[0][RADIUS > 16].any())
    inner = (out[0].int() - frame.rgb[0].int()).abs()[:, RADIUS < 4]
    assert int(inner.max()) <= 1


def test_calibration_errors_are_as_large_as_they_say():
    cameras = ring_rig(60, (512, 512))
    wrong = imperfect_cameras(cameras, Imperfections(calibration_px=0.5), 9)
    points = torch.tensor([[0.0, 0.95, 0.0]])
    shift = project(points, wrong)[0] - project(points, cameras)[0]
    # Turns about the two image axes each move the point by a normal error; the third does not move the centre.
    assert float(shift.std()) == pytest.approx(0.5, rel=0.25)
    torch.testing.assert_close(wrong.centers, cameras.centers, atol=1e-4, rtol=0)
    moved = imperfect_cameras(cameras, Imperfections(calibration_m=0.01), 9)
    assert float((moved.centers - cameras.centers).std()) == pytest.approx(0.01, rel=0.2)
    again = imperfect_cameras(cameras, Imperfections(calibration_px=0.5), 9)
    assert torch.equal(wrong.camera_from_world, again.camera_from_world)
