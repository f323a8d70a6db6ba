"""The default model: it changes E only, and predicts colours from the source cameras, with alpha and depth."""

from dataclasses import replace

import pytest
import torch

from viewmend.geometry.rim import rim_depth
from viewmend.models.base import ContextProvider, RenderQuality, State
from viewmend.models.views import model, prediction, pyramids
from viewmend.models.views.config import OFFSETS, ViewsConfig
from viewmend.models.views.grid import CELL_PX, detail_bands, scatter_to_image
from viewmend.models.views.model import ViewSynthNet
from viewmend.models.views.prediction import DepthDistribution, artefact_islands
from viewmend.models.views.pyramids import SceneScale, SourceCameras
from viewmend.rendering.crop import Crop
from viewmend.stream import Stream


def context_of(stream, quality=None):
    return ContextProvider(lambda _, names: stream.cached_frame().context(names), quality)


def image_of(prediction, view):
    return scatter_to_image(prediction.rgb, prediction.pixels, view.mask.shape)


def test_only_e_changes(scene):
    stream, view, _ = scene
    torch.manual_seed(0)
    error = view.error * (torch.rand_like(view.error) < 0.3)
    completed = stream.mend(replace(view, error=error)).completed
    kept = error == 0
    assert torch.equal(completed.rgb[:, kept], view.rgb[:, kept])
    assert bool((completed.rgb[:, ~kept] != view.rgb[:, ~kept]).any())
    assert torch.equal(completed.alpha[kept], view.mask[kept]) and torch.equal(
        completed.depth[kept], view.depth[kept]
    )
    for image in (completed.rgb, completed.alpha, completed.confidence):
        assert float(image.min()) >= 0 and float(image.max()) <= 1 + 1e-6
    assert float(completed.confidence[kept & (view.mask == 0)].abs().max()) == 0
    subject = ~kept & (completed.alpha > 0.5)
    moved, size = completed.depth[subject] - rim_depth(view.depth)[subject], SceneScale.of(view).size_m
    within = (moved > (OFFSETS[0] - 0.04) * size) & (moved < (OFFSETS[-1] + 0.04) * size)
    assert float(within.float().mean()) > 0.95, "except where a cell belongs to a nearer surface"


def test_soft_e_blends(scene):
    stream, view, _ = scene
    whole, half, none = (
        stream.mend(replace(view, error=share * view.error)).completed for share in (1.0, 0.5, 0.0)
    )
    torch.testing.assert_close(half.rgb, (whole.rgb + view.rgb) / 2)
    torch.testing.assert_close(half.alpha, (whole.alpha + view.mask) / 2)
    assert none.rgb is view.rgb and none.alpha is None


@torch.no_grad()
def test_detail_of_a_magnified_view_follows_the_source_cameras(scene, monkeypatch):
    """A camera of three times the pixels in each direction: detail is added at three times the scale."""
    stream = scene[0]
    stored = stream.cached_frame().frame.cameras[0]
    width, height = stored.max_size_px
    found = []

    def record(*arguments):
        found.append(arguments[-1])
        return detail_bands(*arguments)

    monkeypatch.setattr(model, "detail_bands", record)
    for factor in (1, 3):
        stream.view(stored.resized(factor * width, factor * height))
    assert found == pytest.approx([1, 3], rel=0.15)


@torch.no_grad()
def test_a_magnified_view_has_larger_cells(scene, monkeypatch):
    stream, _, sources = scene
    net = stream.inpainter
    stored = stream.cached_frame().frame.cameras[0]
    width, height = stored.max_size_px
    blend, found = net._blend, []

    def record(*arguments):
        found.append(arguments[-1])
        return blend(*arguments)

    monkeypatch.setattr(net, "_blend", record)
    for factor in (1, 2, 4):
        stream.view(stored.resized(factor * width, factor * height))
    assert [distribution.cell_px for distribution in found] == [CELL_PX, CELL_PX, 2 * CELL_PX]
    net(stream.render(stored.resized(4 * width, 4 * height)), sources)
    assert found[3].cell_px == CELL_PX, "as in training and in exported models"
    assert len(found[2].cells) < 0.3 * len(found[3].cells)


@pytest.mark.parametrize("cell_px", [2, 4])
def test_values_of_cells_are_interpolated_at_the_centres_of_pixels(cell_px):
    """A plane over the cells is a plane over the pixels; beyond the outermost centres it is constant."""
    cells = torch.nonzero(torch.ones(5, 6))
    values = (3 * cells[:, :1] - 2 * cells[:, 1:]).float()
    nothing = torch.zeros(0)
    index = torch.arange(30).view(5, 6)
    distribution = DepthDistribution(
        cells, index, nothing, nothing, nothing, None, nothing, cell_px
    )  # only the cells are used
    pixels = torch.nonzero(torch.ones(5 * cell_px, 6 * cell_px))
    at = ((pixels + 0.5) / cell_px - 0.5).clamp(min=0)
    at = torch.minimum(at, torch.tensor([4.0, 5.0]))
    expected = 3 * at[:, :1] - 2 * at[:, 1:]
    torch.testing.assert_close(distribution.interpolate(values, pixels), expected)


@torch.no_grad()
def test_a_crop_has_the_scale_of_the_whole_view(scene):
    stream, view, sources = scene
    net, scale, crop = stream.inpainter, SceneScale.of(view), Crop(0, 16, 96, 83)
    whole, (part, other) = net(view, sources), (net(crop.of_view(view), sources, s) for s in (scale, None))
    depth = scatter_to_image(whole.depth[:, None], whole.pixels, view.mask.shape)[0, 32:]
    own = scatter_to_image(part.depth[:, None], part.pixels, torch.Size((67, 96)))[0, 16:]
    assert float((depth - own).abs().median()) < 1e-3 * scale.size_m
    assert not torch.equal(other.depth, part.depth)


@torch.no_grad()
def test_colours_come_from_the_source_cameras(scene):
    stream, view, sources = scene
    green = torch.zeros_like(sources.views.frame.rgb)
    green[:, 1] = 255
    frame = replace(sources.views.frame, rgb=green)
    other = SourceCameras.of(replace(sources.views, frame=frame), view.silhouettes)
    found = stream.inpainter(replace(view, rgb=torch.zeros_like(view.rgb)), other)
    assert float(found.rgb[:, 0].max()) == 0 and float(found.rgb[:, 1].mean()) > 5 * float(
        found.rgb[:, 2].max()
    )


@torch.no_grad()
def test_colours_of_holes_do_not_exceed_alpha(scene):
    stream, view, sources = scene
    found, predicted = stream.inpainter(view, sources), rim_depth(view.depth) > 0
    found = found._replace(alpha=0.5 * found.alpha, rgb=0.5 * found.rgb)
    open_view = replace(view, weights=torch.zeros_like(view.weights))
    completed = found.composite_into(open_view, predicted, ~predicted, torch.ones_like(view.rgb))
    assert (
        bool((completed.rgb <= completed.alpha).all()) and int((completed.rgb == completed.alpha).sum()) > 500
    )


def test_without_cameras_the_view_stays(scene):
    stream, view, _ = scene
    completed, state = stream.inpainter.step(view, ContextProvider(lambda *_: None), State())
    assert completed.rgb is view.rgb and completed.alpha is None and state == State()


@torch.no_grad()
def test_chunks_of_rays_give_the_same(scene, monkeypatch):
    stream, view, sources = scene
    whole = stream.inpainter(view, sources)
    monkeypatch.setattr(pyramids, "CPU_RAYS", 29)
    torch.testing.assert_close(stream.inpainter(view, sources).rgb, whole.rgb, atol=1e-5, rtol=0)


def test_all_implementations_predict_the_same_from_the_cameras_chosen_for_each_ray(scene, monkeypatch):
    """Compiled kernels, PyTorch with gradients, and PyTorch alone."""
    stream, view, sources = scene
    monkeypatch.setattr(model, "RAY_VIEWS", 2)
    with torch.no_grad():
        fast = stream.inpainter(view, sources)
        monkeypatch.setattr(SourceCameras, "use_kernels", False)
        plain = stream.inpainter(view, sources)
    monkeypatch.undo()
    monkeypatch.setattr(model, "RAY_VIEWS", 2)
    trained = stream.inpainter(view, sources)
    assert fast.distribution.cameras.shape == (len(fast.distribution.cells), 2)
    assert fast.trust.shape == (len(fast.pixels), 2)
    for other in (plain, trained):
        assert float((other.rgb.detach() - fast.rgb).abs().amax(1).quantile(0.99)) < 1e-3


@pytest.mark.parametrize(
    "values", [{"width": 0}, {"width": 2.5}, {"depth": 3}, {"features": True}, {"width": 10**9}]
)
def test_impossible_sizes_are_refused(values):
    with pytest.raises(ValueError, match="expected"):
        ViewsConfig.from_dict(values)


@pytest.mark.gpu
def test_cuda_predicts_what_the_cpu_predicts(scene):
    import copy

    from viewmend.utils.tensors import to_device

    stream, view, sources = scene
    on_gpu = to_device(view, "cuda")
    found = copy.deepcopy(stream.inpainter).cuda()(
        on_gpu, SourceCameras.of(sources.views.to("cuda"), on_gpu.silhouettes)
    )
    off = (found.rgb.cpu() - stream.inpainter(view, sources).rgb).abs().amax(1)
    assert float((off > 0.02).float().mean()) < 0.01


@torch.no_grad()
def test_the_rim_is_predicted_too(scene):
    """The subject may extend beyond the proxy: the rim gets an alpha of its own."""
    stream, view, sources = scene
    rim = (view.mask == 0) & (view.error > 0)
    assert int(rim.sum()) > 50 and torch.equal(rim, (rim_depth(view.depth) > 0) & (view.mask == 0))
    found = stream.inpainter(view, sources)
    assert int(rim[tuple(found.pixels.T)].sum()) == int(rim.sum())
    completed = stream.mend(view).completed
    assert bool((completed.alpha[rim] > 0).all()) and not bool(
        (completed.alpha[~rim & (view.mask == 0)] > 0).any()
    )


def test_pyramids_of_a_frame_are_computed_once_for_all_views(scene, monkeypatch):
    stream, view, _ = scene
    stream = Stream(stream.inpainter, stream.config)
    cached = stream.add_frame(scene[0].cached_frame().frame)
    before, halvings, whole = cached.size, [], pyramids.downsample2x
    monkeypatch.setattr(pyramids, "downsample2x", lambda image: halvings.append(image.shape) or whole(image))
    first = stream.mend(view).completed
    made = len(halvings)
    assert made > 4 and cached.size > before + 1.3 * view.silhouettes.mask.numel(), (
        "and its memory is counted"
    )
    assert torch.equal(stream.mend(view).completed.rgb, first.rgb) and len(halvings) == made
    stream.mend(replace(view, candidate_views=view.candidate_views[::-1]))
    assert made < len(halvings) < 2 * made, "only the camera that no view needed before"


@torch.no_grad()
def test_holes_are_mostly_the_ray_fill(scene, small_views):
    """Not if they were filled from their surroundings, for a model that predicts a part of E only."""
    stream, view, _ = scene
    net = ViewSynthNet(replace(small_views, coarse_fill="rays")).eval()
    left = torch.arange(view.mask.shape[1]) < 48
    holed = replace(view, weights=torch.where((view.mask > 0) & left, 0, view.weights))
    holes, where = holed.holes, view.error > 0
    assert int(holes.sum()) > 100
    sources = SourceCameras.of(stream.cached_frame().context(holed.closest_views(4)), holed.silhouettes)
    filled = net.fill_holes(holed, sources)
    assert torch.equal(filled, net.coarse(replace(holed, error=holes.float()), sources))
    own = image_of(net(holed, sources, filled=filled, where=where), view)
    found = net.step(holed, context_of(stream), State())[0]
    wanted = torch.where(holes, torch.minimum(0.7 * filled + 0.3 * own, found.alpha), own)
    torch.testing.assert_close(found.rgb[:, where], wanted[:, where], atol=1e-4, rtol=0)
    filled = net.fill_holes(holed, sources, quick=True)
    own = image_of(net(holed, sources, filled=filled, where=where), view)
    found = net.step(holed, context_of(stream, RenderQuality(refine_fraction=0.5)), State())[0].rgb
    torch.testing.assert_close(found[:, where], own[:, where], atol=1e-4, rtol=0)


@pytest.mark.parametrize(
    ("side", "alpha", "rendered", "stays"),
    [
        *((2, 1.0, False, False), (6, 0.4, False, False), (6, 1.0, False, True)),
        *((16, 0.4, False, True), (2, 1.0, True, True)),
    ],
)
def test_artefact_islands_are_small(side, alpha, rendered, stays):
    """Tiny islands are, and small faint ones; not those of which any pixel was rendered."""
    coverage, predicted = torch.zeros(83, 96), torch.ones(83, 96, dtype=torch.bool)
    coverage[:60, :80] = 1.0
    coverage[64 : 64 + side, 64 : 64 + side] = alpha
    predicted[64, 64] = not rendered
    remains = artefact_islands(torch.stack([0.5 * coverage] * 3 + [coverage]), predicted)
    island = (coverage > 0) & (torch.arange(83) > 60)[:, None]
    assert remains is None if stays else torch.equal(remains, island)


def test_artefact_islands_are_removed_from_all_images(scene, monkeypatch):
    stream, view, _ = scene
    before, there = stream.mend(view).completed, torch.zeros_like(view.mask, dtype=torch.bool)
    there[30:40, 30:40] = True
    monkeypatch.setattr(prediction, "artefact_islands", lambda rgba, predicted: there & predicted)
    after, gone = stream.mend(view).completed, there & (view.error > 0)
    assert bool(gone.any()) and all(
        float(image[..., gone].abs().max()) == 0 for image in after.images.values()
    )
    assert all(
        torch.equal(image[..., ~gone], before.images[name][..., ~gone])
        for name, image in after.images.items()
    )
