"""What is exported computes what the model computes, whatever the sizes, the rig and the holes."""

import subprocess
import sys
from dataclasses import replace

import pytest
import torch
from reference.random_views import holed, images, mended, random_view

from viewmend.export.traceable import (
    ExportedModel,
    ViewInputs,
    ViewOutputs,
    fill_any_size,
    pull_push_any_size,
)
from viewmend.models.checkpoint import save_inpainter
from viewmend.models.smooth_fill import fill, pull_push
from viewmend.models.views.config import ViewsConfig
from viewmend.models.views.model import ViewSynthNet

CONFIG = ViewsConfig(num_views=4, width=8, sample_channels=4, features=8, fine_features=8, coarse_fill="rays")


@pytest.fixture(scope="module")
def net():
    torch.manual_seed(0)
    return ViewSynthNet(CONFIG).eval().requires_grad_(False)


@pytest.mark.parametrize("seed", range(4))
def test_random_views_are_mended_as_the_model_does(net, seed):
    view, context = random_view(seed, net, longest=120)
    if seed % 2:
        view = holed(view)
        assert int(view.holes.sum()) > 50
    given, wanted = ViewInputs.of(view, context, net.config.num_views), images(mended(net, view, context))
    assert (wanted["completed_rgb"] - view.rgb).abs().max() > 0.05
    for name, got in zip(ViewOutputs._fields, ExportedModel(net)(*given), strict=True):
        off = (got - wanted[name]).abs()
        assert float((off > 1e-3).float().mean()) <= 1e-4, name
        assert float(off.median()) < 1e-6, name


def test_without_a_subject_the_view_stays(net):
    view, context = random_view(0, net, longest=100)
    nothing = torch.zeros_like(view.mask)
    empty = replace(
        view, rgb=0 * view.rgb, mask=nothing, error=nothing, depth=nothing, weights=0 * view.weights
    )
    assert not any(image.any() for image in ExportedModel(net)(*ViewInputs.of(empty, context, 4)))


def test_where_e_is_0_pixels_stay_bit_for_bit(net):
    view, context = random_view(2, net, longest=100)
    kept = view.error == 0
    got = ViewOutputs(*ExportedModel(net)(*ViewInputs.of(view, context, 4)))
    assert int(kept.sum()) > 500 and torch.equal(got.completed_rgb[:, kept], view.rgb[:, kept])
    assert torch.equal(got.completed_depth[kept], view.depth[kept])


@pytest.mark.parametrize("size", [(64, 64), (65, 131), (100, 77)])
def test_fills_of_any_size_are_those_of_the_coarse_fill(size):
    torch.manual_seed(1)
    rgb, missing = torch.rand(3, *size), torch.rand(size) < 0.02
    missing[10:40, 5:45] = True
    subject = torch.rand(size) < 0.9
    assert int(fill(rgb, missing, subject)[:, missing].isfinite().sum()) == 3 * int(missing.sum())
    torch.testing.assert_close(
        fill_any_size(rgb, missing, subject), fill(rgb, missing, subject), atol=1e-5, rtol=0
    )
    torch.testing.assert_close(pull_push_any_size(rgb, ~missing), pull_push(rgb, ~missing), atol=1e-5, rtol=0)
    assert float(pull_push_any_size(rgb, missing & ~missing).abs().max()) == 0, "nothing is known"


def test_cameras_that_the_view_does_not_name_are_in_no_input_that_is_looked_at(net):
    view, context = random_view(1, net, longest=100)
    given = ViewInputs.of(view, context, 4)
    others = torch.ones(len(given.images), dtype=torch.bool).index_fill(0, given.chosen, False)
    assert int(others.sum()) > 0
    images, depths = given.images.clone(), given.proxy_depths.clone()
    images[others], depths[others] = 7, 1e3
    again = ExportedModel(net)(*given._replace(images=images, proxy_depths=depths))
    assert all(torch.equal(one, other) for one, other in zip(ExportedModel(net)(*given), again, strict=True))
    masks = given.masks.clone()
    masks[others] = 0
    assert not torch.equal(ExportedModel(net)(*given._replace(masks=masks))[1], again[1]), (
        "but their silhouettes are"
    )


def test_a_view_that_names_one_camera_is_refused(net):
    view, context = random_view(0, net, longest=100)
    one = view.source_views[:1]
    alone = replace(view, candidate_views=one, source_views=one, weights=view.weights[:1])
    with pytest.raises(ValueError, match="at least two cameras with a frame, got"):
        ViewInputs.of(alone, context, 4)


@pytest.mark.slow
def test_the_model_is_traced_for_all_sizes(net, tmp_path):
    """In a process of its own: the type checks of tests are not to be traced."""
    save_inpainter(net, tmp_path / "tiny", "# card")
    load = f"load_inpainter({str(tmp_path / 'tiny')!r}, precision='float32')"
    code = "from viewmend.export.model import trace; from viewmend.models.checkpoint import load_inpainter"
    command = [sys.executable, "-c", f"{code}; print(trace({load}).range_constraints)"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "VR[2, 64]" in done.stdout, "any number of cameras"
