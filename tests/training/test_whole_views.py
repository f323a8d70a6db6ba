"""Stored scenes give the samples that they were made of; windows are parts of their views."""

from dataclasses import replace
from random import Random

import pytest
import torch
from training.tiny_views import VIEW_MODEL, VIEW_PLAN, VIEW_RULE

from viewmend.geometry.cameras import project, unproject
from viewmend.inpainting.checkpoint import load_network, save_inpainter
from viewmend.inpainting.sweep.cells import nearest_depth, rim_depth
from viewmend.inpainting.sweep.sweep_net import SweepNet
from viewmend.leave_one_out.scenes import LeaveOneOut
from viewmend.stream import Stream, StreamConfig
from viewmend.studio.stage import Studio, StudioConfig
from viewmend.training.plan import WholeViewRecipe
from viewmend.training.sample_files import sample_from_bytes, sample_to_bytes
from viewmend.training.stored_scenes import store
from viewmend.training.whole_view_objective import _visible
from viewmend.training.whole_views import (
    WINDOW_PX,
    WholeView,
    random_part,
    random_window,
    recoloured,
    untrained,
)


@pytest.fixture(scope="module")
def studio():
    return Studio(StudioConfig(seed=3, cameras=6, frames=1, size_px=(160, 149)))


@pytest.fixture(scope="module")
def stored(studio):
    def truth(held, time):
        return studio.truth(studio.true_cameras.select([held]), time)

    rig = LeaveOneOut({0: studio.read(0)}, true_view=truth)
    return store(rig, 0, replace(VIEW_PLAN, held_cameras=6), Random(0))


@pytest.fixture(scope="module")
def whole(stored):
    return WholeView.of(stored.sample(0, VIEW_RULE, 4), SweepNet(VIEW_MODEL))


def test_a_stored_scene_is_the_rig_without_a_camera(studio, stored):
    frame = studio.read(0)
    assert sorted(view.name for view in stored.held) == sorted(frame.cameras.names)
    assert len(sample_to_bytes(stored)) < 0.3 * frame.rgb.numel() * len(stored.held)
    again = sample_from_bytes(sample_to_bytes(stored))
    for number in (0, 3):
        name = stored.held[number].name
        stream = Stream(SweepNet(VIEW_MODEL), StreamConfig(render=VIEW_RULE, memory_mb=None))
        stream.push(frame.without([name]), None)
        wanted = stream.render(frame.cameras.select([name]))
        sample = again.sample(number, VIEW_RULE, 4)
        view = sample.view
        assert name not in view.candidate_views and view.source_views == wanted.source_views
        # The hull is carved more coarsely, and its vertices are in steps.
        both = (view.mask > 0) & (wanted.mask > 0)
        assert float(both.sum() / ((view.mask > 0) | (wanted.mask > 0)).sum()) > 0.93
        assert float((view.rgb - wanted.rgb).abs()[:, both].median()) < 0.02
        true = studio.truth(studio.true_cameras.select([name]), 0)
        assert torch.equal(sample.alpha, true.mask[0])
        assert float((sample.depth - true.depth[0]).abs().max()) < 1e-4
        black = (true.rgb[0] * (true.mask[0] / 255)).round()
        assert float((sample.truth - black).abs().max()) <= 1
        seen = sample.ray_views.frame
        assert seen.cameras.names == view.closest_views(4)
        own = frame.select(seen.cameras.names)
        inside = own.mask > 0
        assert torch.equal(seen.mask, own.mask)
        assert torch.equal(seen.rgb.movedim(1, -1)[inside], own.rgb.movedim(1, -1)[inside])
        both = (seen.depth > 0) & (own.depth > 0)
        assert float((seen.depth - own.depth)[both].abs().median()) < 0.01, "of every second pixel"


def test_a_window_is_a_part_of_the_view_and_of_its_truth(whole):
    torch.manual_seed(1)
    cameras = set()
    for _ in range(30):
        window = random_window(whole)
        height, width = window.view.mask.shape
        assert height <= WINDOW_PX and width <= WINDOW_PX and int((window.view.mask > 0).sum()) > 0
        assert window.truth.shape[1:] == window.alpha.shape == window.depth.shape == (height, width)
        assert window.scale == whole.scale
        names = window.rig.views.frame.cameras.names
        assert names == whole.rig.views.frame.cameras.names[: len(names)] and len(window.rig.pyramids) == len(names)
        cameras.add(len(names))
        # The camera of the window sees the same points at the same places.
        at = torch.tensor([[[width / 2, height / 2]]])
        point = unproject(at, torch.tensor([[2.0]]), window.view.camera)[0]
        uv, _ = project(point, whole.view.camera)
        left, top = (uv[0, 0] - at[0, 0]).round().int().tolist()
        assert torch.equal(whole.truth[:, top : top + height, left : left + width], window.truth)
        assert torch.equal(whole.view.rgb[:, top : top + height, left : left + width], window.view.rgb)
    assert cameras == {3, 4}, "all four, or three of them"


def test_a_part_to_be_read_lies_in_the_subject(whole):
    torch.manual_seed(0)
    parts = [random_part(whole) for _ in range(40)]
    read = [part for part in parts if part is not None]
    assert 4 < len(read) < 24
    assert all(bool((rim_depth(whole.view.depth)[part] > 0).all()) for part in read)
    assert all(bool(part[whole.view.holes].all()) for part in read), "what is missing is always read"


def test_other_colours_are_those_of_cameras_view_and_truth_alike(stored):
    sample = stored.sample(0, VIEW_RULE, 4)
    other = recoloured(sample, Random(2))
    gains = []
    for before, after in (
        (sample.view.rgb, other.view.rgb),
        (sample.truth / 255, other.truth / 255),
        (sample.ray_views.frame.rgb[0] / 255, other.ray_views.frame.rgb[0] / 255),
    ):
        means, changed = before.mean((1, 2)).sort().values, after.mean((1, 2)).sort().values
        gains.append(changed / means)
    assert 0.55 < float(gains[0].mean()) < 1
    for gain in gains[1:]:
        torch.testing.assert_close(gain, gains[0], atol=0.02, rtol=0)


def test_who_sees_the_surface_is_known(whole, studio):
    """Points of the true surface project to about their own depth in a camera that sees them."""
    torch.manual_seed(0)
    net = SweepNet(VIEW_MODEL)
    with torch.no_grad():
        reading = net(whole.view, whole.rig, whole.scale)
    cells = tuple(reading.swept.cells.T)
    z = nearest_depth(whole.depth)[cells]
    seen = _visible(whole, reading, z)
    assert seen.shape == (len(z), 4) and 0.2 < float(seen[z > 0].float().mean()) < 0.95
    assert not bool(seen[z == 0].any())
    # The camera closest in angle sees most, and moving the surface away hides it.
    assert float(seen[:, 0].float().mean()) >= float(seen[:, 3].float().mean()) - 0.05
    behind = _visible(whole, reading, z + 0.3 * whole.scale.size_m)
    assert int(behind.sum()) < 0.3 * int(seen.sum())


def test_holes_are_guessed_by_the_reader_of_rays_of_another_model(stored, tmp_path):
    """Its weights come from the checkpoint that is named, are not trained, and fill the whole view, not its windows."""
    recipe = WholeViewRecipe(name="views", model=replace(VIEW_MODEL, num_views=8, coarse_fill="rays"), steps=1)
    net, small = untrained(replace(recipe, bfloat16=False)), load_network("small")
    assert torch.equal(net.coarse.choose.weight, small.coarse.choose.weight)
    assert not any(weight.requires_grad for weight in net.coarse.parameters())
    assert all(weight.requires_grad for name, weight in net.named_parameters() if not name.startswith("coarse."))
    sample = stored.sample(0, VIEW_RULE, 4)
    whole = WholeView.of(sample, net)
    holes = whole.view.holes
    assert int(holes.sum()) > 30 and torch.equal(whole.guess[:, ~holes], whole.view.rgb[:, ~holes])
    wanted = small.coarse([replace(whole.view, error=holes.float())], [sample.ray_views])[0]
    torch.testing.assert_close(whole.guess, wanted, atol=1e-5, rtol=0)
    torch.manual_seed(3)
    window = random_window(whole)
    height, width = window.guess.shape[1:]
    parts = whole.guess.unfold(1, height, 1).unfold(2, width, 1)
    assert bool((parts == window.guess[:, None, None]).all(-1).all(-1).all(0).any())
    save_inpainter(SweepNet(VIEW_MODEL), tmp_path, "")
    with pytest.raises(ValueError, match="with a RayBlendNet"):
        untrained(replace(recipe, coarse_from=str(tmp_path)))


def test_stored_hulls_are_as_fine_as_the_plan_says(studio):
    rig = LeaveOneOut({0: studio.read(0)})
    sizes = [
        sum(len(view.faces) for view in store(rig, 0, replace(VIEW_PLAN, hull_resolution=n), Random(0)).held)
        for n in (16, 48)
    ]
    assert 4 * sizes[0] < sizes[1]
