"""The published networks on a stream."""

import pytest
import torch

from viewmend.contrib.baselines.e2fgvi import E2FGVI, E2FGVIHQ
from viewmend.contrib.baselines.online import Clip
from viewmend.contrib.baselines.token_transformers import DSTT, FuseFormer

SIZES = {DSTT: (48, 72), FuseFormer: (240, 432), E2FGVI: (240, 432), E2FGVIHQ: (60, 108)}
"""The smallest that each takes."""


@pytest.fixture(scope="module")
def networks():
    made = {}

    def network(kind):
        if kind not in made:
            torch.manual_seed(0)
            made[kind] = kind().eval()
            with torch.no_grad():  # fresh weights of size 0.02 would let frames hardly matter to one another
                for parameter in made[kind].parameters():
                    parameter.mul_(2)
        return made[kind]

    return network


def frames(kind, count, rng):
    return 2 * torch.rand(count, 3, *SIZES[kind], generator=rng) - 1


ALL = [
    DSTT,
    pytest.param(FuseFormer, marks=pytest.mark.slow),
    pytest.param(E2FGVI, marks=pytest.mark.slow),
    E2FGVIHQ,
]


@torch.no_grad()
@pytest.mark.parametrize("kind", ALL)
def test_the_past_is_seen_and_the_first_frame_of_now_comes_out(kind, networks, rng):
    network, clip = networks(kind), frames(kind, 4, rng)
    alone = network.complete_clip(Clip(clip[:1]))
    outputs = [
        network.complete_clip(Clip(clip[:1], neighbours=(clip[1:2],))),
        network.complete_clip(Clip(clip[:1], references=(clip[1:2],))),
        network.complete_clip(Clip(clip[:2])),
    ]
    for output in outputs:
        assert output.shape == alone.shape and float((output - alone).abs().max()) > 1e-5


@torch.no_grad()
def test_dstt_and_fuseformer_see_frames_without_an_order(networks, rng):
    network, clip = networks(DSTT), frames(DSTT, 3, rng)
    one = network.complete_clip(Clip(clip[:1], neighbours=(clip[1:2], clip[2:3])))
    other = network.complete_clip(Clip(clip[:1], references=(clip[2:3], clip[1:2])))
    assert torch.allclose(one, other, atol=1e-5)


@torch.no_grad()
def test_e2fgvi_takes_the_past_in_the_order_of_time_and_cameras_as_references(networks, rng):
    network, clip = networks(E2FGVIHQ), frames(E2FGVIHQ, 6, rng)
    now, before, long_ago = clip[0:2], clip[2:4], clip[4:6]  # the view, and one camera's image each
    made = network.complete_clip(Clip(now, neighbours=(before,), references=(long_ago,)))
    order = torch.stack([before[0], now[0], before[1], now[1], *long_ago])
    assert torch.allclose(made, network(order[None], 2)[0, 1], atol=1e-6)


@pytest.mark.parametrize(
    ("kind", "size", "message"),
    [
        (DSTT, (240, 430), "multiples of 24, got 430x240"),
        (DSTT, (36, 48), "multiples of 24, got 48x36"),
        (FuseFormer, (480, 864), "frames of 432x240.*got 864x480"),
        (E2FGVI, (120, 216), "frames of 432x240.*got 216x120"),
        (E2FGVIHQ, (240, 430), "multiple of 60 .* one of 108, got 430x240"),
        (E2FGVIHQ, (0, 108), "got 108x0"),
    ],
)
def test_sizes_that_a_network_cannot_take_are_refused(kind, size, message, networks):
    network = networks(kind)
    with pytest.raises(ValueError, match=message):
        network.check_size(*size)
    if all(size):
        with pytest.raises(ValueError, match=message):
            network.complete_clip(Clip(torch.zeros(1, 3, *size)))
