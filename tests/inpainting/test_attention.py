"""Attention, rotation and pruning: each path against loops."""

from dataclasses import replace

import pytest
import torch
from inpainting.plates import TINY
from reference.attention_twin import attend_twin, rotate_twin, transformer_twin

from viewmend.inpainting import attention, rope
from viewmend.inpainting.attention import attend, attend_and_sum, attend_weighted
from viewmend.inpainting.pruning import most_attended, straight_through
from viewmend.inpainting.transformer import TokenPositions, Transformer

SCALE = 0.3


@pytest.fixture
def qkv(rng):
    Q = torch.randn(2, 3, 5, 8, generator=rng)
    K, V = torch.randn(2, 2, 3, 7, 8, generator=rng)
    keep = torch.tensor([[1, 1, 0, 1, 1, 0, 1], [0, 0, 1, 0, 0, 0, 0]], dtype=torch.bool)
    return Q, K, V, keep


def twin(Q, K, V, keep):
    outs, sums = torch.zeros_like(Q), torch.zeros(keep.shape)
    for b in range(2):
        for h in range(3):
            outs[b, h], received = attend_twin(Q[b, h], K[b, h][keep[b]], V[b, h][keep[b]], SCALE)
            sums[b, keep[b]] += received
    return outs, sums


def test_every_path_equals_the_loops(qkv, monkeypatch):
    Q, K, V, keep = qkv
    outs, sums = twin(Q, K, V, keep)
    assert torch.allclose(attend(Q, K, V, keep, SCALE), outs, atol=1e-5)
    assert torch.allclose(attend_weighted(Q, K, V, keep.float(), SCALE), outs, atol=1e-5)
    asks = torch.ones(2, 5, dtype=torch.bool)
    for entries in (1 << 22, 2 * 3 * 7 * 2):
        monkeypatch.setattr(attention, "CHUNK_ENTRIES", entries)
        looked, received = attend_and_sum(Q, K, V, keep, asks, SCALE)
        assert torch.allclose(looked, outs, atol=1e-5)
        assert torch.allclose(received, sums, atol=1e-5)


def test_gradients_of_every_path_are_equal(qkv):
    Q, K, V, keep = qkv
    asks = torch.ones(2, 5, dtype=torch.bool)
    paths = [
        lambda *x: twin(*x, keep)[0],
        lambda *x: attend(*x, keep, SCALE),
        lambda *x: attend_weighted(*x, keep.float(), SCALE),
        lambda *x: attend_and_sum(*x, keep, asks, SCALE)[0],
    ]
    gradients = []
    for path in paths:
        inputs = [x.clone().requires_grad_() for x in (Q, K, V)]
        gradients.append(torch.autograd.grad((path(*inputs) ** 2).sum(), inputs))
    for other in gradients[1:]:
        assert all(torch.allclose(a, b, atol=1e-4) for a, b in zip(gradients[0], other, strict=True))


def test_padded_queries_do_not_count(qkv):
    Q, K, V, keep = qkv
    asks = torch.tensor([[1, 1, 1, 0, 0], [1, 1, 1, 1, 1]], dtype=torch.bool)
    _, received = attend_and_sum(Q, K, V, keep, asks, SCALE)
    _, sums = twin(Q[:, :, :3], K, V, keep)
    assert torch.allclose(received[0], sums[0], atol=1e-5)


def test_no_key_gives_zeros(qkv):
    Q, K, V, keep = qkv
    keep = torch.zeros_like(keep)
    assert not attend(Q, K, V, keep, SCALE).any()
    assert not attend_weighted(Q, K, V, keep.float(), SCALE).any()
    looked, received = attend_and_sum(Q, K, V, keep, torch.ones(2, 5, dtype=torch.bool), SCALE)
    assert not looked.any() and not received.any()


def test_rotation_equals_the_loop(rng):
    x, angle = torch.randn(3, 8, generator=rng), torch.randn(3, 4, generator=rng)
    slow = torch.stack([rotate_twin(a, b) for a, b in zip(x, angle, strict=True)])
    assert torch.allclose(rope.rotate(x, rope.cos_sin(angle)), slow, atol=1e-6)


@pytest.mark.parametrize("frequencies", [rope.score_frequencies(32), rope.value_frequencies(32)])
def test_rotated_scores_depend_on_differences_only(frequencies, rng):
    q, k = torch.randn(2, 50, 32, generator=rng)
    at, there, shift = torch.rand(3, 50, 3, generator=rng) * 2 - 0.5

    def score(a, b):
        return (
            rope.rotate(q, rope.cos_sin(rope.angles(a, frequencies)))
            * rope.rotate(k, rope.cos_sin(rope.angles(b, frequencies)))
        ).sum(-1)

    assert torch.allclose(score(at, there), score(at + shift, there + shift), atol=1e-3)
    assert not torch.allclose(score(at, there), score(at, there + shift), atol=1e-1)
    assert torch.allclose(score(at, at), (q * k).sum(-1), atol=1e-4)


def test_each_pair_turns_for_one_axis_from_two_images_to_two_patches():
    frequencies = rope.score_frequencies(64)
    assert ((frequencies != 0).sum(0) == 1).all()
    assert (frequencies != 0).sum(1).tolist() == [12, 12, 8]
    turns = 2 * torch.pi / frequencies[0][frequencies[0] != 0]
    assert torch.allclose(turns[[0, -1]], torch.tensor([2.0, 2 * 16 / 320]))
    assert torch.allclose(turns[1:] / turns[:-1], (turns[1] / turns[0]).expand(11))


def test_values_turn_by_distinct_waves():
    waves = rope.value_frequencies(32)
    assert not waves[:, 0].any() and not waves[2].any()
    both_ways = {tuple(w) for w in waves.T.tolist()} | {tuple(w) for w in (0 - waves).T.tolist()}
    assert len(both_ways) == 2 * 16 - 1


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"rope_unit": "image"},
        {"rope_values": False},
        {"rope": False, "rope_values": False},
    ],
    ids=["ours", "image", "scores-only", "none"],
)
@pytest.mark.parametrize(("top_k", "grad"), [(None, True), (2, False), (2, True), (100, False)])
def test_the_transformer_equals_its_twin(changes, top_k, grad, rng):
    config = replace(TINY, **changes)
    net = Transformer(config)
    with torch.no_grad():
        for parameter in net.parameters():
            parameter += 0.1 * torch.randn(parameter.shape, generator=rng)
    counts, asks = (5, 3), (3, 2)
    P, R = torch.randn(2, 3, 64, generator=rng), torch.randn(2, 5, 64, generator=rng)
    places = [torch.rand(2, n, 3, generator=rng) for n in (3, 5)]
    steps = [torch.rand(2, n, 3, generator=rng) * 6 for n in (3, 5)]
    present = [torch.arange(n) < torch.tensor(c)[:, None] for n, c in ((3, asks), (5, counts))]
    at, context_at = (TokenPositions(*x) for x in zip(places, steps, present, strict=True))
    with torch.set_grad_enabled(grad):
        KV = net.project_context(R.flatten(0, 1)).unflatten(2, (2, 5))
        fast = net(P, at, KV, context_at, top_k)
    for b, (n, m) in enumerate(zip(asks, counts, strict=True)):
        own = (places[0][b, :n], steps[0][b, :n])
        with torch.no_grad():
            slow = transformer_twin(net, P[b, :n], *own, R[b, :m], places[1][b, :m], steps[1][b, :m], top_k)
        assert torch.allclose(fast[b, :n], slow, atol=2e-4), b


def test_most_attended_keeps_order_and_may_ask_for_more():
    received = torch.tensor([[0.1, 0.9, 0.3, 0.8]])
    assert most_attended(received, 2).tolist() == [[1, 3]]
    assert most_attended(received, 9).tolist() == [[0, 1, 2, 3]]


def test_straight_through_is_hard_and_its_gradient_is_soft():
    received = torch.tensor([[0.1, 0.9, 0.3, 0.8, 5.0]], requires_grad=True)
    keep = torch.tensor([[True, True, True, True, False]])
    mask = straight_through(received, keep, 2)
    assert mask.tolist() == [[0, 1, 0, 1, 0]]
    (gradient,) = torch.autograd.grad(mask.sum(), received)
    assert (gradient[0, :4] > 0).all() and gradient[0, 4] == 0
    assert straight_through(received, keep, 9).tolist() == [[1, 1, 1, 1, 0]]


def test_a_pruned_key_still_learns(qkv):
    Q, K, V, _ = qkv
    weight = torch.tensor([[1.0, 1, 0, 1, 1, 1, 1]] * 2, requires_grad=True)
    (attend_weighted(Q, K, V, weight, SCALE) ** 2).sum().backward()
    assert (weight.grad[:, 2] != 0).all()


@pytest.mark.parametrize("block", [0, 7])
def test_an_untrained_model_looks_at_what_lands_near(block):
    """More than half of the weight falls within one and a half patch steps, in every head."""
    config = replace(TINY, dim=128, blocks=4, rope_unit="image")
    torch.manual_seed(0)
    net = Transformer(config)
    grid = torch.cartesian_prod(torch.arange(20), torch.arange(20)).float() * 16 / 320
    places = torch.cat(
        [torch.nn.functional.pad(grid + torch.rand(2) * 16 / 320, (0, 1), value=i % 3 / 30) for i in range(9)]
    )
    R, P = torch.nn.functional.layer_norm(torch.randn(2, len(places), 128), (128,))
    query = torch.tensor([[0.45, 0.55, 0.0]])
    K = net.project_context(R)[block, 0].unflatten(1, (4, 32)).transpose(0, 1)
    Q = net.blocks[block].query(P[:1]).unflatten(1, (4, 32)).transpose(0, 1)
    Q = rope.rotate(Q, rope.cos_sin(rope.angles(query, net.score_frequencies)))
    K = rope.rotate(K, rope.cos_sin(rope.angles(places, net.score_frequencies)))
    weights = ((Q @ K.mT)[:, 0] * net.scale).softmax(-1)
    near = (places - query)[:, :2].norm(dim=1) < 1.5 * 16 / 320
    assert (weights[:, near].sum(1) > 0.5).all()
    assert float(near.float().mean()) < 0.05
