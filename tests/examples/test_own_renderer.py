"""The example completes views of another renderer."""

import importlib.util
from pathlib import Path

import pytest
import torch

from viewmend.models.checkpoint import load_inpainter

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "own_renderer.py"


@pytest.fixture(scope="module")
def example():
    spec = importlib.util.spec_from_file_location("own_renderer", EXAMPLE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_views_of_another_renderer_are_completed(example):
    completed, truth = example.run(load_inpainter("views"), frames=2, size=96)
    view = completed.view
    holes, right = view.error > 0, view.error == 0
    assert 0.02 < float(holes.sum()) / float(view.mask.sum()) < 0.6
    assert torch.equal(completed.rgb[:, right], view.rgb[:, right])
    black = truth.rgb[0] / 255 * (truth.mask[0] / 255)
    left, mended = ((rgb - black)[:, holes].square().mean() for rgb in (view.rgb, completed.rgb))
    assert mended < 0.3 * left
