"""Laws of the paper's model that hold for any weights."""

from dataclasses import replace

import pytest
import torch
from models.plates import NAMES, Rig, context, encode, tiny, view

from viewmend.models.base import ContextProvider, RenderQuality
from viewmend.models.network import set_compute_dtype
from viewmend.models.paper.context import window_times
from viewmend.models.paper.patches import any_in_patch


def complete(net, time, **options):
    """Fhat from scratch: all frames of the window, no cache; clamped as in `step`."""
    contexts = [context(t) for t in window_times(time, net.config)]
    with torch.no_grad():
        return net([view(time)], [contexts], **options)[0].completed.clamp(0, 1)


def close(a, b, tolerance=2e-5):
    return torch.allclose(a, b, atol=tolerance, rtol=0)


def test_the_network_uses_its_context():
    incomplete, net = view(5), tiny()
    completed = complete(net, 5)
    holes = incomplete.error > 0
    assert (completed - incomplete.rgb)[:, holes].abs().mean() > 0.05
    with torch.no_grad():
        alone = net([incomplete], [[]])[0].completed
    assert (completed - alone)[:, holes].abs().mean() > 0.005


def test_decoded_patches_cover_all_incomplete_patches():
    incomplete = view(5)
    with torch.no_grad():
        prediction = tiny()([incomplete], [[context(5)]])[0]
    kept = any_in_patch(incomplete.mask[None] > 0) & any_in_patch(incomplete.error[None] > 0)
    expected = torch.zeros(incomplete.mask.shape)
    for _, row, col in torch.nonzero(kept).tolist():
        expected[row * 16 : row * 16 + 28, col * 16 : col * 16 + 28] = 1
    assert torch.equal(prediction.coverage, expected)
    assert not prediction.inpainted[:, expected == 0].any()


@pytest.mark.parametrize("times", [range(11), (7, 8, 30, 29, 60)], ids=["steady", "late and leaping"])
def test_cached_equals_uncached(times):
    net, rig = tiny(), Rig()
    state, provider = net.initial_state(), ContextProvider(rig)
    for time in times:
        completed, state = net.step(view(time), provider, state)
        assert close(completed.rgb, complete(net, time)), time
    if times == range(11):
        assert sorted(time for time, _ in rig.asked) == list(times), "each frame is encoded once"


def test_the_order_of_cameras_does_not_matter():
    net = tiny()
    frames = [f for t in (3, 2) for f in encode(net, context(t))]
    with torch.no_grad():
        one, other = (net([view(3)], [frames[::step]])[0].completed for step in (1, -1))
    assert close(one, other)
    swapped = replace(view(5), source_views=NAMES[::-1])
    assert close(net.step(swapped, Rig(), net.initial_state())[0].rgb, complete(net, 5))


def test_pruning():
    net = tiny()
    assert close(complete(net, 5, top_k=1000), complete(net, 5)), "all tokens are kept"
    assert not close(complete(net, 5, top_k=3), complete(net, 5), 1e-4)
    assert close(complete(net, 5, top_k=3), complete(tiny(top_k=3), 5))


def test_a_view_without_holes_runs_no_layer():
    net, rig = tiny(), Rig()

    def forbidden(*_, **__):
        raise AssertionError("called")

    for module in net.modules():
        module.forward = forbidden
    with pytest.raises(AssertionError, match="called"):
        net.step(view(5), rig, net.initial_state())
    rig.asked.clear()
    incomplete, state = view(5, hole=None), net.initial_state()
    completed, after = net.step(incomplete, rig, state)
    assert completed.rgb is incomplete.rgb and after is state and not rig.asked


@pytest.mark.parametrize("top_k", [None, 2])
def test_an_empty_context_is_allowed(top_k):
    net, incomplete = tiny(), view(5)
    provider = ContextProvider(Rig(start=1000), RenderQuality(top_k=top_k))
    for error in (incomplete.error, torch.ones_like(incomplete.error)):
        completed, _ = net.step(replace(incomplete, error=error), provider, net.initial_state())
        assert completed.rgb.isfinite().all()
    with pytest.raises(ValueError, match="one context per view"):
        net([incomplete], [])


def test_a_missing_frame_of_a_camera_is_skipped():
    net, rig = tiny(), Rig(silent=frozenset({("left", 5), ("right", 4)}))
    completed, _ = net.step(view(5), rig, net.initial_state())
    frames = [context(5, ("right",)), context(4, ("left",)), context(3), context(1)]
    with torch.no_grad():
        expected = net([view(5)], [frames])[0].completed.clamp(0, 1)
    assert close(completed.rgb, expected)


@pytest.mark.parametrize(("width", "height"), [(28, 28), (29, 31), (97, 61), (20, 23), (64, 48), (101, 130)])
def test_any_size(width, height):
    size = {"width": width, "height": height}
    incomplete = view(5, (5, height - 6, 6, width - 4), **size)
    completed, _ = tiny().step(incomplete, Rig(**size), tiny().initial_state())
    assert completed.rgb.shape == (3, height, width) and completed.rgb.isfinite().all()
    holes = (incomplete.error > 0) & (incomplete.mask > 0)
    assert ((completed.rgb - incomplete.rgb).abs().amax(0)[holes] > 0).float().mean() > 0.9


@pytest.mark.parametrize("top_k", [None, 5])
def test_gradients_reach_every_parameter(top_k):
    net = tiny().train()
    predictions = net([view(5), view(6)], [[context(5), context(4)], [context(6)]], top_k)
    sum((p.inpainted**2).sum() for p in predictions).backward()
    assert not [n for n, p in net.named_parameters() if p.grad is None or not bool((p.grad != 0).any())]
    assert all(p.grad.isfinite().all() for p in net.parameters())


@pytest.mark.parametrize("top_k", [None, 6])
def test_a_batch_equals_one_by_one(top_k):
    net = tiny()
    views = [view(5), view(6, (30, 34, 40, 44)), view(7, hole=None), view(4, width=64, height=48)]
    contexts = [[context(5), context(4), context(3)], [context(6)], [], [context(4, width=120, height=100)]]
    with torch.no_grad():
        together = net(views, contexts, top_k)
        for one, v, c in zip(together, views, contexts, strict=True):
            alone = net([v], [c], top_k)[0]
            assert close(one.completed, alone.completed) and close(one.inpainted, alone.inpainted)
            assert torch.equal(one.coverage, alone.coverage)


def test_bfloat16_is_close():
    net = tiny()
    exact = complete(net, 5)
    set_compute_dtype(net, torch.bfloat16)
    rounded = complete(net, 5)
    assert rounded.dtype == torch.float32
    assert 0 < float((exact - rounded).abs().max()) < 0.1
    assert float((exact - rounded)[:, view(5).error > 0].abs().mean()) < 0.01


def test_a_context_frame_does_not_keep_its_batch_in_memory():
    for frames in tiny().encode_contexts([context(t) for t in range(4)]):
        for frame in frames:
            for tensor in (frame.tokens, frame.keys_values):
                assert tensor.untyped_storage().nbytes() == tensor.nbytes
