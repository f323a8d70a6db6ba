"""A window gives what the whole images give, as far as its patches go; and knows nothing of what lies beyond."""

from dataclasses import replace

import pytest
import torch
from training.conftest import PLAN

from viewmend.inpainting.chain import build
from viewmend.inpainting.config import paper_small
from viewmend.inpainting.coordinates import reference_depth
from viewmend.training.objective import Objective
from viewmend.training.recipes import RECIPES
from viewmend.training.sample_files import read_shard, sample_to_bytes, write_shards
from viewmend.training.samples import Sample
from viewmend.training.scenes import StudioScenes
from viewmend.training.windows import MARGIN_PX, STEPS_ACROSS, WindowScenes, window
from viewmend.views import ContextViews, WindowPart

SIDE_PX, SEARCH_PX = 108, 16


def rounded(views: ContextViews) -> ContextViews:
    return replace(views, depth=views.depth.half().float())


@pytest.fixture(scope="module")
def whole() -> Sample:
    """A view of 288 x 288 pixels with a moment of past."""
    plan = replace(PLAN, sizes_px=(288,), held_cameras=1, context_cameras=(3,), context_weights=(1,), least_past=1)
    sample = StudioScenes(replace(plan, imperfect_fraction=0.0, ray_views=0), "windows").scene(0)[0]
    view = replace(sample.view, depth=sample.view.depth.half().float())
    return replace(sample, view=view, context=tuple(rounded(views) for views in sample.context))


@pytest.fixture(scope="module")
def cut(whole) -> Sample:
    return window(whole, middle(whole), SIDE_PX, SEARCH_PX)


def middle(sample: Sample) -> tuple[int, int]:
    missing = torch.nonzero(sample.view.error > 0)
    row, column = missing[len(missing) // 2].tolist()
    return row, column


def offset_px(part, own) -> tuple[int, int]:
    """Row and column at which a window begins in the whole image of its camera."""
    left, top = (own.K - part.K)[0, :2, 2].round().int().tolist()
    return top, left


def placed(inner, at, size) -> torch.Tensor:
    """A window's inner pixels in the whole image."""
    found = torch.zeros(size, dtype=torch.bool)
    height, width = (min(n, s - a) for n, s, a in zip(inner.shape, size, at, strict=True))
    found[at[0] : at[0] + height, at[1] : at[1] + width] = inner[:height, :width]
    return found


def as_parts(whole: Sample, cut: Sample) -> Sample:
    """The whole images, of which the window's patches alone count."""
    context = []
    for views, part in zip(whole.context, cut.context, strict=True):
        views = views.select(part.frame.cameras.names)
        size = views.depth.shape[1:]
        inner = []
        for n, own in enumerate(part.frame.cameras.size_px.tolist()):
            at = offset_px(part.frame.cameras[n], views.frame.cameras[n])
            inner.append(placed(part.part.inner[n, : own[1], : own[0]], at, size))
        context.append(replace(views, part=WindowPart((288, 288), reference_depth(views.depth), torch.stack(inner))))
    at = offset_px(cut.view.camera, whole.view.camera)
    inner = placed(cut.view.part.inner[0], at, whole.view.mask.shape)
    part = WindowPart((288, 288), reference_depth(whole.view.depth[None]), inner[None])
    return replace(whole, view=replace(whole.view, part=part), context=tuple(context))


@pytest.mark.parametrize("changes", [{}, {"rope_unit": "patch", "past_geometry": "own", "use_validity": True}])
def test_a_window_is_filled_as_the_whole_images_fill_it(whole, cut, changes):
    torch.manual_seed(0)
    net = build(replace(paper_small(), widths=(8,) * 9, dim=64, heads=2, blocks=2, top_k=None, **changes)).eval()
    with torch.no_grad():
        large, small = (net([s.view], [list(s.context)])[0] for s in (as_parts(whole, cut), cut))
    top, left = offset_px(cut.view.camera, whole.view.camera)
    height, width = cut.view.mask.shape
    rows, columns = slice(top, top + height), slice(left, left + width)
    assert float(small.coverage.mean()) > 0.1 and small.inpainted.std() > 1e-3
    assert torch.equal(large.coverage[rows, columns], small.coverage) and large.coverage.sum() == small.coverage.sum()
    torch.testing.assert_close(large.inpainted[:, rows, columns], small.inpainted, atol=2e-5, rtol=0)


def test_what_lies_outside_does_not_matter_and_what_lies_inside_does(whole, cut):
    def disturbed(inside: bool) -> Sample:
        context = []
        for views, part in zip(whole.context, cut.context, strict=True):
            rgb = views.frame.rgb.clone()
            for n, name in enumerate(part.frame.cameras.names):
                number = views.frame.cameras.names.index(name)
                top, left = offset_px(part.frame.cameras[n], views.frame.cameras[number])
                width, height = part.frame.cameras.size_px[n].tolist()
                there = torch.zeros(rgb.shape[2:], dtype=torch.bool)
                there[top : top + height, left : left + width] = True
                rgb[number, :, there if inside else ~there] ^= 255
            context.append(replace(views, frame=replace(views.frame, rgb=rgb)))
        return window(replace(whole, context=tuple(context)), middle(whole), SIDE_PX, SEARCH_PX)

    assert sample_to_bytes(disturbed(inside=False)) == sample_to_bytes(cut)
    assert sample_to_bytes(disturbed(inside=True)) != sample_to_bytes(cut)


def test_a_window_is_small_has_its_past_and_counts_its_own_holes_alone(whole, cut):
    assert max(cut.view.mask.shape) <= SIDE_PX + 2 * MARGIN_PX and len(cut.context) == len(whole.context) == 2
    shown, all_px = (sum(int(c.frame.cameras.size_px.prod(1).sum()) for c in s.context) for s in (cut, whole))
    assert shown < 0.75 * all_px and cut.view.silhouettes is None
    inner = cut.view.part.inner[0]
    assert int((cut.view.error * inner).sum()) > 0 and 0.8 * SIDE_PX**2 < int(inner.sum()) <= SIDE_PX**2
    recipe = replace(RECIPES["windows"](PLAN), model=replace(paper_small(), widths=(8,) * 9, dim=32, heads=2, blocks=1))
    net = build(recipe.model)
    assert Objective(net, recipe).model.context_gradients == recipe.context_gradients == 0.2
    before = Objective(net, recipe)([cut]).image
    beyond = torch.where(inner, cut.truth, cut.truth ^ 255)
    after = Objective(net, recipe)([replace(cut, truth=beyond)]).image
    assert torch.equal(before.inside, after.inside) and torch.equal(before.outside, after.outside)


def test_shards_of_windows_are_packed_and_come_back(whole, cut, tmp_path):
    (path,) = write_shards([cut, whole], tmp_path)
    again = read_shard(path)
    assert [sample_to_bytes(s) for s in again] == [sample_to_bytes(cut), sample_to_bytes(whole)]
    assert path.stat().st_size < 0.7 * len(sample_to_bytes(cut)) + len(sample_to_bytes(whole)) + 20_000


def test_scenes_give_windows_of_each_view(whole):
    class One:
        def scene(self, number):
            return [whole]

    plan = replace(PLAN, windows=3)
    first, again = (WindowScenes(One(), plan, "s").scene(4) for _ in range(2))
    assert len(first) == 3 and [sample_to_bytes(s) for s in first] == [sample_to_bytes(s) for s in again]
    sides = [int(s.view.part.inner[0].any(0).sum()) for s in first]
    assert all(0.8 * (28 + 16 * STEPS_ACROSS[0]) < side <= 28 + 16 * STEPS_ACROSS[1] for side in sides)
    assert all(bool((s.view.error * s.view.part.inner[0] > 0).any()) for s in first)
