"""The controller against simulated devices: it holds the budget, does not swing, and recovers."""

import random
from itertools import pairwise

import pytest

from viewmend.live.budget import FULL, LADDER, Budget, QualityLevel
from viewmend.live.protocol import FrameTimes


class Device:
    """What views take on some machine; its own cost model, unlike the controller's."""

    def __init__(self, shared=10.0, pixels=20.0, filling=200.0, context_share=0.6, noise=0.0, seed=0):
        self.shared, self.pixels, self.relative_cost, self.context_share = shared, pixels, filling, context_share
        self.noise, self.chance = noise, random.Random(seed)

    def frame(self, level: QualityLevel) -> FrameTimes:
        """Filling has a part that no picture size shrinks below a third; without context it is the first fill's."""
        size = 0.3 + 0.7 * level.scale**2
        context = 1 - self.context_share * (1 - level.context_times / 7) if level.context_times else 0.25
        by = 1 + self.noise * self.chance.uniform(-1, 1)
        encoding = 0.2 * self.relative_cost * by if level.context_times else 0.0
        filling = 0.8 * self.relative_cost * size * context * by
        rendering = self.pixels * level.scale**2 * by
        return FrameTimes(geometry=self.shared * by, context=encoding, rendering=rendering, inpainting=filling)


def run(budget: Budget, device: Device, frames: int) -> tuple[list[int], list[float]]:
    indices, taken = [], []
    for _ in range(frames):
        ms = device.frame(budget.level)
        indices.append(budget.index)
        taken.append(ms.total)
        budget.record(budget.level, ms)
    return indices, taken


def best(device: Device, target_ms: float) -> int:
    """The highest level that holds the target, by trying them all."""
    return max((n for n, level in enumerate(LADDER) if device.frame(level).total <= target_ms), default=0)


@pytest.mark.parametrize("filling", [5.0, 60.0, 150.0, 400.0])
@pytest.mark.parametrize("target_ms", [60.0, 100.0, 250.0])
@pytest.mark.parametrize("context_share", [0.1, 0.8])
def test_it_holds_the_budget_and_settles(filling, target_ms, context_share):
    device = Device(filling=filling, context_share=context_share)
    budget = Budget(target_ms)
    indices, taken = run(budget, device, 400)
    late = taken[100:]
    reachable = device.frame(LADDER[0]).total <= target_ms
    over = sum(ms > target_ms for ms in late) / len(late)
    assert over < 0.05 if reachable else max(indices[100:]) == 0
    changes = sum(a != b for a, b in pairwise(indices[200:]))
    assert changes <= 4, "swings"
    assert indices[-1] >= best(device, 0.6 * target_ms), "gives up more than it must"


def test_noise_does_not_make_it_swing():
    device = Device(filling=150, noise=0.25)
    budget = Budget(100.0)
    indices, taken = run(budget, device, 600)
    changes = sum(a != b for a, b in pairwise(indices[200:]))
    assert changes <= 16
    assert sum(taken[100:]) / len(taken[100:]) < 100


def test_a_device_that_slows_down_is_followed_at_once_and_recovery_is_found():
    fast, slow = Device(filling=50), Device(shared=20, pixels=60, filling=300)
    budget = Budget(100.0)
    run(budget, fast, 200)
    assert budget.level == FULL
    _, taken = run(budget, slow, 60)
    assert sum(ms > 100 for ms in taken) <= 8 and max(taken[8:]) <= 100
    run(budget, fast, 200)
    assert budget.level == FULL


def test_one_slow_frame_changes_nothing():
    budget, device = Budget(100.0), Device(filling=50)
    run(budget, device, 200)
    budget.record(budget.level, FrameTimes(geometry=900.0, rendering=30.0, inpainting=50.0))
    assert budget.level == FULL
    run(budget, device, 50)
    assert budget.level == FULL


def test_the_ladder_grows_in_work_and_its_top_is_all():
    work = [level.relative_cost for level in LADDER]
    assert work == sorted(work) and LADDER[-1] == QualityLevel(1.0, 7, None)
    assert Budget(100.0).predicted_ms(FULL) == 0


def test_impossible_budgets_are_refused():
    for target_ms in (0.0, -1.0, float("nan")):
        with pytest.raises(ValueError, match="expected a positive budget"):
            Budget(target_ms)
