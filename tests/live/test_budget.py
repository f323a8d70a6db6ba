"""The controller against simulated devices: it holds the budget, does not swing, and recovers."""

import random
from itertools import pairwise

import pytest

from viewmend.baselines.classical import Telea
from viewmend.inpainting.sweep.config import SweepConfig
from viewmend.inpainting.sweep.sweep_net import SweepNet
from viewmend.live.budget import (
    CONTEXT_LADDER,
    FULL,
    MAX_UP_AFTER_FRAMES,
    MEMORY_FRAMES,
    READING_LADDER,
    Budget,
    QualityLevel,
    ladder_for,
)
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
        context *= 1.0 if level.read_fraction is None else 0.2 + 0.8 * level.read_fraction
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


def best(device: Device, target_ms: float, levels) -> int:
    """The highest level that holds the target, by trying them all."""
    return max((n for n, level in enumerate(levels) if device.frame(level).total <= target_ms), default=0)


@pytest.mark.parametrize("ladder", [CONTEXT_LADDER, READING_LADDER])
@pytest.mark.parametrize("filling", [5.0, 60.0, 150.0, 400.0])
@pytest.mark.parametrize("target_ms", [60.0, 100.0, 250.0])
@pytest.mark.parametrize("context_share", [0.1, 0.8])
def test_it_holds_the_budget_and_settles(filling, target_ms, context_share, ladder):
    device = Device(filling=filling, context_share=context_share)
    budget = Budget(target_ms, ladder.levels)
    indices, taken = run(budget, device, 400)
    late = taken[100:]
    reachable = device.frame(ladder.levels[0]).total <= target_ms
    over = sum(ms > target_ms for ms in late) / len(late)
    assert over < 0.05 if reachable else max(indices[100:]) == 0
    changes = sum(a != b for a, b in pairwise(indices[200:]))
    assert changes <= 4, "swings"
    assert indices[-1] >= best(device, 0.6 * target_ms, ladder.levels), "gives up more than it must"


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


@pytest.mark.parametrize("ladder", [CONTEXT_LADDER, READING_LADDER])
def test_a_ladder_grows_in_work_and_its_top_is_all(ladder):
    work = [level.relative_cost for level in ladder.levels]
    assert work == sorted(set(work)) and ladder.levels[-1] == FULL == QualityLevel(1.0, 7, None)
    assert work[0] < 0.1 and work[-1] == 1
    assert max(ladder.moving.relative_cost, ladder.still.relative_cost) < 0.5 and ladder.still.scale == 1
    assert Budget(100.0, ladder.levels).predicted_ms(FULL) == 0


def test_who_can_tell_errors_reads_a_part_instead_of_taking_less_context():
    assert ladder_for(SweepNet(SweepConfig(error_features=8))) is READING_LADDER
    assert ladder_for(SweepNet(SweepConfig())) is CONTEXT_LADDER and ladder_for(Telea()) is CONTEXT_LADDER
    assert all(level.context_times == FULL.context_times for level in READING_LADDER.levels)
    assert all(0 <= level.read_fraction < 1 for level in READING_LADDER.levels[:-1])


def test_impossible_budgets_are_refused():
    for target_ms in (0.0, -1.0, float("nan")):
        with pytest.raises(ValueError, match="expected a positive budget"):
            Budget(target_ms)


def test_what_a_picture_takes_grows_with_its_pixels():
    half = QualityLevel(0.5, 7, None)
    budget = Budget(100.0, (half, FULL))
    budget.record(half, FrameTimes(geometry=3.0, rendering=4.0, encode=6.0, wait=50.0))
    assert budget.predicted_ms(FULL) == pytest.approx(3 + 40) and budget.predicted_ms(half) == pytest.approx(3 + 10)
    assert budget.measured_ms == pytest.approx(13.0), "waiting is nobody's work"


def test_a_level_that_never_holds_is_tried_more_and_more_rarely_but_never_given_up():
    half = QualityLevel(0.5, 7, None)
    budget, waits, waited = Budget(100.0, (half, FULL)), [], 0
    for _ in range(20 * MAX_UP_AFTER_FRAMES):
        level = budget.level
        if level == half:
            waited += 1
        elif waited:
            waits, waited = [*waits, waited], 0
        # Pictures of half the size say that the whole would take 40 ms.
        budget.record(level, FrameTimes(rendering=10.0 if level == half else 300.0))
    assert waits[-1] > 20 * waits[1] and max(waits) <= MAX_UP_AFTER_FRAMES + MEMORY_FRAMES and len(waits) > 15


def test_it_goes_up_only_where_the_next_level_has_room():
    levels = (QualityLevel(0.5, 7, None), FULL)
    budget = Budget(100.0, levels)
    budget.record(FULL, FrameTimes(inpainting=400.0))
    for _ in range(30):
        assert budget.index == 0
        budget.record(levels[0], FrameTimes(inpainting=80.0))  # this level has room, the whole would take 320 ms
    for _ in range(30):
        budget.record(budget.level, FrameTimes(inpainting=80.0 * budget.level.scale**2))
    assert budget.level == FULL
