"""RIFTCast's own inpainting: the whole view at 432x240, and a memory of six frames, right and as published."""

from dataclasses import replace

import pytest
import torch
from models.plates import Rig
from models.plates import view as plate
from torch import nn

from viewmend.contrib.baselines.published import RiftCast
from viewmend.contrib.baselines.token_transformers import DSTT


class Counter(DSTT):
    """Remembers the time that a frame's colour says, in each block."""

    def __init__(self):
        nn.Module.__init__(self)
        self.seen = []

    def complete_remembering(self, now, memory):
        assert now.shape == (1, 3, 240, 432)
        self.seen.append([slot.flatten().tolist() for slot in memory])
        time = (now[0, 0, 0, 0] + 1) * 50
        return torch.zeros(3, 240, 432), torch.full((8, 1, 1, 1, 512), float(time.round()))


def times_view(time):
    view = plate(time, (20, 40, 30, 55))
    return replace(view, rgb=torch.full_like(view.rgb, time / 100) * (1 - view.error))


def memories(as_published, frames):
    network = Counter()
    inpainter, state = RiftCast(network, as_published), RiftCast(network).initial_state()
    for time in range(frames):
        _, state = inpainter.step(times_view(time), Rig(), state)
    return [[set(slot) for slot in memory] for memory in network.seen], state


def test_the_memory_is_of_the_last_six_frames():
    seen, state = memories(as_published=False, frames=12)
    for time, memory in enumerate(seen):
        assert memory == [{t} for t in range(max(0, time - 6), time)]
    assert len(state.slots) == 6


def test_as_published_nothing_is_remembered_before_six_frames_and_then_the_first_five_stay():
    seen, state = memories(as_published=True, frames=20)
    assert seen[:6] == [[]] * 6
    assert seen[6] == [{0}, {1}, {2}, {3}, {4}, {5}]
    # The flattened memory is rolled by one number: a slot's last one comes from the next, all others are its own.
    assert seen[7] == [{0, 1}, {1, 2}, {2, 3}, {3, 4}, {4, 5}, {6}]
    assert [min(slot) for slot in seen[19][:5]] == [0, 1, 2, 3, 4] and seen[19][5] == {18}
    assert len(state.slots) == 6


@pytest.mark.parametrize("as_published", [False, True])
def test_only_holes_change_and_they_stay_soft(as_published):
    view = plate(0)
    completed, _ = RiftCast(Counter(), as_published).step(view, Rig(), RiftCast(Counter()).initial_state())
    untouched = view.error == 0
    assert torch.equal(completed.rgb[:, untouched], view.rgb[:, untouched])
    assert torch.allclose(completed.rgb[:, view.error == 1], torch.tensor(0.5))
    soft = view.error == 0.5
    assert torch.allclose(completed.rgb[:, soft], 0.25 + 0.5 * view.rgb[:, soft])
