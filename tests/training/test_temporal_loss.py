"""The temporal term: its twin, what it counts, and what it must not count."""

from dataclasses import replace

import pytest
import torch
from geometry.solids import camera_at
from reference.temporal_twin import temporal_twin

from viewmend.geometry.cameras import Cameras, pixel_centers, unproject
from viewmend.training.temporal_loss import TOLERANCE, temporal_change, temporal_loss
from viewmend.views import CompletedView, IncompleteView

NORMAL, PLANE_M = torch.tensor([0.2, -0.1, 1.0]), 2.2


def at(x: float = 0.0, width: int = 40, height: int = 34) -> Cameras:
    """A camera that looks at the plane, from x metres to the right."""
    pose = torch.eye(4)
    pose[0, 3] = -x
    K = torch.tensor([[40.0, 0, width / 2], [0, 42.0, height / 2], [0, 0, 1]])
    return Cameras(("novel",), K[None], pose[None], torch.tensor([[width, height]]))


def seen(camera: Cameras, holes: tuple[slice, slice] | None, pushed_m: float = 0.0) -> CompletedView:
    """A smoothly coloured, slanted plane within a border of background, `pushed_m` nearer than usual."""
    width, height = camera.max_size_px
    rays = unproject(pixel_centers(width, height).view(1, -1, 2), torch.ones(1, width * height), camera)[0]
    rays = rays - camera.centers
    depth = (PLANE_M - pushed_m - camera.centers @ NORMAL) / (rays @ NORMAL)
    points = camera.centers + depth[:, None] * rays
    rgb = torch.stack([0.5 + 0.3 * torch.sin(points[:, 0] + c) * torch.cos(points[:, 1]) for c in range(3)])
    mask = torch.zeros(height, width)
    mask[3:-3, 3:-3] = 1
    error = torch.zeros(height, width)
    if holes is not None:
        error[holes] = 1
    view = IncompleteView(
        camera=camera,
        rgb=torch.zeros(3, height, width),
        mask=mask,
        error=error,
        depth=depth.view(height, width) * mask,
        source_views=(),
        weights=torch.zeros(0, height, width),
        time=0,
    )
    return CompletedView(view, rgb.view(3, height, width) * mask)


HOLE = (slice(10, 20), slice(12, 25))


def random_pair(rng: torch.Generator) -> tuple[CompletedView, CompletedView]:
    """From two cameras, of two sizes, with noise for colour, soft E, ragged masks, and depth that partly disagrees."""
    pair = []
    for view in (seen(at(0.1), None), seen(at(-0.05, 36, 38), None)):
        shape = view.view.depth.shape
        ragged = (torch.rand(shape, generator=rng) > 0.05).float()
        jitter = 1 + 0.4 * TOLERANCE * torch.randn(shape, generator=rng)
        error = torch.rand(shape, generator=rng) * (torch.rand(shape, generator=rng) > 0.5)
        changed = replace(view.view, mask=view.view.mask * ragged, depth=view.view.depth * jitter, error=error)
        pair.append(CompletedView(changed, torch.rand(3, *shape, generator=rng)))
    return pair[0], pair[1]


@pytest.mark.parametrize("with_truth", [False, True])
def test_values_and_gradients_equal_the_twin(with_truth, rng):
    before, now = random_pair(rng)
    truth = (torch.rand(before.rgb.shape, generator=rng), torch.rand(now.rgb.shape, generator=rng))
    truth = truth if with_truth else None
    images = [before.rgb.requires_grad_(), now.rgb.requires_grad_()]
    ours, twin = temporal_change(before, now, truth), temporal_twin(before, now, TOLERANCE, truth)
    assert float(twin.detach()) > 0.1
    torch.testing.assert_close(ours.double(), twin, atol=1e-5, rtol=1e-5)
    for own, other in zip(torch.autograd.grad(ours, images), torch.autograd.grad(twin, images), strict=True):
        assert other.any()
        torch.testing.assert_close(own, other, atol=1e-6, rtol=1e-3)


def test_a_still_subject_seen_by_a_moving_camera_does_not_change():
    assert float(temporal_change(seen(at(0.1), HOLE), seen(at(), HOLE))) < 2e-4
    # The same pictures without the warp differ a hundred times as much.
    still = replace(seen(at(0.1), HOLE), view=seen(at(), HOLE).view)
    assert float(temporal_change(still, seen(at(), HOLE))) > 0.01


def test_flicker_counts_by_its_size_in_the_holes_of_either_time_alone():
    earlier, none = seen(at(), HOLE), seen(at(), None)
    flicker = earlier.view.error * 0.1 + (1 - earlier.view.error) * 0.4
    later = CompletedView(none.view, none.rgb + flicker)
    for before, now in ((earlier, later), (later, earlier)):
        assert float(temporal_change(before, now)) == pytest.approx(0.1, abs=1e-4)
    assert float(temporal_change(none, later)) == 0


def test_what_the_truth_does_too_costs_nothing_where_it_is_given():
    before, now = seen(at(), HOLE), seen(at(), HOLE)
    brighter = replace(now, rgb=now.rgb + 0.2)
    truth = (before.rgb, brighter.rgb)
    assert float(temporal_change(before, brighter, truth)) == 0
    assert float(temporal_change(before, now, truth)) == pytest.approx(0.2, abs=1e-5)


def test_a_surface_that_moved_in_depth_is_not_counted():
    now = seen(at(), HOLE)
    for pushed_m, counts in ((0.2 * TOLERANCE * PLANE_M, True), (3 * TOLERANCE * PLANE_M, False)):
        before = seen(at(), HOLE, pushed_m)
        before = replace(before, rgb=before.rgb + 0.3)
        assert (float(temporal_change(before, now)) > 0.1) is counts


def test_a_camera_that_stands_still_compares_single_pixels():
    before, now = seen(at(), HOLE), seen(at(), HOLE)
    # A checkerboard of depths: no pixel agrees with a neighbour, each with itself.
    rough = torch.ones_like(now.view.depth)
    rough[::2, ::2] = rough[1::2, 1::2] = 1.1
    before, now = (replace(v, view=replace(v.view, depth=v.view.depth * rough)) for v in (before, now))
    now = replace(now, rgb=now.rgb + 0.1 * torch.rand(now.rgb.shape, generator=torch.Generator().manual_seed(1)))
    expected = (now.rgb - before.rgb).abs().mean(0)[HOLE].mean()
    assert float(temporal_change(before, now)) == pytest.approx(float(expected), rel=1e-5)


def test_nothing_is_taken_from_beyond_a_mask():
    now = seen(at(), (slice(3, 31), slice(3, 37)))
    before = seen(at(0.03), None)
    outside = before.view.mask == 0
    bright = torch.where(outside, torch.ones(()), before.rgb)
    assert float(temporal_change(replace(before, rgb=bright), now)) == float(temporal_change(before, now))
    blind = replace(before, view=replace(before.view, mask=torch.zeros_like(before.view.mask)))
    assert float(temporal_change(blind, now)) == 0


@pytest.mark.parametrize("other", ["no hole", "elsewhere", "behind"])
def test_no_pixels_give_zero_and_a_zero_gradient(other):
    behind = camera_at((0.0, 0.0, 9.0), target=(0.0, 0.0, 20.0), width=40, height=34)
    earlier = {
        "no hole": seen(at(), None),
        "elsewhere": seen(at(50.0), HOLE),
        "behind": replace(seen(at(), HOLE), view=replace(seen(at(), HOLE).view, camera=behind)),
    }[other]
    before = replace(earlier, rgb=earlier.rgb.requires_grad_())
    now = seen(at(), None if other == "no hole" else HOLE)
    now = replace(now, rgb=(now.rgb + 0.1).requires_grad_())
    loss = temporal_change(before, now)
    loss.backward()
    assert float(loss.detach()) == 0
    for image in (before.rgb, now.rgb):
        assert image.grad is not None and not image.grad.any() and torch.isfinite(image.grad).all()


def test_a_batch_is_the_mean_of_its_pairs(rng):
    pair = random_pair(rng)
    empty = (seen(at(), None), seen(at(), None))
    batch = temporal_loss([pair[0], empty[0]], [pair[1], empty[1]])
    assert float(batch) == pytest.approx(float(temporal_change(*pair)) / 2)
    truths = [(torch.zeros_like(a.rgb), torch.zeros_like(b.rgb)) for a, b in (pair, empty)]
    assert torch.equal(temporal_loss([pair[0], empty[0]], [pair[1], empty[1]], truths), batch)
