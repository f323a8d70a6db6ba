"""Cameras of unlike colours are matched to one another; those that agree, and those left out, stay as they are."""

import shutil
from dataclasses import replace

import pytest
import torch

from viewmend.cli import main
from viewmend.data.checks.colours import OtherSubjectRule
from viewmend.data.colour_matching import (
    MIN_CAMERAS,
    SurfaceColours,
    SurfacePoints,
    best_agreement,
    match_colours,
)
from viewmend.data.native_writer import write_capture
from viewmend.data.prepare import prepare
from viewmend.data.source import CaptureWrapper
from viewmend.studio.stage import Studio, StudioConfig

CAMERAS = 8
PRECISION, WORST = 0.012, 0.04
"""Of a camera's gain in a channel, mean and worst; highlights and the hull alone are 0.009 and 0.018 of it."""


class Tinted(CaptureWrapper):
    """A studio whose cameras have gains of their own; the first shows grey if a test wants."""

    def __init__(self, source, strength=0.2, spoiled=False):
        self.source, self.spoiled = source, spoiled
        random = torch.Generator().manual_seed(3)
        gains = torch.exp(strength * torch.randn(len(source.cameras), 3, generator=random).clamp(-1.5, 1.5))
        self.gains = gains / gains.mean(0)

    def read(self, time):
        frame = self.source.read(time)
        rgb = (0.8 * frame.rgb * self.gains[..., None, None]).round().clamp(0, 255).to(torch.uint8)
        if self.spoiled:
            rgb[0] = rgb[0].float().mean(0, keepdim=True).to(torch.uint8)
        return replace(frame, rgb=rgb)


@pytest.fixture(scope="module")
def studio():
    return Studio(StudioConfig(seed=4, cameras=CAMERAS, frames=1, size_px=192))


@pytest.fixture(scope="module")
def clean(studio):
    """The capture as it is prepared from all cameras but the first."""
    return prepare(Tinted(studio), studio.cameras.names[1:], align=False)


def gains_left(match, tinted):
    """The gains of each camera for grey, after the match, beside the mean camera's."""
    grey = 0.3 * tinted.gains.max()
    values = torch.cat([grey * tinted.gains, torch.ones(CAMERAS, 1)], 1)
    left = torch.einsum("vck,vk->vc", match.maps, values) / grey
    return left / left.mean(0)


def test_known_gains_are_recovered(studio):
    tinted = Tinted(studio)
    match = match_colours(tinted.read(0), studio.bounds)
    assert match.helps and match.after < 0.5 * match.before
    off, given = ((gains - 1).abs() for gains in (gains_left(match, tinted), tinted.gains))
    assert given.mean() > 0.08 and off.mean() < PRECISION and off.max() < WORST
    assert torch.allclose(match.maps.mean(0), torch.eye(3, 4), atol=1e-4), "the mean camera stays"


def test_cameras_that_agree_stay_as_they_are(studio):
    assert not match_colours(studio.read(0), studio.bounds).helps
    prepared = prepare(studio, align=False)
    assert prepared.colours is None and torch.equal(prepared.read(0).rgb, studio.read(0).rgb)


def surface(monkeypatch, rgb):
    """Every camera sees these points."""
    seen = torch.ones(rgb.shape[:2], dtype=torch.bool)
    monkeypatch.setattr(SurfacePoints, "colours", lambda points, images: SurfaceColours(rgb, seen))


def test_what_is_clipped_is_no_measurement(studio, monkeypatch, rng):
    """A third of the surface is brighter than the sensors of half of the cameras can say."""
    gains = torch.linspace(0.9, 1.1, CAMERAS)[:, None, None].expand(-1, 1, 3)
    true = 0.3 + 0.4 * torch.rand(1, 1500, 3, generator=rng)
    true[:, ::3] = 0.98 + 0.1 * torch.rand(1, 500, 3, generator=rng)
    surface(monkeypatch, (gains * true).clamp(max=1))
    match = match_colours(studio.read(0), studio.bounds)
    left = match.maps @ torch.cat([0.5 * gains[:, 0], torch.ones(CAMERAS, 1)], 1)[..., None]
    assert match.helps and float((left / left.mean(0) - 1).abs().max()) < 0.002


def test_what_maps_bring_is_judged_where_they_were_not_fitted(studio, monkeypatch, rng):
    """Gains that are other ones from part to part: what three parts say makes the fourth worse."""
    gain = (
        torch.tensor([1.0, -1.0, 1.0, -1.0]).repeat_interleave(300)
        * torch.linspace(-0.05, 0.05, CAMERAS)[:, None]
    )
    surface(monkeypatch, (1 + gain[..., None]) * (0.3 + 0.4 * torch.rand(1, 1200, 3, generator=rng)))
    match = match_colours(studio.read(0), studio.bounds)
    assert match.after > 1.1 * match.before and not match.helps


def test_a_few_cameras_or_none_that_share_surface_are_left_alone(studio):
    frame = Tinted(studio).read(0)
    few = frame.select(frame.cameras.names[: MIN_CAMERAS - 1])
    assert match_colours(few, studio.bounds) is None
    assert match_colours(replace(frame, mask=None), studio.bounds) is None


@pytest.mark.parametrize("change", ["black", "grey", "dark"])
def test_one_camera_that_differs_does_not_change_the_others(studio, clean, change):
    """A black image is left out, a grey one stays as it is, and a dark one is matched to the others."""

    class Changed(CaptureWrapper):
        source = Tinted(studio)

        def read(self, time):
            frame, rgb = self.source.read(time), self.source.read(time).rgb.clone()
            grey = rgb[0].float().mean(0, keepdim=True).to(torch.uint8)
            rgb[0] = {"black": 0 * rgb[0], "grey": grey.expand(3, -1, -1), "dark": rgb[0] // 3}[change]
            return replace(frame, rgb=rgb)

    rest = studio.cameras.names[1:]
    clean = clean.read(0).select(rest)
    capture = prepare(Changed(), align=False)
    frame, raw = capture.read(0), Changed().read(0)
    inside = clean.mask[:, None].expand_as(clean.rgb) == 255
    difference = (frame.select(rest).rgb.float() - clean.rgb.float()).abs()[inside]
    assert difference.mean() < 1.5, "of 255; another camera's mask makes another hull"
    assert (studio.cameras.names[0] in frame.cameras.names) == (change != "black")
    if change == "grey":
        assert torch.equal(frame.rgb[0], raw.rgb[0])
    if change == "dark":
        own, others = frame.rgb[0][:, raw.mask[0] == 255].float().mean(), clean.rgb[inside].float().mean()
        assert 0.7 < own / others < 1.4, "a third before"


def test_a_camera_that_is_left_out_is_not_looked_at_and_stays(studio, clean):
    inputs = studio.cameras.names[1:]
    spoiled = prepare(Tinted(studio, spoiled=True), inputs, align=False)
    assert clean.colours is not None and torch.equal(clean.colours.maps, spoiled.colours.maps)
    raw, matched = Tinted(studio).read(0), clean.read(0)
    assert torch.equal(raw.rgb[0], matched.rgb[0]) and not torch.equal(raw.rgb[1:], matched.rgb[1:])
    assert torch.equal(raw.mask, matched.mask)
    assert torch.equal(prepare(Tinted(studio), inputs, align=False, match_colours=False).read(0).rgb, raw.rgb)


def test_mend_says_that_colours_are_matched(studio, tmp_path, capsys):
    write_capture(Tinted(studio), tmp_path / "take", images="png")
    take, out = str(tmp_path / "take"), str(tmp_path / "out")
    arguments = [
        "mend",
        take,
        "--leave-out",
        studio.cameras.names[0],
        "--model",
        "telea",
        "--no-align",
        "--out",
        out,
    ]
    assert main(arguments) == 0
    assert "matched the colours of 7 cameras" in capsys.readouterr().err
    shutil.rmtree(tmp_path / "out")
    assert main([*arguments, "--no-match-colours"]) == 0
    assert "matched" not in capsys.readouterr().err


@pytest.mark.parametrize(("step", "is_odd"), [(0.1, False), (0.3, True)])
def test_a_camera_is_judged_by_what_its_peer_differs_from_a_third_one(step, is_odd, rng):
    """Cameras 0 to 3 see one side alike; on the other, camera 4 sees what only 5 sees, which differs from 0 by 8 %."""
    seen = torch.zeros(6, 600, dtype=torch.bool)
    seen[:4, :200] = True
    seen[[0, 5], 200:400] = True
    seen[[4, 5], 400:] = True
    rgb = 0.3 + 0.3 * torch.rand(1, 600, 3, generator=rng).repeat(6, 1, 1)
    rgb[1:4] += 0.02
    rgb[5] += 0.08
    rgb[4] += 0.08 + step
    found = best_agreement(SurfaceColours(rgb, seen))
    assert torch.allclose(found.distance, torch.tensor([0.02, 0.0, 0.0, 0.0, step, 0.08]), atol=1e-4)
    assert torch.allclose(found.peer_distance, torch.tensor([0.0, 0.0, 0.0, 0.0, 0.08, 0.02]), atol=1e-4)
    assert OtherSubjectRule().applies(found).tolist() == [False] * 4 + [is_odd, False]
