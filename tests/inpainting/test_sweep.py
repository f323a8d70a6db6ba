"""The reader of whole views: lookups equal their slow twins, reading touches E alone, and depends on nothing else."""

import time
from dataclasses import replace

import pytest
import torch

from viewmend.inpainting.checkpoint import MismatchedWeightsError, load_inpainter, save_inpainter
from viewmend.inpainting.coarse_fill import SmoothFill
from viewmend.inpainting.protocol import ContextProvider, HeldOut, RenderQuality, State
from viewmend.inpainting.ray_sampling import sample_along_rays, subject_size_m
from viewmend.inpainting.sweep import _lookup_torch, lookup, pyramids
from viewmend.inpainting.sweep._lookup_numba import look_up_numba
from viewmend.inpainting.sweep.cells import nearest_depth, rim_depth, scattered
from viewmend.inpainting.sweep.config import OFFSETS, SweepConfig
from viewmend.inpainting.sweep.error_net import ErrorMap, faded, most_wrong
from viewmend.inpainting.sweep.lookup import Rays, Scale, look_up
from viewmend.inpainting.sweep.place_net import PlaceNet
from viewmend.inpainting.sweep.pyramids import Rig, halved, silhouette_pyramids
from viewmend.inpainting.sweep.sweep_net import SweepNet
from viewmend.rendering.crop import Crop
from viewmend.rendering.view import RenderConfig
from viewmend.stream import Stream, StreamConfig
from viewmend.studio.stage import Studio, StudioConfig
from viewmend.views import Silhouettes

SMALL = SweepConfig(num_views=4, width=8, place_channels=4, features=8, fine_features=8)


@pytest.fixture(scope="module")
def scene():
    """A stream with one camera left out, its view by the rule `all`, and what four cameras saw."""
    studio = Studio(StudioConfig(seed=7, cameras=7, frames=1, size_px=(96, 83)))
    frame = studio.read(0)
    held, net = frame.cameras.names[2], SweepNet(SMALL)
    stream = Stream(net, StreamConfig(render=RenderConfig(error_rule="all"), memory_mb=None, fit_rig=False))
    observation = stream.push(frame.without([held]))
    view = stream.render(frame.cameras.select([held]))
    seen = observation.context(view.closest_views(4))
    return stream, view, Rig.of(seen, view.silhouettes)


def rays_of(view):
    pixels = torch.nonzero(view.mask > 0)
    z = view.depth[tuple(pixels.T)][:, None] + float(subject_size_m(view)) * torch.tensor(OFFSETS)
    return pixels, Rays(view.camera, pixels.flip(1).double() + 0.5, z)


def test_lookups_are_what_a_ray_reader_sees_at_the_finest_scale(scene, monkeypatch):
    """At full resolution colours, masks, angles and silhouettes are those of `sample_along_rays`."""
    _, view, rig = scene
    monkeypatch.setattr(lookup, "_eyes", finest(lookup._eyes))
    pixels, rays = rays_of(view)
    found = look_up(rays, rig, view.source_views, 1.0, Scale.of(view)).features
    wanted = sample_along_rays(view, pixels, rig.views, OFFSETS)
    assert len(pixels) > 500
    seen = wanted.features
    close = {"atol": 0.011, "rtol": 0}  # products with the mask are rounded to bytes
    torch.testing.assert_close(found[..., :3], seen.colour, **close)
    torch.testing.assert_close(found[..., 3:4], seen.mask, atol=1e-4, rtol=0)
    torch.testing.assert_close(found[..., 6:7], seen.viewing_cosine, atol=1e-4, rtol=0)
    torch.testing.assert_close(found[..., 7:8], seen.is_source, atol=0, rtol=0)
    torch.testing.assert_close(found[..., 8:9], seen.in_view, atol=0, rtol=0)
    least = look_up(rays, rig, view.source_views, 1.0, Scale.of(view)).stats[..., 6:8]
    torch.testing.assert_close(least, torch.cat(wanted.consistency[:2], -1), atol=1e-4, rtol=0)


def finest(eyes):
    def made(cameras, pyramids, step_m, middle):
        found = eyes(cameras, pyramids, step_m, middle)
        return found._replace(fine=tuple(lookup.Level(p.levels[0], 1.0) for p in pyramids))

    return made


@pytest.mark.parametrize("step_px", [1.0, 5.0])
def test_both_kernels_find_the_same(scene, step_px, monkeypatch):
    _, view, rig = scene
    _, rays = rays_of(view)
    rays = rays._replace(z_m=torch.where(torch.rand(rays.z_m.shape) < 0.1, 0.0, rays.z_m))
    fast = look_up(rays, rig, view.source_views, step_px, Scale.of(view))
    used = []

    def slow_kernel(*told):
        used.append(told)
        return _lookup_torch.look_up_torch(*told)

    monkeypatch.setattr("viewmend.inpainting.sweep._lookup_numba.look_up_numba", slow_kernel)
    slow = look_up(rays, rig, view.source_views, step_px, Scale.of(view))
    assert used and look_up_numba is not slow_kernel
    scales = {level.scale for level in (*used[0][1].fine, *used[0][1].wide)}
    assert max(scales) == {1.0: 1.0, 5.0: 0.25}[step_px], "levels follow the rays"
    for name, one, other in zip(fast._fields, fast, slow, strict=True):
        off = (one - other).abs()
        flips = (off > 1e-3).float().mean()  # the proxy's nearest pixel, where a position is between two
        assert float(flips) < 2e-3, name
        assert float(off.median()) < 1e-6, name
    assert float(fast.prior.sum(2).max()) <= 1 + 1e-5 and float(fast.stats[..., 3:6].max()) > 0.1


def test_levels_are_means_and_black_around():
    image = torch.zeros(7, 9, 1, dtype=torch.uint8)
    image[1:-1, 1:-1, 0] = torch.randint(0, 256, (5, 7), dtype=torch.uint8)
    half = halved(image)
    assert half.shape == (5, 6, 1) and int(half[0].sum() + half[-1].sum() + half[:, 0].sum() + half[:, -1].sum()) == 0
    inner = image[..., 0].int()
    assert int(half[1, 1, 0]) == (int(inner[1:3, 1:3].sum()) + 2) // 4
    assert int(half[3, 4, 0]) == (int(inner[5, 7]) + 2) // 4, "an odd side is made up for by black"


def test_the_subjects_size_is_measured_at_a_coarse_level():
    mask = torch.zeros(1, 64, 64, dtype=torch.uint8)
    mask[0, 8:40, 16:48] = 255
    cameras = Studio(StudioConfig(cameras=4, frames=1, size_px=64)).cameras.select(["cam00"])
    (pyramid,) = silhouette_pyramids(Silhouettes(mask, cameras))
    assert pyramid.subject_px == pytest.approx(32)
    assert [pyramid.level(px) for px in (0.3, 1.0, 1.5, 4.0, 1e9)] == [0, 0, 1, 2, len(pyramid.levels) - 1]


def test_trust_adds_up_and_blind_cameras_get_none(scene):
    _, view, rig = scene
    _, rays = rays_of(view)
    torch.manual_seed(0)
    places = look_up(rays, rig, view.source_views, 1.0, Scale.of(view))
    places.features[..., 1, :] = 0
    with torch.no_grad():
        weighed = PlaceNet(8, 4)(places)
    total, anyone = weighed.trust.sum(2), places.features[..., 8].sum(2) > 0
    torch.testing.assert_close(total, anyone.float())
    assert float(weighed.trust[..., 1].abs().max()) == 0
    mean = (weighed.trust[..., None] * places.features).sum(2)
    torch.testing.assert_close(weighed.colour, mean[..., :3])
    torch.testing.assert_close(weighed.mask, mean[..., 3:4])


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


def test_cells_have_the_nearest_depth():
    depth = torch.tensor([[0.0, 3.0, 0.0], [2.0, 5.0, 0.0], [0.0, 0.0, 4.0]])
    assert nearest_depth(depth).tolist() == [[2.0, 0.0], [0.0, 4.0]]


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


def test_the_rim_is_as_far_as_what_is_nearest_to_the_viewer_there():
    depth = torch.zeros(9, 12)
    depth[4, 4], depth[4, 5] = 3.0, 2.0
    rim = rim_depth(depth)
    assert rim[4, 4] == 3 and rim[4, 5] == 2, "what has a depth keeps it"
    assert rim[2, 2] == 3 and rim[6, 7] == 2 and rim[4, 3] == 2, "two pixels about the proxy"
    assert int((rim > 0).sum()) == 5 * 6


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


@pytest.fixture(scope="module")
def teller():
    torch.manual_seed(4)
    return SweepNet(replace(SMALL, error_features=8))


@torch.no_grad()
def test_errors_are_told_on_the_proxy_and_its_rim(scene, teller):
    _, view, rig = scene
    found = teller.errors(view, rig)
    there = rim_depth(view.depth) > 0
    for image in found:
        assert image.shape == view.mask.shape and not bool(image[~there].any())
        assert float(image[there].min()) > 0 and float(image.max()) < 1 and float(image[there].std()) > 1e-3
    blank = replace(view, rgb=0 * view.rgb)
    assert not torch.equal(teller.errors(blank, rig).wrong, found.wrong)
    other = replace(view, error=0 * view.error)
    assert torch.equal(teller.errors(other, rig).wrong, found.wrong), "E is what it is for"


def test_most_is_gained_first_and_holes_always(scene):
    _, view, _ = scene
    gain = torch.rand(view.mask.shape, generator=torch.Generator().manual_seed(0)) * (rim_depth(view.depth) > 0)
    hull, holes = int((view.mask > 0).sum()), view.holes
    error = most_wrong(view, gain, 0.3)
    chosen = error > 0
    assert int(holes.sum()) < 0.3 * hull and int(chosen.sum()) == int(0.3 * hull)
    assert bool(chosen[holes].all()) and float(gain[chosen & ~holes].min()) >= float(gain[~chosen].max())
    assert set(error.unique().tolist()) == {0.0, 1.0}
    assert torch.equal(most_wrong(view, gain, 1e-6) > 0, holes), "though that is more"
    nothing = most_wrong(view, 1e-5 * gain, 0.3) > 0
    assert torch.equal(nothing, holes), "what hardly changes is left"


def test_what_is_background_fades_and_is_not_read(scene, teller):
    """E is 1 where a view is read, and elsewhere how much of the colour goes; nothing else changes."""
    stream, view, _ = scene
    random = torch.Generator().manual_seed(0)
    rest, alpha = (torch.rand(view.mask.shape, generator=random) for _ in range(2))
    rest, alpha = rest * (rim_depth(view.depth) > 0), torch.where(alpha < 0.3, 1.0, alpha)
    part = faded(view, ErrorMap(rest, rest, alpha, rest), 0.3)
    hull = view.mask > 0
    assert torch.equal(part.read, most_wrong(view, rest, 0.3) > 0) and bool((part.error[part.read] == 1).all())
    left = hull & ~part.read
    assert torch.equal(part.error[left], torch.where(alpha < 0.98, 1 - alpha, 0.0)[left])
    assert not bool(part.error[~hull & ~part.read].any())
    mended = stream.mend(part).completed
    assert torch.equal(mended.rgb[:, left & (alpha == 1)], view.rgb[:, left & (alpha == 1)])
    torch.testing.assert_close(mended.rgb[:, left], ((1 - part.error) * view.rgb)[:, left])
    torch.testing.assert_close(mended.alpha[left], 1 - part.error[left])
    alone = stream.mend(replace(view, error=part.read.float())).completed
    assert torch.equal(mended.rgb[:, part.read], alone.rgb[:, part.read])
    assert float((mended.rgb - view.rgb)[:, part.read].abs().mean()) > 0.01
    nothing = replace(view, error=part.fade, fade=part.fade)
    dark, _ = stream.inpainter.step(nothing, ContextProvider(lambda *_: None), State())
    torch.testing.assert_close(dark.rgb, (1 - part.fade) * view.rgb)
    assert dark.alpha is not None and torch.equal(dark.alpha, (1 - part.fade) * view.mask)
    half = faded(replace(view, error=0.5 * view.error), ErrorMap(rest, rest, 0 * alpha, rest), 0.3)
    assert float(half.error.max()) == 0.5, "never more than was asked"
    whole, crop = Crop(16, 16, 80, 83), view.camera
    around = whole.uncropped(whole.of_view(part), crop)
    assert torch.equal(around.fade[16:, 16:80], part.fade[16:, 16:80]) and not bool(around.fade[:16].any())


def test_the_rule_wrong_asks_the_inpainter_or_the_shipped_model(scene, teller):
    """E of a stream: what the model that fills takes for wrong; where it cannot tell, the model for whole views."""
    stream, view, _ = scene
    frame = stream.observation().frame
    config = StreamConfig(render=RenderConfig(error_rule="wrong", wrong_fraction=0.5))
    own = Stream(teller, config)
    own.push(frame, stream.observation().proxy)
    narrowed = own.render(view.camera)
    chosen = narrowed.read
    hull = int((view.mask > 0).sum())
    assert bool(chosen[view.holes].all()) and not bool(chosen[view.error == 0].any())
    assert int(view.holes.sum()) < int(chosen.sum()) <= int(0.5 * hull)
    mended = own.view(view.camera).completed
    same = mended.view.error == 0
    assert torch.equal(mended.rgb[:, same], view.rgb[:, same])
    with pytest.raises(ValueError, match="a model that predicts errors"):
        silent = Stream(SweepNet(SMALL), config)
        silent.push(frame, stream.observation().proxy)
        silent.render(view.camera)


@pytest.mark.parametrize("fraction", [0.0, -1.0, 1.5, float("nan")])
def test_an_impossible_fraction_is_refused(fraction):
    with pytest.raises(ValueError, match="expected a wrong_fraction above 0"):
        RenderConfig(wrong_fraction=fraction)


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


def test_a_stream_asks_for_what_its_inpainter_is_made_for(scene):
    stream, view, _ = scene
    asked = {}
    for name, inpainter, rule in [
        ("reader", stream.inpainter, None),
        ("fill", SmoothFill(), None),
        ("told", SmoothFill(), "all"),
        ("held", stream.inpainter, "unseen"),
    ]:
        own = Stream(inpainter, StreamConfig(render=RenderConfig(error_rule=rule)))
        own.push(stream.observation().frame, stream.observation().proxy)
        asked[name] = own.render(view.camera).error
        assert torch.equal(own.view(view.camera).completed.view.error, asked[name])
    assert torch.equal(asked["reader"], view.error) and torch.equal(asked["told"], view.error)
    assert torch.equal(asked["fill"] > 0, view.holes) and torch.equal(asked["held"] > 0, view.holes)
    assert int(view.holes.sum()) > 0


def test_a_part_is_read_with_a_quick_guess(scene, monkeypatch):
    stream, view, _ = scene
    net = SweepNet(replace(SMALL, coarse_fill="rays", error_features=8)).eval()
    own, asked = Stream(net, StreamConfig()), []
    own.push(stream.observation().frame, stream.observation().proxy)
    monkeypatch.setattr(net.coarse, "forward", lambda *given: asked.append(given) or [view.rgb])
    own.view(view.camera, quality=RenderQuality(read_fraction=0.3))
    assert asked == []
    own.view(view.camera)
    assert len(asked) == 1


def test_a_quality_may_allow_only_a_part(scene, teller):
    stream, view, _ = scene
    hull, holes = int((view.mask > 0).sum()), int(view.holes.sum())

    def mended_px(rule, fraction, wrong_fraction=0.5, **more):
        render = RenderConfig(error_rule=rule, wrong_fraction=wrong_fraction)
        own = Stream(teller, StreamConfig(render=render))
        own.push(stream.observation().frame, stream.observation().proxy)
        quality = RenderQuality(read_fraction=fraction, **more)
        return [own.view(view.camera, quality=quality), own.mend(view, quality=quality)]

    for rule, allowed, most in [("all", 0.4, 0.4), ("wrong", 0.4, 0.4), ("wrong", 0.9, 0.5)]:
        seen, given = (int(one.completed.view.read.sum()) for one in mended_px(rule, allowed))
        assert holes < seen <= most * hull < 1.1 * seen
        assert given <= allowed * hull < 1.1 * given, "what other renderers ask for is narrowed, too"
    assert int((mended_px("unseen", 0.4)[0].completed.view.error > 0).sum()) == holes
    untouched = mended_px("all", 0.4, mend=False)[0].completed.view
    assert torch.equal(untouched.error, view.error), "nobody was to look"


def test_where_nothing_is_to_be_read_background_fades_and_holes_are_filled_from_around(scene, teller, monkeypatch):
    stream, view, _ = scene
    own = Stream(teller, StreamConfig())
    own.push(stream.observation().frame, stream.observation().proxy)
    monkeypatch.setattr(teller, "forward", lambda *given, **more: pytest.fail("nothing is read"))
    mended = own.view(view.camera, quality=RenderQuality(read_fraction=0.0)).completed
    assert mended.view.fade is not None and mended.confidence is not None
    part, filled = mended.view, SmoothFill()([replace(view, error=view.holes.float())], [None])[0]
    assert torch.equal(part.read, view.holes) and bool(view.holes.any())
    assert int((mended.view.fade > 0).sum()) > 20
    torch.testing.assert_close(mended.rgb[:, view.holes], filled[:, view.holes], atol=1e-3, rtol=0)
    rest = ~view.holes
    torch.testing.assert_close(mended.rgb[:, rest], ((1 - part.error) * view.rgb)[:, rest], atol=1e-5, rtol=0)
    torch.testing.assert_close(mended.opacity[rest], ((1 - part.error) * view.mask)[rest])
    assert not bool(mended.confidence[view.holes].any()) and bool((mended.confidence[rest] == view.mask[rest]).all())


def test_finding_what_is_wrong_is_paid_by_inpainting(scene, teller, monkeypatch):
    stream, view, _ = scene
    own = Stream(teller, StreamConfig())
    own.push(stream.observation().frame, stream.observation().proxy)
    own.view(view.camera, quality=RenderQuality(read_fraction=0.3))
    whole = teller.error_map
    monkeypatch.setattr(teller, "error_map", lambda *given: time.sleep(1.0) or whole(*given))
    times = own.view(view.camera, quality=RenderQuality(read_fraction=0.3)).times
    assert times.inpainting > 1000 > times.rendering


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
