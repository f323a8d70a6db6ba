"""The published networks on a stream: at once (O), and remembering (OM)."""

from copy import deepcopy

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


SMALL = [DSTT, E2FGVIHQ]
ALL = [DSTT, pytest.param(FuseFormer, marks=pytest.mark.slow), pytest.param(E2FGVI, marks=pytest.mark.slow), E2FGVIHQ]


@torch.no_grad()
@pytest.mark.parametrize("kind", ALL)
def test_without_a_past_both_variants_are_the_network_itself(kind, networks, rng):
    network, now = networks(kind), frames(kind, 1, rng)
    alone = network(now[None], 1) if isinstance(network, E2FGVI) else network(now[None])
    at_once = network.complete_clip(Clip(now))
    remembering, _ = network.complete_remembering(now, ())
    assert torch.equal(at_once, alone[0, 0]) and torch.allclose(remembering, at_once, atol=1e-6)


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
    _, slot = network.complete_remembering(clip[1:2], ())
    outputs.append(network.complete_remembering(clip[:1], (slot,))[0])
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


@torch.no_grad()
@pytest.mark.parametrize("kind", ALL[:2])
def test_a_slot_is_each_blocks_tokens_after_its_first_norm(kind, networks, rng):
    network, now = networks(kind), frames(kind, 2, rng)
    seen = []
    hooks = [
        b.attention.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0])) for b in network.transformer
    ]
    _, slot = network.complete_remembering(now, ())
    for hook in hooks:
        hook.remove()
    rows, cols = (-(-side // 12) for side in SIZES[kind])
    assert slot.shape == (8, 2, rows, cols, 512)
    spatial = seen[1] if kind is DSTT else seen[1].reshape(2, -1, 512)  # of frames one by one: easy to compare
    assert torch.allclose(spatial, slot[1].flatten(1, 2), atol=1e-6)
    if kind is FuseFormer:
        assert slot[:, :1].nbytes == 8 * 720 * 512 * 4  # 11.8 MB, what the published memory keeps of a frame


@torch.no_grad()
@pytest.mark.parametrize("kind", SMALL)
def test_what_is_remembered_never_changes(kind, networks, rng):
    """Tokens of the past were computed causally: later frames, and other streams, do not touch them."""
    network, clip = networks(kind), frames(kind, 3, rng)
    memory, copies, outputs = (), (), []
    for frame in clip:
        output, slot = network.complete_remembering(frame[None], memory)
        memory, copies, outputs = (*memory, slot), (*copies, deepcopy(slot)), [*outputs, output]
    assert all(same(a, b) for a, b in zip(memory, copies, strict=True))
    again, _ = network.complete_remembering(clip[2:], copies[:2])
    assert torch.equal(again, outputs[2])
    other, _ = network.complete_remembering(clip[2:], copies[1:2])
    assert float((other - again).abs().max()) > 1e-5, "the oldest slot is looked at, too"


def tensors(slot):
    if isinstance(slot, torch.Tensor):
        return [slot]
    kept = [slot.small, *slot.propagated.features, *(x for t in slot.tokens for x in (t.fine, t.pooled))]
    return kept + ([slot.propagated.flow] if slot.propagated.flow is not None else [])


def same(a, b):
    return all(torch.equal(x, y) for x, y in zip(tensors(a), tensors(b), strict=True))


@torch.no_grad()
def test_e2fgvis_slot_keeps_two_propagated_frames_at_most(networks, rng):
    network, memory, sizes = networks(E2FGVIHQ), (), []
    for frame in frames(E2FGVIHQ, 5, rng):
        _, slot = network.complete_remembering(frame[None], memory[-2:])
        memory = (*memory, slot)
        sizes.append(sum(x.numel() for x in tensors(slot)))
    assert [len(slot.propagated.features) for slot in memory] == [1, 2, 2, 2, 2]
    assert len(set(sizes[1:])) == 1


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


@torch.no_grad()
@pytest.mark.parametrize(("kind", "other"), [(DSTT, (24, 48)), (E2FGVIHQ, (120, 108))])
def test_memory_of_another_size_is_refused(kind, other, networks, rng):
    network = networks(kind)
    _, slot = network.complete_remembering(torch.zeros(1, 3, *other), ())
    with pytest.raises(ValueError, match="start a new stream"):
        network.complete_remembering(frames(kind, 1, rng), (slot,))


@pytest.mark.parametrize("local", [0, 3])
def test_e2fgvi_refuses_more_local_frames_than_there_are(local, networks, rng):
    with pytest.raises(ValueError, match=f"expected 1 to 2 local frames of 2, got {local}"):
        networks(E2FGVIHQ)(frames(E2FGVIHQ, 2, rng)[None], local)
