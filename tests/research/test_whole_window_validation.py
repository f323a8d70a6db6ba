"""Weights compared on validation views with whole windows."""

from dataclasses import replace

import pytest
import torch
import whole_window_validation
from training.conftest import MODEL
from training.test_shared_rigs import SAMPLING, SCENES
from whole_window_validation import Options, main, make_views, validation_scenes

from viewmend.models.checkpoint import build, save_inpainter
from viewmend.scenes.held_out import PROCEDURAL_SEEDS
from viewmend.training.paper import WINDOW
from viewmend.training.shared_rigs import SharedRigScenes


@pytest.fixture
def small(monkeypatch):
    """Rigs of few cameras and a window of two frames, in place of those of 48."""
    config = replace(SCENES, protocols=("target-mask",))

    def scenes(_):
        return SharedRigScenes(config, SAMPLING, "0", "validation")

    monkeypatch.setattr(whole_window_validation, "validation_scenes", scenes)
    monkeypatch.setattr(whole_window_validation, "MIN_HOLE_PX", 20)


def test_weights_tokens_and_contexts_are_compared(small, tmp_path, capsys):
    for seed in (0, 1):
        torch.manual_seed(seed)
        save_inpainter(build(MODEL), tmp_path / str(seed), "card")
    weights = tuple(str(tmp_path / str(seed)) for seed in (0, 1))
    options = Options(data=tmp_path / "views", weights=weights, top_k=(8, 0), present=True, scenes=2)
    main(options)
    printed = capsys.readouterr().out
    rows = [line.strip("| ").split(" | ") for line in printed.splitlines() if line.startswith("| ")][2:]
    titles = [row[0].removeprefix(f"{tmp_path}/") for row in rows]
    assert titles[:3] == [
        "0, k = 8, whole window",
        "0, all tokens, whole window",
        "0, k = 8, present frame",
    ]
    assert titles[3] == "1, k = 8, whole window" and titles[6] == "Telea"
    assert rows[0][2] == "+0.00 ± 0.00"
    assert len({row[1] for row in rows}) > 3, "each variant completes the views in its own way"

    # The views are read, not made, the second time
    main(options)
    again = capsys.readouterr().out
    assert "rig" in printed and "rig" not in again
    first_scores = [row[1] for row in rows]
    assert [line.split(" | ")[1] for line in again.splitlines() if line.startswith("| ")][2:] == first_scores


def test_views_that_were_made_with_other_options_are_refused(small, tmp_path, monkeypatch):
    options = Options(data=tmp_path / "views", scenes=1)
    assert make_views(options) == make_views(options)
    monkeypatch.setattr(whole_window_validation, "MIN_HOLE_PX", 30)
    with pytest.raises(ValueError, match="expected views made with the same options"):
        make_views(options)


def test_views_are_those_of_the_papers_rig():
    source = validation_scenes(3)
    assert source.config.cameras == (48, 48) and source.config.rigs == ("layers",)
    assert source.config.sizes_px == (512,) and source.config.protocols == ("target-mask",)
    assert source.sampling.frames == WINDOW and source.sampling.window_fraction == 1
    assert source.split == "validation" and max(PROCEDURAL_SEEDS["validation"]) < 10_000


def test_other_models_are_refused(small, tmp_path):
    with pytest.raises(ValueError, match="model of the paper, got rays"):
        main(Options(data=tmp_path / "views", weights=("rays",), scenes=1))
