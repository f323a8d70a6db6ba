"""Laws that every inpainter of ours obeys, whatever its weights."""

from dataclasses import replace

import pytest
import torch
from inpainting.plates import NAMES, PLAIN, Rig, context, encode, patches, tiny, view

from viewmend.inpainting.chain import build
from viewmend.inpainting.config import paper
from viewmend.inpainting.context import window_times
from viewmend.inpainting.network import set_compute_dtype
from viewmend.inpainting.protocol import ContextProvider, RenderQuality


def mend(net, time, **options):
    """From scratch: all frames of the window, nothing remembered; clamped, as what `step` shows."""
    contexts = [context(t) for t in window_times(time, net.config)]
    with torch.no_grad():
        return net([view(time)], [contexts], ray_views=[context(time)], **options)[0].completed.clamp(0, 1)


def close(a, b, tolerance=2e-5):
    return torch.allclose(a, b, atol=tolerance, rtol=0)


def test_the_network_does_something():
    """Else the laws below would hold for nothing's sake."""
    incomplete, net = view(5), tiny()
    completed = mend(net, 5)
    holes = incomplete.error > 0
    assert (completed - incomplete.rgb)[:, holes].abs().mean() > 0.05
    with torch.no_grad():
        alone = net([incomplete], [[]])[0].completed
    assert (completed - alone)[:, holes].abs().mean() > 0.005


def test_known_pixels_stay_bit_for_bit():
    incomplete = view(5)
    completed, _ = tiny().step(incomplete, Rig(), tiny().initial_state())
    known = incomplete.error == 0
    assert torch.equal(completed.rgb[:, known], incomplete.rgb[:, known])
    assert not torch.equal(completed.rgb, incomplete.rgb)


@pytest.mark.parametrize(
    "changes",
    [{}, {"past_geometry": "current"}, PLAIN],
    ids=["ours", "current", "paper"],
)
def test_cached_equals_uncached(changes):
    net, rig = tiny(**changes), Rig()
    state, provider = net.initial_state(), ContextProvider(rig)
    for time in range(11):
        completed, state = net.step(view(time), provider, state)
        assert close(completed.rgb, mend(net, time)), time
    assert {time for time, _ in rig.asked} == set(range(11))
    assert len(rig.asked) == 11 * (2 if net is not patches(net) else 1), "each time is encoded once"


def test_a_stream_that_starts_late_or_leaps_equals_uncached():
    net, provider = tiny(), ContextProvider(Rig())
    state = net.initial_state()
    for time in (7, 8, 30, 29, 60):
        completed, state = net.step(view(time), provider, state)
        assert close(completed.rgb, mend(net, time)), time


def test_two_interleaved_streams_equal_each_alone():
    net = tiny()

    def alone(times):
        state, results, provider = net.initial_state(), [], ContextProvider(Rig())
        for time in times:
            completed, state = net.step(view(time), provider, state)
            results.append(completed.rgb)
        return results

    first, second = range(0, 6), range(20, 26)
    states, results = [net.initial_state(), net.initial_state()], [[], []]
    shared = ContextProvider(Rig())
    for pair in zip(first, second, strict=True):
        for i, time in enumerate(pair):
            completed, states[i] = net.step(view(time), shared, states[i])
            results[i].append(completed.rgb)
    for times, result in zip((first, second), results, strict=True):
        assert all(torch.equal(a, b) for a, b in zip(alone(times), result, strict=True))


def test_order_of_cameras_changes_nothing():
    net = tiny()
    frames = [f for t in (3, 2) for f in encode(net, context(t))]
    with torch.no_grad():
        one, other = (
            net([view(3)], [frames[::step]], ray_views=[context(3, NAMES[::step])])[0].completed for step in (1, -1)
        )
    assert close(one, other)
    swapped = replace(view(5), source_views=NAMES[::-1])
    assert close(net.step(swapped, Rig(), net.initial_state())[0].rgb, mend(net, 5))


@pytest.mark.parametrize("top_k", [10**6, 1000])
def test_all_patches_kept_equals_unpruned(top_k):
    net = tiny()
    assert close(mend(net, 5, top_k=top_k), mend(net, 5))


def test_pruning_prunes():
    net = tiny()
    assert not close(mend(net, 5, top_k=3), mend(net, 5), 1e-4)
    assert close(mend(net, 5, top_k=3), mend(tiny(top_k=3), 5))


def test_no_hole_costs_no_network():
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
def test_no_context_at_all_still_works(top_k):
    net, nothing = tiny(), Rig(start=1000)
    incomplete = view(5)
    provider = ContextProvider(nothing, RenderQuality(top_k=top_k))
    completed, _ = net.step(incomplete, provider, net.initial_state())
    assert completed.rgb.isfinite().all()
    everything = replace(incomplete, error=torch.ones_like(incomplete.error))
    completed, _ = net.step(everything, provider, net.initial_state())
    assert completed.rgb.isfinite().all()


def test_a_gap_in_one_camera_is_skipped():
    net, rig = tiny(), Rig(silent=frozenset({("left", 5), ("right", 4)}))
    completed, _ = net.step(view(5), rig, net.initial_state())
    frames = [context(5, ("right",)), context(4, ("left",)), context(3), context(1)]
    with torch.no_grad():
        expected = net([view(5)], [frames], ray_views=[context(5, ("right",))])[0].completed.clamp(0, 1)
    assert close(completed.rgb, expected)


@pytest.mark.parametrize(("width", "height"), [(28, 28), (29, 31), (97, 61), (20, 23), (64, 48), (101, 130)])
def test_any_size(width, height):
    size = {"width": width, "height": height}
    incomplete = view(5, (5, height - 6, 6, width - 4), **size)
    completed, _ = tiny().step(incomplete, Rig(**size), tiny().initial_state())
    assert completed.rgb.shape == (3, height, width) and completed.rgb.isfinite().all()
    holes = (incomplete.error > 0) & (incomplete.mask > 0)
    assert ((completed.rgb - incomplete.rgb).abs().amax(0)[holes] > 0).float().mean() > 0.9


@pytest.mark.parametrize("changes", [{}, PLAIN], ids=["ours", "paper"])
@pytest.mark.parametrize("top_k", [None, 5])
def test_gradients_reach_every_parameter(top_k, changes):
    net = tiny(**changes).train()
    contexts = [[context(5), context(4)], [context(6)]]
    prediction = net([view(5), view(6)], contexts, [context(5), context(6, ("left", "third", "right"))], top_k)
    sum((p.inpainted**2).sum() for p in prediction).backward()
    starved = [n for n, p in net.named_parameters() if p.grad is None or not bool((p.grad != 0).any())]
    assert not starved
    assert all(p.grad.isfinite().all() for p in net.parameters())


def test_gradients_reach_the_encoder_through_the_context_alone():
    net = tiny().train()
    frames = encode(net, context(5))
    loss = (net([view(5)], [frames])[0].inpainted ** 2).sum()
    for frame, gradient in zip(frames, torch.autograd.grad(loss, [f.keys_values for f in frames]), strict=True):
        assert bool((gradient != 0).any(-1).all()), frame.name
    cached = sum((f.keys_values**2).sum() for f in encode(net, context(5)))
    gradients = torch.autograd.grad(cached, list(patches(net).tokeniser.parameters()))
    assert all(bool((g != 0).any()) for g in gradients)


@pytest.mark.parametrize("changes", [{}, PLAIN], ids=["ours", "paper"])
@pytest.mark.parametrize("top_k", [None, 6])
def test_a_batch_equals_one_by_one(top_k, changes):
    net = tiny(**changes)
    views = [view(5), view(6, (30, 34, 40, 44)), view(7, hole=None), view(4, width=64, height=48)]
    contexts = [[context(5), context(4), context(3)], [context(6)], [], [context(4, width=120, height=100)]]
    ray_views = [context(5), None, None, context(4, ("left", "third", "right"), width=120, height=100)]
    with torch.no_grad():
        together = net(views, contexts, ray_views, top_k)
        for one, v, c, n in zip(together, views, contexts, ray_views, strict=True):
            alone = net([v], [c], [n], top_k)[0]
            assert close(one.completed, alone.completed) and close(one.inpainted, alone.inpainted)
            assert torch.equal(one.coverage, alone.coverage)


def test_bfloat16_is_close():
    net = tiny()
    exact = mend(net, 5)
    set_compute_dtype(net, torch.bfloat16)
    rounded = mend(net, 5)
    assert rounded.dtype == torch.float32
    assert 0 < float((exact - rounded).abs().max()) < 0.1
    assert float((exact - rounded)[:, view(5).error > 0].abs().mean()) < 0.01


def test_a_frame_keeps_alive_its_own_memory_only():
    """Also when it was encoded together with many others."""
    for frames in patches(tiny()).encode_contexts([context(t) for t in range(4)]):
        for frame in frames:
            for tensor in (frame.tokens, frame.keys_values):
                assert tensor.untyped_storage().nbytes() == tensor.nbytes


@pytest.mark.slow
def test_the_paper_size_keeps_known_pixels_too():
    incomplete = view(5)
    net = build(paper()).eval()
    completed, _ = net.step(incomplete, Rig(), net.initial_state())
    known = incomplete.error == 0
    assert torch.equal(completed.rgb[:, known], incomplete.rgb[:, known]) and completed.rgb.isfinite().all()
