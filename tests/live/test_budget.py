"""The budget on simulated devices: it holds the target, does not oscillate, and recovers; and the resolution limit."""

import random
from itertools import pairwise

import pytest

from viewmend.live.budget import (
    CONTEXT_LADDER,
    FULL,
    IDLE_WAIT_S,
    MAX_UP_AFTER_FRAMES,
    MAX_WAIT_S,
    MEMORY_FRAMES,
    REFINE_LADDER,
    Budget,
    ResolutionLimit,
    ladder_for,
)
from viewmend.live.protocol import FrameTimes, Limits
from viewmend.live.quality import QualityLevel
from viewmend.models.classical import Telea
from viewmend.models.paper.config import PAPER_TOP_K
from viewmend.models.views.config import ViewsConfig
from viewmend.models.views.model import ViewSynthNet


class Device:
    """Stage times of a machine, by another cost model than the controller's."""

    def __init__(self, shared=10.0, pixels=20.0, filling=200.0, context_share=0.6, noise=0.0, seed=0):
        self.shared, self.pixels, self.relative_cost, self.context_share = (
            shared,
            pixels,
            filling,
            context_share,
        )
        self.noise, self.chance = noise, random.Random(seed)

    def frame(self, level: QualityLevel) -> FrameTimes:
        """Inpainting has a part that does not depend on resolution."""
        size = 0.3 + 0.7 * level.scale**2
        frames = 7 if level.context_times is None else level.context_times
        context = 1 - self.context_share * (1 - frames / 7) if frames else 0.25
        context *= 1.0 if level.refine_fraction is None else 0.2 + 0.8 * level.refine_fraction
        by = 1 + self.noise * self.chance.uniform(-1, 1)
        encoding = 0.2 * self.relative_cost * by if frames else 0.0
        filling = 0.8 * self.relative_cost * size * context * by
        rendering = self.pixels * level.scale**2 * by
        return FrameTimes(
            geometry=self.shared * by, context=encoding, rendering=rendering, inpainting=filling
        )


def run(budget: Budget, device: Device, frames: int) -> tuple[list[int], list[float]]:
    indices, taken = [], []
    for _ in range(frames):
        ms = device.frame(budget.level)
        indices.append(budget.index)
        taken.append(ms.total)
        budget.record(budget.level, ms)
    return indices, taken


def best(device: Device, target_ms: float, levels) -> int:
    """The highest level that holds the target."""
    return max((n for n, level in enumerate(levels) if device.frame(level).total <= target_ms), default=0)


@pytest.mark.parametrize("ladder", [CONTEXT_LADDER, REFINE_LADDER])
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
    assert changes <= 4, "it oscillates"
    assert indices[-1] >= best(device, 0.6 * target_ms, ladder.levels), "quality is too low"


def test_noise_causes_no_oscillation():
    device = Device(filling=150, noise=0.25)
    budget = Budget(100.0)
    indices, taken = run(budget, device, 600)
    changes = sum(a != b for a, b in pairwise(indices[200:]))
    assert changes <= 16
    assert sum(taken[100:]) / len(taken[100:]) < 100


def test_a_slower_device_is_followed_at_once_and_a_recovery_found():
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


@pytest.mark.parametrize("ladder", [CONTEXT_LADDER, REFINE_LADDER])
def test_a_ladder_grows_in_cost_up_to_full_quality(ladder):
    work = [level.relative_cost for level in ladder.levels]
    assert work == sorted(set(work)) and ladder.levels[-1] == FULL == QualityLevel(1.0, None, None)
    assert work[0] < 0.1 and work[-1] == 1
    assert max(ladder.moving.relative_cost, ladder.still.relative_cost) < 0.5 and ladder.still.scale == 1
    assert Budget(100.0, ladder.levels).predict_ms(FULL) == 0


def test_a_model_that_predicts_errors_refines_a_part_instead_of_using_less_context():
    assert ladder_for(ViewSynthNet(ViewsConfig(error_features=8))) is REFINE_LADDER
    assert ladder_for(ViewSynthNet(ViewsConfig())) is CONTEXT_LADDER and ladder_for(Telea()) is CONTEXT_LADDER
    assert all(level.context_times == FULL.context_times for level in REFINE_LADDER.levels)
    assert all((level.top_k or 0) <= PAPER_TOP_K for level in CONTEXT_LADDER.levels), (
        "no level keeps more than FULL"
    )
    assert all(0 <= level.refine_fraction < 1 for level in REFINE_LADDER.levels[:-1])


def test_invalid_budgets_are_refused():
    for target_ms in (0.0, -1.0, float("nan")):
        with pytest.raises(ValueError, match="expected a positive budget"):
            Budget(target_ms)


def test_the_predicted_time_grows_with_the_pixels():
    half = QualityLevel(0.5, 7, None)
    budget = Budget(100.0, (half, FULL))
    budget.record(half, FrameTimes(geometry=3.0, rendering=4.0, encode=6.0, wait=50.0))
    assert budget.predict_ms(FULL) == pytest.approx(3 + 40) and budget.predict_ms(half) == pytest.approx(
        3 + 10
    )
    assert budget.measured_ms == pytest.approx(13.0), "without the time that a look waits"


def test_a_level_that_never_holds_is_tried_less_and_less_often_but_never_given_up():
    half = QualityLevel(0.5, 7, None)
    budget, waits, waited = Budget(100.0, (half, FULL)), [], 0
    for _ in range(20 * MAX_UP_AFTER_FRAMES):
        level = budget.level
        if level == half:
            waited += 1
        elif waited:
            waits, waited = [*waits, waited], 0
        # By the images of half the size, the full one would take 40 ms.
        budget.record(level, FrameTimes(rendering=10.0 if level == half else 300.0))
    assert waits[-1] > 20 * waits[1] and max(waits) <= MAX_UP_AFTER_FRAMES + MEMORY_FRAMES and len(waits) > 15


def test_it_goes_up_only_where_the_next_level_has_room():
    levels = (QualityLevel(0.5, 7, None), FULL)
    budget = Budget(100.0, levels)
    budget.record(FULL, FrameTimes(inpainting=400.0))
    for _ in range(30):
        assert budget.index == 0
        budget.record(
            levels[0], FrameTimes(inpainting=80.0)
        )  # this level has room, but the full one would take 320 ms
    for _ in range(30):
        budget.record(budget.level, FrameTimes(inpainting=80.0 * budget.level.scale**2))
    assert budget.level == FULL


LARGEST = Limits().max_pixels
MOVING = QualityLevel(1.0, 0, 256)


def limit(seconds_of_largest, level=MOVING):
    """The limit after an image of the largest size took this long."""
    made = ResolutionLimit()
    made.record(LARGEST, level, seconds_of_largest)
    return made


@pytest.mark.parametrize("seconds", [0.3, 1.0, 6.0])
@pytest.mark.parametrize("level", [MOVING, QualityLevel(0.5, 0, 256)])
def test_eight_waiting_viewers_are_served_in_time(seconds, level):
    limited = limit(seconds).apply(level, LARGEST, 8)
    total_s = 8 * seconds * limited.scale**2
    assert total_s <= MAX_WAIT_S * 1.001
    assert limited == level or total_s == pytest.approx(MAX_WAIT_S), "no smaller than necessary"
    assert (limited.context_times, limited.top_k) == (level.context_times, level.top_k)


def test_single_viewers_and_fast_machines_have_full_resolution():
    assert limit(60.0).apply(FULL, LARGEST, 1) == FULL
    assert limit(0.01).apply(MOVING, LARGEST, 8) == MOVING
    assert ResolutionLimit().apply(FULL, 320 * 320, 4) == FULL, "before any measurement"
    assert ResolutionLimit().apply(MOVING, LARGEST, 8).scale < 1


def test_with_idle_viewers_an_image_takes_less_time():
    limited = limit(3.0).apply(MOVING, LARGEST, 1, has_other_viewers=True)
    assert 3.0 * limited.scale**2 == pytest.approx(IDLE_WAIT_S)
    assert limit(0.9).apply(MOVING, LARGEST, 1, has_other_viewers=True) == MOVING


def test_the_slowest_of_the_last_large_images_counts():
    made = limit(1.0)
    assert made.apply(FULL, LARGEST, 8).scale < made.apply(MOVING, LARGEST, 8).scale < 1
    made.record(100, MOVING, 50.0)
    assert made.apply(MOVING, LARGEST, 8) == limit(1.0).apply(MOVING, LARGEST, 8), "small images do not count"
    for _ in range(16):
        made.record(LARGEST, MOVING, 0.1)
    assert made.apply(MOVING, LARGEST, 8) == MOVING
