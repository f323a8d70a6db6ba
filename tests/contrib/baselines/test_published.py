"""Baselines by name: what each name runs, with which weights, and never with random ones."""

import os

import pytest
import torch
from safetensors.torch import load_file, save_file

from viewmend.contrib.baselines.e2fgvi import E2FGVIHQ
from viewmend.contrib.baselines.online import OnlineInpainter
from viewmend.contrib.baselines.published import NETWORKS, make_baseline
from viewmend.contrib.baselines.token_transformers import DSTT
from viewmend.metrics.weights import FOLDERS_VARIABLE
from viewmend.models.registry import MethodMissing, make_method
from viewmend.utils.weight_files import WeightsError


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """A folder with DSTT's weights, its authors' and ours, and E2FGVI-HQ's."""
    folder = tmp_path_factory.mktemp("weights")
    (folder / "finetuned" / "dstt").mkdir(parents=True)
    torch.manual_seed(0)
    torch.save({"netG": DSTT().state_dict()}, folder / "DSTT.pth")
    torch.save(E2FGVIHQ().state_dict(), folder / "E2FGVI-HQ-CVPR22.pth")
    save_file(DSTT().state_dict(), folder / "finetuned" / "dstt" / "model.safetensors")
    return folder


@pytest.fixture(autouse=True)
def places(weights, tmp_path, monkeypatch):
    monkeypatch.setenv(FOLDERS_VARIABLE, os.pathsep.join([str(tmp_path), str(weights)]))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))


def test_a_name_says_which_network_is_run_how_and_with_which_weights(weights):
    official = torch.load(weights / "DSTT.pth", weights_only=True)["netG"]["encoder.0.weight"]
    tuned = load_file(weights / "finetuned/dstt/model.safetensors")["encoder.0.weight"]
    for name, framing, grid, expected in (
        ("dstt-o-def", "def", "absolute", official),
        ("dstt-o-win-finetuned", "win", "absolute", tuned),
        ("dstt-o-mul-relative-finetuned", "mul", "relative", tuned),
        (f"dstt-o-mul@{weights / 'DSTT.pth'}", "mul", "absolute", official),
        (f"dstt-o-def@{weights / 'finetuned/dstt'}", "def", "absolute", tuned),
    ):
        inpainter = make_baseline(name)
        assert isinstance(inpainter, OnlineInpainter) and isinstance(inpainter.network, DSTT)
        config = inpainter.config
        assert (config.framing, config.sampling.grid, config.size_px) == (framing, grid, (240, 432))
        assert torch.equal(inpainter.network.encoder[0].weight, expected) and not torch.equal(official, tuned)
    assert isinstance(make_baseline("e2fgvi-hq-o-win").network, E2FGVIHQ)


def test_another_networks_weights_are_refused(weights):
    with pytest.raises(WeightsError, match="the 243 tensors of E2FGVI, got 244"):
        make_baseline(f"e2fgvi-o-def@{weights / 'E2FGVI-HQ-CVPR22.pth'}")
    with pytest.raises(WeightsError, match="found none; check the path"):
        make_baseline(f"dstt-o-def@{weights / 'absent'}")


@pytest.mark.parametrize(
    "name", ["dstt", "dstt-o", "dstt-x-def", "dstt-o-all", "sttn-o-def", "dstt-o-def@", "telea"]
)
def test_other_names_are_none(name):
    with pytest.raises(ValueError, match="expected a name like dstt-o-def"):
        make_baseline(name)


@pytest.mark.parametrize("network", sorted(set(NETWORKS) - {"dstt"}))
def test_every_network_is_reached_through_the_registry(network):
    with pytest.raises(MethodMissing, match="found none; get it from"):
        make_method(f"{network}-o-mul-relative-finetuned")
