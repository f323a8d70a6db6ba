"""The mean of the weights of several models."""

from dataclasses import replace

import pytest
import torch
from average_weights import average_weights
from training.conftest import MODEL

from viewmend.models.checkpoint import build, load_network, save_inpainter


def test_the_mean_is_a_model(tmp_path):
    models = []
    for seed in range(3):
        torch.manual_seed(seed)
        models.append(build(MODEL))
        save_inpainter(models[-1], tmp_path / str(seed), f"# {seed}\n\nSeed {seed}.\n")
    average_weights(tuple(str(tmp_path / str(seed)) for seed in range(3)), tmp_path / "mean")
    mean, states = load_network(tmp_path / "mean").state_dict(), [model.state_dict() for model in models]
    assert "\n## 1\n\nSeed 1.\n" in (tmp_path / "mean/README.md").read_text()
    for name, weight in mean.items():
        torch.testing.assert_close(weight, sum(state[name] for state in states) / 3)


def test_models_of_different_configs_and_single_models_are_refused(tmp_path):
    save_inpainter(build(MODEL), tmp_path / "a", "card")
    save_inpainter(build(replace(MODEL, use_depth=False)), tmp_path / "b", "card")
    with pytest.raises(ValueError, match="the same config"):
        average_weights((str(tmp_path / "a"), str(tmp_path / "b")), tmp_path / "mean")
    with pytest.raises(ValueError, match="two models or more, got 1"):
        average_weights((str(tmp_path / "a"),), tmp_path / "mean")
    assert not (tmp_path / "mean").exists()
