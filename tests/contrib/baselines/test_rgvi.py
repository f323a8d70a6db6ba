"""RGVI: what the past saw is pulled into the holes along flow; the rest is filled; nothing else changes."""

import sys
from types import SimpleNamespace

import pytest
import torch
from torch import nn
from torch.nn.functional import avg_pool2d

from viewmend.contrib.baselines import rgvi
from viewmend.contrib.baselines.rgvi import (
    PAST_FRAMES,
    Rgvi,
    RgviState,
    dis_flow,
    disagreeing,
    make_rgvi,
    pull,
)
from viewmend.geometry.cameras import Cameras
from viewmend.metrics import weights
from viewmend.metrics.weights import KnownWeights
from viewmend.models.base import ContextProvider
from viewmend.types import IncompleteView
from viewmend.utils.weight_files import WeightsError

SIZE = 96
MOTION = (3, 2)
"""Of the picture from one time to the next, pixels right and down."""


@pytest.fixture
def texture(rng):
    """A smooth picture, larger than the views of it."""
    return avg_pool2d(torch.rand(1, 3, SIZE + 109, SIZE + 109, generator=rng), 9, 1)[0] * 4 % 1


def at(texture, time):
    """The moving picture at a time."""
    x, y = 60 - MOTION[0] * time, 60 - MOTION[1] * time
    return texture[:, y : y + SIZE, x : x + SIZE]


def view(truth, time, hole=(slice(30, 50), slice(40, 60))):
    error = torch.zeros(SIZE, SIZE)
    error[hole] = 1
    camera = Cameras(("c",), torch.eye(3)[None], torch.eye(4)[None], torch.tensor([[SIZE, SIZE]]))
    ones = torch.ones(SIZE, SIZE)
    return IncompleteView(
        camera, truth * (error == 0), ones, error, ones, (), torch.zeros(0, SIZE, SIZE), time
    )


def constant(x, y):
    return torch.tensor([float(x), float(y)])[:, None, None].expand(2, SIZE, SIZE)


def known_flow(image, other):
    """To the time before, or the one after: whichever explains the picture."""
    ways = [constant(-MOTION[0], -MOTION[1]), constant(*MOTION)]
    return min(ways, key=lambda way: float((pull(other, way)[0] - image)[:, 60:-20, 20:-20].abs().mean()))


@ContextProvider
def no_context(time, names):
    raise AssertionError("RGVI knows no cameras")


def stream(inpainter, texture, times, hole=(slice(30, 50), slice(40, 60)), shown=True):
    state = inpainter.initial_state()
    for time in range(times):
        completed, state = inpainter.step(view(at(texture, time), time, hole), no_context, state)
        if shown:
            state = inpainter.reveal_truth(state, at(texture, time))
    return completed, state


def in_hole(completed, truth):
    return float((completed.rgb - truth)[:, completed.view.error > 0].abs().mean())


def test_flow_that_does_not_lead_home_disagrees():
    right = constant(3, 2)
    assert not disagreeing(right, -right)[:-2, :-3].any()
    assert (
        disagreeing(right, -right)[-2:].all() and disagreeing(right, -right)[:, -3:].all()
    )  # out of the picture
    assert disagreeing(right, right).all() and not disagreeing(right, -right + 0.4)[:-2, :-3].any()
    wrong = right.clone()
    wrong[:, 10, 20] = 9
    assert (disagreeing(wrong, -right) & ~disagreeing(right, -right)).nonzero().tolist() == [[10, 20]]


def test_a_hole_takes_what_was_there_before(texture):
    exact, _ = stream(Rgvi(known_flow), texture, 3)
    assert in_hole(exact, at(texture, 2)) < 1e-5
    first, _ = stream(Rgvi(), texture, 1)
    later, _ = stream(Rgvi(), texture, 3)
    assert in_hole(later, at(texture, 2)) < 0.4 * in_hole(first, at(texture, 0))
    kept = later.view.error == 0
    assert torch.equal(later.rgb[:, kept], later.view.rgb[:, kept])


def test_flow_adds_up_over_several_frames(texture, monkeypatch):
    """A hole at the border, through which the picture comes in: only what was in sight before can be pulled."""
    fill = rgvi.fill

    def black(image, missing, subject):
        return torch.where(missing, 0.0, image) if len(image) == 3 else fill(image, missing, subject)

    monkeypatch.setattr(rgvi, "fill", black)
    completed, _ = stream(Rgvi(known_flow), texture, 3, (slice(0, 20), slice(0, 20)))
    truth = at(texture, 2)
    seen = torch.zeros(SIZE, SIZE, dtype=torch.bool)
    seen[MOTION[1] : 20, MOTION[0] : 20] = True
    torch.testing.assert_close(completed.rgb[:, seen], truth[:, seen], rtol=0, atol=1e-5)
    corner = completed.view.error.bool() & ~seen
    assert not completed.rgb[:, corner].any()

    fill = lambda flow, *_: flow  # noqa: E731
    lost, _ = stream(Rgvi(lambda image, other: constant(999, 999)), texture, 3)
    assert not lost.rgb[:, lost.view.error > 0].any()


def test_the_past_is_bounded_and_its_own_without_the_truth(texture):
    _, state = stream(Rgvi(known_flow), texture, PAST_FRAMES + 4)
    assert isinstance(state, RgviState)
    assert (len(state.past), len(state.flows)) == (PAST_FRAMES, PAST_FRAMES - 1)
    assert torch.equal(state.past[0], at(texture, PAST_FRAMES + 3))
    completed, state = stream(Rgvi(), texture, 2, shown=False)
    assert isinstance(state, RgviState) and torch.equal(state.past[0], completed.rgb)


def test_a_view_of_another_size_starts_a_new_past(texture):
    _, state = stream(Rgvi(), texture, 2)
    small = view(at(texture, 2), 2)
    rgb, weights = small.rgb[:, :64], small.weights[:, :64]
    part = IncompleteView(
        small.camera, rgb, small.mask[:64], small.error[:64], small.depth[:64], (), weights, 2
    )
    completed, state = Rgvi().step(part, no_context, state)
    assert isinstance(state, RgviState) and len(state.past) == 1 and completed.rgb.shape == (3, 64, SIZE)


@pytest.fixture
def places(tmp_path, monkeypatch):
    for name in ("VIEWMEND_WEIGHTS", "XDG_CACHE_HOME", "TORCH_HOME"):
        monkeypatch.setenv(name, str(tmp_path))
    return tmp_path


class Halves(nn.Module):
    """In place of RAFT: how far the second image's left column lies right of the first's, everywhere."""

    def __init__(self):
        super().__init__()
        self.gain = nn.Parameter(torch.ones(()))

    def forward(self, image, other):
        assert image.shape == other.shape and not any(side % 8 or side < 128 for side in image.shape[2:])
        flow = self.gain * torch.tensor([16.0, 8.0])[:, None, None].expand(1, 2, *image.shape[2:])
        return [torch.zeros_like(flow), flow]


def test_raft_is_used_where_its_weights_are(places, monkeypatch, rng):
    assert make_rgvi().flow is dis_flow
    (places / "raft.pth").write_bytes(b"none")
    with pytest.raises(WeightsError, match="damaged or another"):
        make_rgvi()
    torch.save({"gain": torch.tensor(0.5)}, places / "raft.pth")
    monkeypatch.setattr(weights, "KNOWN", (KnownWeights("raft", ("raft.pth",), "RAFT", "s", "l"),))
    monkeypatch.setitem(sys.modules, "torchvision.models.optical_flow", None)
    with pytest.raises(ValueError, match="pip install torchvision"):
        make_rgvi()
    module = SimpleNamespace(raft_large=Halves)
    for name in ("torchvision", "torchvision.models", "torchvision.models.optical_flow"):
        monkeypatch.setitem(sys.modules, name, module)
    flow = make_rgvi().flow
    assert flow.func is rgvi.raft_flow
    for height, width in ((100, 130), (131, 1728)):
        scale = min(1.0, 864 / width)
        size = [max(128, 8 * round(side * scale / 8)) for side in (height, width)]
        expected = torch.tensor([8.0 * width / size[1], 4.0 * height / size[0]])
        found = flow(*torch.rand(2, 3, height, width, generator=rng))
        torch.testing.assert_close(found, expected[:, None, None].expand(2, height, width))
