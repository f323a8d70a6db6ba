"""The reader of whole views: reading touches E alone, and depends on nothing else."""

from dataclasses import replace

import pytest
import torch

from viewmend.inpainting.checkpoint import MismatchedWeightsError, load_inpainter, save_inpainter
from viewmend.inpainting.protocol import ContextProvider, HeldOut, RenderQuality, State
from viewmend.inpainting.ray_sampling import subject_size_m
from viewmend.inpainting.sweep import pyramids
from viewmend.inpainting.sweep.cells import rim_depth, scattered
from viewmend.inpainting.sweep.config import OFFSETS, SweepConfig
from viewmend.inpainting.sweep.lookup import Scale
from viewmend.inpainting.sweep.pyramids import Rig
from viewmend.inpainting.sweep.sweep_net import SweepNet
from viewmend.rendering.crop import Crop
from viewmend.stream import Stream

SMALL = SweepConfig(num_views=4, width=8, place_channels=4, features=8, fine_features=8)


def test_only_e_is_read_and_everything_is_told(scene):
    stream, view, _ = scene
    torch.manual_seed(0)
    error = view.error * (torch.rand_like(view.error) < 0.3)
    mended = stream.mend(replace(view, error=error)).completed
    kept = error == 0
    assert torch.equal(mended.rgb[:, kept], view.rgb[:, kept])
    assert bool((mended.rgb[:, ~kept] != view.rgb[:, ~kept]).any())
    assert torch.equal(mended.alpha[kept], view.mask[kept]) and torch.equal(mended.depth[kept], view.depth[kept])
    for image in (mended.rgb, mended.alpha, mended.confidence):
        assert float(image.min()) >= 0 and float(image.max()) <= 1 + 1e-6
    assert float(mended.confidence[kept & (view.mask == 0)].abs().max()) == 0
    read = ~kept & (mended.alpha > 0.5)
    moved = mended.depth[read] - rim_depth(view.depth)[read]
    size = float(subject_size_m(view))
    within = (moved > (OFFSETS[0] - 0.04) * size) & (moved < (OFFSETS[-1] + 0.04) * size)
    assert float(within.float().mean()) > 0.95, "but where a cell is of a nearer surface"


def test_soft_e_blends(scene):
    stream, view, _ = scene
    whole, half, none = (stream.mend(replace(view, error=share * view.error)).completed for share in (1.0, 0.5, 0.0))
    torch.testing.assert_close(half.rgb, (whole.rgb + view.rgb) / 2)
    torch.testing.assert_close(half.alpha, (whole.alpha + view.mask) / 2)
    assert none.rgb is view.rgb and none.alpha is None


def test_what_a_part_reads_it_reads_by_the_whole_views_scale(scene):
    stream, view, rig = scene
    net, scale, part = stream.inpainter, Scale.of(view), Crop(0, 16, 96, 83)
    with torch.no_grad():
        whole, read, other = net(view, rig, scale), net(part.of_view(view), rig, scale), net(part.of_view(view), rig)
    depth = scattered(whole.depth[:, None], whole.pixels, view.mask.shape)[0, 32:]
    mine = scattered(read.depth[:, None], read.pixels, torch.Size((67, 96)))[0, 16:]
    assert float((depth - mine).abs().median()) < 1e-3 * scale.size_m
    assert not torch.equal(other.depth, read.depth)


def test_colours_come_from_the_cameras(scene):
    """A reader that trusts its lookups shows another person where cameras do."""
    stream, view, rig = scene
    frame = rig.views.frame
    green = torch.zeros_like(frame.rgb)
    green[:, 1] = 255
    other = Rig.of(replace(rig.views, frame=replace(frame, rgb=green)), view.silhouettes)
    net = stream.inpainter
    blind = replace(view, rgb=torch.zeros_like(view.rgb))
    with torch.no_grad():
        read = net(blind, other)
    assert float(read.rgb[:, 0].max()) == 0 and float(read.rgb[:, 1].mean()) > 5 * float(read.rgb[:, 2].max())


def test_without_cameras_nothing_is_mended(scene):
    stream, view, _ = scene
    completed, state = stream.inpainter.step(view, ContextProvider(lambda *_: None), State())
    assert completed.rgb is view.rgb and completed.alpha is None and state == State()


def test_it_is_written_and_loads_and_reads_the_same(scene, tmp_path):
    stream, view, rig = scene
    net = stream.inpainter
    save_inpainter(net, tmp_path / "model", "# card")
    again = load_inpainter(tmp_path / "model", precision="float32")
    assert isinstance(again, SweepNet) and again.config == SMALL
    assert torch.equal(again(view, rig).rgb, net(view, rig).rgb)
    config = tmp_path / "model" / "config.json"
    config.write_text(config.read_text().replace('"sweep"', '"sweeping"'))
    with pytest.raises(MismatchedWeightsError, match="expected the network 'chain' or 'sweep', got 'sweeping'"):
        load_inpainter(tmp_path / "model")


@pytest.mark.parametrize("values", [{"width": 0}, {"width": 2.5}, {"depth": 3}, {"features": True}, {"width": 10**9}])
def test_impossible_sizes_are_refused(values):
    with pytest.raises(ValueError, match="expected whole numbers of"):
        SweepConfig.from_dict(values)


@pytest.mark.gpu
def test_cuda_reads_what_the_cpu_reads(scene):
    stream, view, rig = scene
    net = stream.inpainter
    expected = net(view, rig)
    import copy

    from viewmend.training.samples import to_device

    on_gpu = to_device(view, "cuda")
    got = copy.deepcopy(net).cuda()(on_gpu, Rig.of(rig.views.to("cuda"), on_gpu.silhouettes))
    off = (got.rgb.cpu() - expected.rgb).abs().amax(1)
    assert float((off > 0.02).float().mean()) < 0.01


def test_the_rule_all_asks_for_the_rim_too(scene):
    """The subject may reach beyond the proxy: what is read there has an alpha of its own."""
    stream, view, rig = scene
    rim = (view.mask == 0) & (view.error > 0)
    assert int(rim.sum()) > 50 and torch.equal(rim, (rim_depth(view.depth) > 0) & (view.mask == 0))
    torch.manual_seed(0)
    with torch.no_grad():
        found = SweepNet(SMALL)(view, rig)
    assert int(rim[tuple(found.pixels.T)].sum()) == int(rim.sum())
    completed = stream.mend(view).completed
    assert bool((completed.alpha[rim] > 0).all()) and not bool((completed.alpha[~rim & (view.mask == 0)] > 0).any())


def test_what_pixels_guess_is_what_the_coarse_fill_makes_of_holes(scene):
    _, view, rig = scene
    for net in (SweepNet(SMALL), SweepNet(replace(SMALL, coarse_fill="rays"))):
        guess = net.coarse_guess(view, rig.views)
        wanted = net.coarse([replace(view, error=view.holes.float())], [rig.views])[0]
        torch.testing.assert_close(guess, wanted, atol=1e-6, rtol=0)
        torch.manual_seed(0)
        with torch.no_grad():
            assert torch.equal(net(view, rig).rgb, net(view, rig, guess=guess).rgb)
            assert not torch.equal(net(view, rig).rgb, net(view, rig, guess=1 - guess).rgb)


def test_pyramids_of_a_time_are_made_once_for_all_views(scene, monkeypatch):
    stream, view, _ = scene
    stream = Stream(stream.inpainter, stream.config)
    observation = stream.push(scene[0].observation().frame)
    before, halvings, whole = observation.size, [], pyramids.halved
    monkeypatch.setattr(pyramids, "halved", lambda image: halvings.append(image.shape) or whole(image))
    first = stream.mend(view).completed
    made = len(halvings)
    assert made > 4 and observation.size > before + 1.3 * view.silhouettes.mask.numel(), "and its memory is counted"
    assert torch.equal(stream.mend(view).completed.rgb, first.rgb) and len(halvings) == made
    stream.mend(replace(view, candidate_views=view.candidate_views[::-1]))
    assert made < len(halvings) < 2 * made, "only the camera that nobody needed before"


def test_a_slope_softens_alpha_and_the_colours_that_lie_under_it(scene):
    stream, view, _ = scene
    context = ContextProvider(lambda _, names: stream.observation().context(names))
    net = stream.inpainter
    plain, _ = net.step(view, context, State())
    net.alpha_slope = 0.5
    try:
        soft, _ = net.step(view, context, State())
    finally:
        net.alpha_slope = 1.0
    read = (view.error > 0) & (plain.alpha > 0.001) & (plain.alpha < 0.999)
    assert int(read.sum()) > 50
    torch.testing.assert_close(soft.alpha[read], (0.5 * plain.alpha[read].logit()).sigmoid(), atol=1e-5, rtol=0)
    torch.testing.assert_close(
        soft.rgb[:, read] / soft.alpha[read], plain.rgb[:, read] / plain.alpha[read], atol=1e-3, rtol=0
    )
    assert torch.equal(soft.rgb[:, view.error == 0], view.rgb[:, view.error == 0])


def test_a_net_is_fitted_by_what_cameras_saw_and_the_net_that_is_asked_stays(scene):
    """Truth that is the net's own view made softer: it is found, and read by no other weights."""
    stream, view, _ = scene
    context = ContextProvider(lambda _, names: stream.observation().context(names))
    net = stream.inpainter
    net.alpha_slope = 0.6
    truth = net.step(view, context, State())[0].rgb
    net.alpha_slope = 1.0
    fitted = net.fitted_to_rig([HeldOut(view, context, truth)])
    assert fitted.alpha_slope == pytest.approx(0.6) and net.alpha_slope == 1.0
    assert fitted.fitted_to_rig([HeldOut(view, context, truth)]).alpha_slope == pytest.approx(0.6)
    assert next(fitted.parameters()) is next(net.parameters())


def test_holes_show_mostly_what_rays_read(scene):
    """And nothing of it where they were guessed from their surroundings, or by a net without rays."""
    stream, view, _ = scene
    net = SweepNet(replace(SMALL, coarse_fill="rays")).eval()
    context = ContextProvider(lambda _, names: stream.observation().context(names))
    hidden = replace(
        view, weights=torch.where((view.mask > 0) & (torch.arange(view.mask.shape[1]) < 48), 0, view.weights)
    )
    assert int(hidden.holes.sum()) > 100
    seen = stream.observation().context(hidden.closest_views(4))
    guess = net.coarse_guess(hidden, seen)
    own = net(hidden, Rig.of(seen, hidden.silhouettes), guess=guess, read=hidden.error > 0)
    own = scattered(own.rgb, own.pixels, hidden.mask.shape)
    found = net.step(hidden, context, State())[0].rgb
    wanted = torch.where(hidden.holes, 0.7 * guess + 0.3 * own, own)
    read = hidden.error > 0
    torch.testing.assert_close(found[:, read], wanted[:, read], atol=1e-4, rtol=0)
    quick = ContextProvider(lambda _, names: stream.observation().context(names), RenderQuality(read_fraction=0.5))
    from_around = net.coarse_guess(hidden, seen, quick=True)
    own = net(hidden, Rig.of(seen, hidden.silhouettes), guess=from_around, read=hidden.error > 0)
    own = scattered(own.rgb, own.pixels, hidden.mask.shape)
    torch.testing.assert_close(net.step(hidden, quick, State())[0].rgb[:, read], own[:, read], atol=1e-4, rtol=0)
