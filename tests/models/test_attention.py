"""Rotary embedding, attention, pruning and the transformer against slow references."""

from dataclasses import replace

import pytest
import torch
from models.plates import TINY
from reference.attention_reference import attend_reference, rotate_reference, transformer_reference

from viewmend.models.paper import transformer
from viewmend.models.paper.transformer import (
    KeyMask,
    TokenPositions,
    Transformer,
    attend,
    attend_and_sum,
    attend_weighted,
    rope_factors,
    rope_frequencies,
    rotate,
    straight_through,
)

SCALE = 0.3
ALL = torch.ones(2, 5, dtype=torch.bool)


@pytest.fixture
def qkv(rng):
    Q = torch.randn(2, 3, 5, 8, generator=rng)
    K, V = torch.randn(2, 2, 3, 7, 8, generator=rng)
    keep = torch.tensor([[1, 1, 0, 1, 1, 0, 1], [0, 0, 1, 0, 0, 0, 0]], dtype=torch.bool)
    return Q, K, V, keep


def reference(Q, K, V, keep):
    outs, sums = torch.zeros_like(Q), torch.zeros(keep.shape)
    for b in range(2):
        for h in range(3):
            outs[b, h], received = attend_reference(Q[b, h], K[b, h][keep[b]], V[b, h][keep[b]], SCALE)
            sums[b, keep[b]] += received
    return outs, sums


def test_every_path_equals_the_reference(qkv, monkeypatch):
    Q, K, V, keep = qkv
    outs, sums = reference(Q, K, V, keep)
    assert torch.allclose(attend(Q, K, V, KeyMask.of(keep, Q.dtype), SCALE), outs, atol=1e-5)
    assert torch.allclose(attend_weighted(Q, K, V, keep.float(), SCALE), outs, atol=1e-5)
    for entries in (1 << 22, 2 * 3 * 7 * 2):
        monkeypatch.setattr(transformer, "CHUNK_ENTRIES", entries)
        attended, received = attend_and_sum(Q, K, V, KeyMask.of(keep, Q.dtype), ALL, SCALE)
        assert torch.allclose(attended, outs, atol=1e-5)
        assert torch.allclose(received, sums, atol=1e-5)


def test_gradients_of_every_path_equal_the_reference(qkv):
    *inputs, keep = qkv
    mask = KeyMask.of(keep, torch.float32)
    paths = [
        lambda *x: reference(*x, keep)[0],
        lambda *x: attend(*x, mask, SCALE),
        lambda *x: attend_weighted(*x, keep.float(), SCALE),
        lambda *x: attend_and_sum(*x, mask, ALL, SCALE)[0],
    ]
    gradients = []
    for path in paths:
        leaves = [x.clone().requires_grad_() for x in inputs]
        gradients.append(torch.autograd.grad((path(*leaves) ** 2).sum(), leaves))
    for other in gradients[1:]:
        assert all(torch.allclose(a, b, atol=1e-4) for a, b in zip(gradients[0], other, strict=True))


def test_attention_without_keys_is_zero(qkv):
    Q, K, V, keep = qkv
    keep = torch.zeros_like(keep)
    assert not attend(Q, K, V, KeyMask.of(keep, Q.dtype), SCALE).any()
    assert not attend_weighted(Q, K, V, keep.float(), SCALE).any()
    attended, received = attend_and_sum(Q, K, V, KeyMask.of(keep, Q.dtype), ALL, SCALE)
    assert not attended.any() and not received.any()


def test_rotation_equals_the_reference(rng):
    x = torch.randn(3, 8, generator=rng)
    at = torch.rand(3, 3, generator=rng)
    frequencies = torch.randn(3, 4, generator=rng)
    angle = at @ frequencies
    slow = torch.stack([rotate_reference(a, b) for a, b in zip(x, angle, strict=True)])
    assert torch.allclose(rotate(x, rope_factors(at, frequencies)), slow, atol=1e-6)


def test_rotated_scores_depend_on_position_differences_only(rng):
    frequencies = rope_frequencies(32)
    q, k = torch.randn(2, 50, 32, generator=rng)
    at, there, shift = torch.rand(3, 50, 3, generator=rng) * 2 - 0.5

    def score(a, b):
        return (rotate(q, rope_factors(a, frequencies)) * rotate(k, rope_factors(b, frequencies))).sum(-1)

    assert torch.allclose(score(at, there), score(at + shift, there + shift), atol=1e-3)
    assert not torch.allclose(score(at, there), score(at, there + shift), atol=1e-1)
    assert torch.allclose(score(at, at), (q * k).sum(-1), atol=1e-4)


def test_each_pair_rotates_along_one_axis_from_two_images_to_two_patches():
    frequencies = rope_frequencies(64)
    assert ((frequencies != 0).sum(0) == 1).all()
    assert (frequencies != 0).sum(1).tolist() == [12, 12, 8]
    wavelengths = 2 * torch.pi / frequencies[0][frequencies[0] != 0]
    assert torch.allclose(wavelengths[[0, -1]], torch.tensor([2.0, 2 * 16 / 320]))
    assert torch.allclose(wavelengths[1:] / wavelengths[:-1], (wavelengths[1] / wavelengths[0]).expand(11))


@pytest.mark.parametrize("rope", [True, False])
@pytest.mark.parametrize(("top_k", "grad"), [(None, True), (2, False), (2, True), (100, False)])
def test_the_transformer_equals_the_reference(rope, top_k, grad, rng):
    net = Transformer(replace(TINY, rope=rope))
    with torch.no_grad():
        for parameter in net.parameters():
            parameter += 0.1 * torch.randn(parameter.shape, generator=rng)
    num_queries, num_keys = (3, 2), (5, 3)
    P, R = torch.randn(2, 3, 64, generator=rng), torch.randn(2, 5, 64, generator=rng)
    uvs = [torch.rand(2, n, 3, generator=rng) for n in (3, 5)]
    present = [
        torch.arange(n) < torch.tensor(count)[:, None] for n, count in ((3, num_queries), (5, num_keys))
    ]
    at, context_at = (TokenPositions(*x) for x in zip(uvs, present, strict=True))
    with torch.set_grad_enabled(grad):
        KV = net.project_context(R.flatten(0, 1)).unflatten(2, (2, 5))
        fast = net(P, at, KV, context_at, top_k)
    for b, (n, m) in enumerate(zip(num_queries, num_keys, strict=True)):
        with torch.no_grad():
            slow = transformer_reference(net, P[b, :n], uvs[0][b, :n], R[b, :m], uvs[1][b, :m], top_k)
        assert torch.allclose(fast[b, :n], slow, atol=2e-4), b


def test_straight_through_is_hard_and_its_gradient_is_soft():
    received = torch.tensor([[0.1, 0.9, 0.3, 0.8, 5.0]], requires_grad=True)
    keep = torch.tensor([[True, True, True, True, False]])
    mask = straight_through(received, keep, 2)
    assert mask.tolist() == [[0, 1, 0, 1, 0]]
    (gradient,) = torch.autograd.grad(mask.sum(), received)
    assert (gradient[0, :4] > 0).all() and gradient[0, 4] == 0
    assert straight_through(received, keep, 9).tolist() == [[1, 1, 1, 1, 0]]


def test_a_pruned_key_has_a_gradient(qkv):
    Q, K, V, _ = qkv
    weight = torch.tensor([[1.0, 1, 0, 1, 1, 1, 1]] * 2, requires_grad=True)
    (attend_weighted(Q, K, V, weight, SCALE) ** 2).sum().backward()
    assert (weight.grad[:, 2] != 0).all()
