"""Fills that agree with the last view's are averaged with them; what differs, moved or is old stays new."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import torch
from inpainting.plates import Rig, tiny, view

from viewmend.inpainting.temporal_accumulation import (
    SAME_COLOUR,
    SAME_PLACE,
    STALE,
    LastView,
    TemporalAccumulation,
    accumulate,
)
from viewmend.views import CompletedView


def completed(rng, time=5, spread=0.05) -> CompletedView:
    """A view on a sloping proxy, its holes filled with noise about grey."""
    incomplete = view(time)
    rows = torch.arange(incomplete.depth.shape[0])[:, None] / 2000
    incomplete = replace(incomplete, depth=(incomplete.depth + rows) * (incomplete.depth > 0))
    noise = 0.5 + spread * torch.randn(incomplete.rgb.shape, generator=rng)
    return CompletedView(incomplete, torch.where(incomplete.error > 0, noise, incomplete.rgb))


def moved(last: LastView, metres: float) -> LastView:
    """The last view, had its camera stood to the side."""
    pose = last.camera.camera_from_world.clone()
    pose[:, 0, 3] += metres
    return replace(last, camera=replace(last.camera, camera_from_world=pose))


def twin(now: CompletedView, last: LastView, weight: float) -> np.ndarray:
    """Pixel by pixel."""
    rgb, z, e = now.rgb.double().numpy().copy(), now.view.depth.double().numpy(), now.view.error.double().numpy()
    K, pose = (x[0].double().numpy() for x in (now.view.camera.K, now.view.camera.camera_from_world))
    K_last, pose_last = (x[0].double().numpy() for x in (last.camera.K, last.camera.camera_from_world))
    old, z_old = last.rgb.double().numpy(), last.depth.double().numpy()
    height, width = z.shape
    for row, column in zip(*np.nonzero((e > 0) & (z > 0)), strict=True):
        seen = np.linalg.inv(K) @ [column + 0.5, row + 0.5, 1] * z[row, column]
        world = np.linalg.inv(pose) @ [*seen, 1]
        there = (pose_last @ world)[:3]
        u, v, _ = K_last @ there / there[2]
        if not (0 <= u < width and 0 <= v < height):
            continue
        depth = z_old[int(v), int(u)]
        if depth == 0 or abs(depth - there[2]) >= SAME_PLACE * there[2]:
            continue
        x, y = np.clip(u - 0.5, 0, width - 1), np.clip(v - 0.5, 0, height - 1)
        left, top = int(min(x, width - 2)), int(min(y, height - 2))
        a, b = x - left, y - top
        corners = old[:, top : top + 2, left : left + 2]
        colour = np.einsum("cij,i,j->c", corners, [1 - b, b], [1 - a, a])
        difference = ((colour - rgb[:, row, column]) ** 2).mean() / SAME_COLOUR**2
        carried = weight * np.exp(-difference) * e[row, column]
        rgb[:, row, column] += carried * (colour - rgb[:, row, column])
    return rgb


def test_accumulation_equals_its_twin(rng):
    now, last = completed(rng), moved(LastView.of(completed(rng, time=4)), 0.013)
    steady = accumulate(now, last, 0.7)
    assert np.abs(steady.rgb.double().numpy() - twin(now, last, 0.7)).max() < 1e-4
    filled = now.view.error > 0
    assert 0.3 < float(((steady.rgb != now.rgb).any(0) & filled).sum() / filled.sum()) <= 1
    assert torch.equal(steady.rgb[:, ~filled], now.rgb[:, ~filled])


def test_what_differs_is_old_coarse_or_comes_later_stays_as_it_is(rng):
    now = completed(rng)
    last = LastView.of(completed(rng, time=4))
    other = replace(last, rgb=1 - last.rgb.round())
    assert torch.allclose(accumulate(now, other, 0.7).rgb, now.rgb, atol=1e-6), "another colour"
    away = replace(last, depth=1.1 * last.depth)
    height, width = last.depth.shape
    half = last.camera.resized(width // 2, height // 2)
    coarse = replace(last, camera=half, rgb=last.rgb[:, ::2, ::2], depth=last.depth[::2, ::2])
    for ignored in (None, replace(last, time=5 - STALE - 1), replace(last, time=6), away, coarse):
        assert torch.equal(accumulate(now, ignored, 0.7).rgb, now.rgb)
    assert torch.equal(accumulate(now, last, 0.0).rgb, now.rgb)


def test_a_stream_of_noise_becomes_calmer(rng):
    last, calm, noisy = None, [], []
    for time in range(4, 12):
        now = completed(rng, time)
        shown = accumulate(now, last, 0.7)
        last = LastView.of(shown)
        calm.append(shown.rgb)
        noisy.append(now.rgb)
    filled = now.view.error > 0
    change = [sum(float((b - a)[:, filled].abs().mean()) for a, b in pairwise(s[3:])) for s in (calm, noisy)]
    assert change[0] < 0.7 * change[1]


def test_steps_carry_the_last_view():
    net, rig = TemporalAccumulation(tiny(), 0.7), Rig()
    first, state = net.step(view(4), rig, net.initial_state())
    assert torch.equal(state.last.rgb, first.rgb)
    fresh, _ = net.step(view(5), rig, replace(state, last=None))
    second, after = net.step(view(5), rig, state)
    expected = accumulate(fresh, LastView.of(first), 0.7)
    assert not torch.equal(fresh.rgb, second.rgb)
    assert torch.allclose(second.rgb, expected.rgb, atol=1e-6)
    assert torch.equal(after.last.rgb, second.rgb)
