"""A viewer's last view holds back what flickers, and nothing else."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from viewmend.models.base import State
from viewmend.models.views.steadying import LastView, steady, steadying_change
from viewmend.rendering.crop import Crop
from viewmend.types import CompletedView


def pattern(rng, height=96, width=128):
    """A textured subject on black, RGB and alpha."""
    noise = torch.rand(height, width, 3, generator=rng).numpy()
    texture = cv2.resize(cv2.GaussianBlur(noise, (0, 0), 3), (width, height))
    image = np.zeros((height, width, 4), np.float32)
    image[20:76, 30:98, :3] = (0.5 + 3 * (texture - 0.5)).clip(0, 1)[20:76, 30:98]
    image[20:76, 30:98, 3] = 1
    return image


def flickering(image, rng, amount=0.01):
    noise = amount * torch.randn(image.shape, generator=rng).numpy()
    return (image + noise * image[..., 3:]).clip(0, 1).astype(np.float32)


def test_flicker_is_held_back(rng):
    still = pattern(rng)
    before = flickering(still, rng)
    now = flickering(still, rng)
    after = now + steadying_change(now, before)
    assert np.abs(after - before).mean() < 0.75 * np.abs(now - before).mean()
    assert np.abs(after - still).mean() < 0.95 * np.abs(now - still).mean()


def test_the_last_view_follows_the_motion(rng):
    still = pattern(rng)
    before = flickering(np.roll(still, (3, -4), (0, 1)), rng)
    now = flickering(still, rng)
    after = now + steadying_change(now, before)
    assert np.abs(after - still).mean() < 0.95 * np.abs(now - still).mean()


def test_large_changes_stay(rng):
    before = pattern(rng)
    now = before.copy()
    now[40:60, 50:70] = [1.0, 0.0, 1.0, 1.0]
    change = steadying_change(now, before)
    assert float(np.abs(change[46:54, 56:64]).max()) < 0.05


@pytest.fixture
def completed(scene):
    stream, view, _ = scene
    return stream.mend(view).completed


DEPTH_M = 2.0


def later(completed, frames, crop=None):
    view = replace(completed.view, time=completed.view.time + frames)
    images = {"rgb": completed.rgb, "alpha": completed.alpha}
    if crop is not None:
        view = crop.of_view(view)
        images = {name: crop.of_image(image) for name, image in images.items()}
    return CompletedView(view, **images)


def brightened(completed):
    return replace(completed, rgb=(completed.rgb + 0.03 * completed.alpha).clamp(0, 1))


def test_only_predicted_pixels_of_later_views_change(completed):
    everywhere = torch.ones_like(completed.view.error, dtype=torch.bool)
    first, last = steady(completed, everywhere, State(), DEPTH_M)
    assert first is completed and last.time == completed.view.time
    left = everywhere.clone()
    left[:, 48:] = False
    brighter = brightened(later(completed, 1))
    after, _ = steady(brighter, left, last, DEPTH_M)
    changed = (after.rgb != brighter.rgb).any(0)
    assert bool(changed.any()) and not bool((changed & ~(left & (brighter.view.error > 0))).any())
    for frames in (0, -1, 30):
        kept, state = steady(brightened(later(completed, frames)), everywhere, last, DEPTH_M)
        assert torch.equal(kept.rgb, brighter.rgb)
        assert state.time == completed.view.time + frames


def test_a_view_of_another_side_is_not_used(completed):
    _, last = steady(completed, completed.view.error > 0, State(), DEPTH_M)
    camera = completed.view.camera
    turned = torch.eye(4)
    turned[:3, :3] = torch.from_numpy(cv2.Rodrigues(np.array([0.0, 0.3, 0.0]))[0]).float()
    assert last.precedes(camera, last.time + 1)
    other = replace(camera, camera_from_world=turned @ camera.camera_from_world)
    assert not last.precedes(other, last.time + 1)
    assert not last.precedes(camera.resized(48, 41), last.time + 1)


def test_a_view_from_elsewhere_in_the_same_direction_is_not_used(completed):
    _, last = steady(completed, completed.view.error > 0, State(), DEPTH_M)
    camera = completed.view.camera

    def moved(change):
        return replace(camera, camera_from_world=change @ camera.camera_from_world)

    for axis in (0, 1, 2):
        step = torch.eye(4)
        step[axis, 3] = 0.1 * DEPTH_M
        assert last.precedes(moved(step), last.time + 1)
        step[axis, 3] = 0.5 * DEPTH_M
        assert not last.precedes(moved(step), last.time + 1)
    roll = torch.eye(4)
    roll[:2, :2] = torch.tensor([[0.0, -1.0], [1.0, 0.0]])
    assert not last.precedes(moved(roll), last.time + 1)


def test_crops_of_views_are_aligned(completed):
    _, last = steady(completed, completed.view.error > 0, State(), DEPTH_M)
    part = later(completed, 1, Crop(8, 4, 80, 70))
    placed = last.placed_in(part.view.camera)
    expected = torch.cat([part.rgb, part.alpha[None]]).permute(1, 2, 0).numpy()
    assert np.abs(placed - expected).max() < 1e-5
    assert isinstance(last, LastView)
