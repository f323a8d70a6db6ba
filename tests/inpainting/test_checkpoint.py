"""Models on disk: whole, strict, and clear about what is wrong."""

import json
import shutil
from dataclasses import replace
from inspect import signature

import pytest
import torch
from inpainting.plates import Rig, tiny, view
from safetensors.torch import load_file, save_file

from viewmend import atomic_writes
from viewmend.inpainting import checkpoint, network
from viewmend.inpainting.chain import Chain
from viewmend.inpainting.checkpoint import (
    MissingCheckpointError,
    load_inpainter,
    load_network,
    save_inpainter,
)
from viewmend.inpainting.config import InpainterConfig, paper, small
from viewmend.inpainting.sweep.config import SweepConfig
from viewmend.inpainting.sweep.sweep_net import SweepNet
from viewmend.inpainting.temporal_accumulation import TemporalAccumulation
from viewmend.weight_files import DamagedWeightsError, MismatchedWeightsError


@pytest.fixture
def saved(tmp_path):
    save_inpainter(tiny(), tmp_path / "model", "# A card")
    return tmp_path / "model"


def test_what_is_saved_comes_back(saved):
    net, again = tiny(), load_inpainter(str(saved))
    assert again.config == net.config and not again.training
    pairs = zip(net.state_dict().values(), again.state_dict().values(), strict=True)
    assert all(torch.equal(a, b) for a, b in pairs)
    one, other = (n.step(view(3), Rig(), n.initial_state())[0].rgb for n in (net, again))
    assert torch.equal(one, other)
    assert (saved / "README.md").read_text() == "# A card"
    assert sorted(p.name for p in saved.iterdir()) == ["README.md", "config.json", "model.safetensors"]


def test_the_config_is_what_huggingface_hubs_mixin_hands_to_init(saved):
    """The mixin stores a dataclass argument named `config` as its fields, and ignores other keys."""
    values = json.loads((saved / "config.json").read_text())
    values.pop("viewmend_format")
    assert list(signature(Chain.__init__).parameters) == ["self", "config"]
    values["widths"] = tuple(values["widths"])
    assert InpainterConfig(**values) == tiny().config


@pytest.mark.parametrize("config", [paper(), small()])
def test_configs_survive_json(config):
    assert InpainterConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config


def test_missing(saved, tmp_path):
    with pytest.raises(MissingCheckpointError, match="nowhere"):
        load_inpainter(tmp_path / "nowhere")
    (saved / "config.json").unlink()
    with pytest.raises(MissingCheckpointError, match=r"config\.json missing"):
        load_inpainter(saved)


@pytest.mark.parametrize("length", [0, 4, 500, -1])
def test_weights_cut_short(saved, length):
    path = saved / "model.safetensors"
    path.write_bytes(path.read_bytes()[:length])
    with pytest.raises(DamagedWeightsError, match=r"model\.safetensors.*whole"):
        load_inpainter(saved)


def test_a_config_that_is_no_json(saved):
    (saved / "config.json").write_text('{"dim": 12')
    with pytest.raises(DamagedWeightsError, match=r"config\.json"):
        load_inpainter(saved)


@pytest.mark.parametrize("changes", [{"dim": 128}, {"blocks": 3}, {"use_depth": False}, {"heads": 3}, {"dim": "64"}])
def test_weights_of_another_config(saved, changes):
    values = json.loads((saved / "config.json").read_text()) | changes
    (saved / "config.json").write_text(json.dumps(values))
    with pytest.raises(MismatchedWeightsError, match=str(saved)):
        load_inpainter(saved)


@pytest.mark.parametrize(
    ("spoilt", "said"),
    [
        (lambda value: value.to(torch.int8), "of another kind of number"),
        (lambda value: value.to(torch.float8_e4m3fn), "of another kind of number"),
        (lambda value: value.to(torch.complex64), "of another kind of number"),
        (lambda value: torch.full_like(value, 1e300, dtype=torch.float64), "not finite"),
        (lambda value: torch.full_like(value, float("nan")), "not finite"),
        (lambda value: torch.full_like(value, float("-inf")), "not finite"),
    ],
)
def test_weights_that_no_training_leaves_are_refused(saved, spoilt, said):
    weights = load_file(saved / "model.safetensors")
    name = sorted(weights)[3]
    save_file(weights | {name: spoilt(weights[name])}, saved / "model.safetensors")
    with pytest.raises(MismatchedWeightsError, match=f"1 {said} \\({name}"):
        load_network(saved)


def test_a_config_of_another_version(saved):
    values = json.loads((saved / "config.json").read_text())
    for changed in (values | {"viewmend_format": 99}, values | {"novelty": 1}, {"viewmend_format": 1}, []):
        (saved / "config.json").write_text(json.dumps(changed))
        with pytest.raises(MismatchedWeightsError):
            load_inpainter(saved)


def test_a_config_from_before_a_switch_was_added(saved):
    before = load_inpainter(saved)
    values = json.loads((saved / "config.json").read_text())
    assert values.pop("temporal_accumulation") == InpainterConfig().temporal_accumulation == 0
    (saved / "config.json").write_text(json.dumps(values))
    after = load_inpainter(saved)
    assert after.config == before.config
    assert all(torch.equal(a, b) for a, b in zip(after.parameters(), before.parameters(), strict=True))


def test_a_model_of_format_1_loads_as_it_was(saved):
    """Of the time when one network had switches; so is the shipped `small`."""
    before = load_network(saved)
    values = json.loads((saved / "config.json").read_text()) | {"viewmend_format": 1}
    for new, old in (
        ("colour_skip", "colour_path"),
        ("num_ray_views", "rays"),
        ("identity_init", "copier_start"),
    ):
        values[old] = values.pop(new)
    assert values.pop("coarse_fill") == "rays"
    values |= {"prefill": True, "steady": 0.7, "grid": "relative", "attention_scale": "model", "clamp_fill": True}
    values.pop("temporal_accumulation")
    (saved / "config.json").write_text(json.dumps(values))
    weights = load_file(saved / "model.safetensors")
    renamed = {
        n.replace("coarse.", "ray_reader.", 1) if n.startswith("coarse.") else n.removeprefix("patches."): w
        for n, w in weights.items()
    }
    save_file(renamed, saved / "model.safetensors")
    after = load_inpainter(saved)
    assert isinstance(after, TemporalAccumulation) and after.weight == 0.7
    assert after.inner.config == replace(before.config, temporal_accumulation=0.7)
    assert all(torch.equal(a, b) for a, b in zip(after.inner.parameters(), before.parameters(), strict=True))
    for gone in ({"grid": "absolute"}, {"attention_scale": "head"}):
        (saved / "config.json").write_text(json.dumps(values | gone))
        with pytest.raises(MismatchedWeightsError, match=f"expected {next(iter(gone))}"):
            load_inpainter(saved)


def test_the_precision_is_that_of_every_network(saved):
    net = load_inpainter(saved, precision="bfloat16")
    assert {net.compute_dtype, net.patches.compute_dtype, net.coarse.compute_dtype} == {torch.bfloat16}
    with pytest.raises(ValueError, match="bfloat16 or auto, got 'float16'"):
        load_inpainter(saved, precision="float16")


def test_nothing_half_written(saved, monkeypatch):
    before = (saved / "model.safetensors").read_bytes()

    def break_off(weights, path, metadata):
        path.write_bytes(b"half")
        raise OSError("no space left")

    monkeypatch.setattr(atomic_writes, "save_file", break_off)
    with pytest.raises(OSError, match="no space"):
        save_inpainter(tiny(1), saved, "")
    assert (saved / "model.safetensors").read_bytes() == before
    assert len(list(saved.iterdir())) == 3


def test_shipped_models_are_found_by_name(saved, tmp_path, monkeypatch):
    monkeypatch.setattr(checkpoint, "SHIPPED", tmp_path)
    shutil.copytree(saved, tmp_path / "other")
    assert checkpoint.shipped_models() == ("model", "other")
    assert load_inpainter("other").config == tiny().config


@pytest.mark.parametrize(
    "changes",
    [
        *({"dim": 100}, {"widths": (8,) * 8}, {"widths": (8,) * 8 + (9,)}, {"top_k": 0}, {"n_c": -1}, {"blocks": 0}),
        *({"temporal_accumulation": 1.0}, {"num_ray_views": 0}),
    ],
)
def test_impossible_configs(changes):
    with pytest.raises(ValueError, match="expected"):
        replace(paper(), **changes)


@pytest.mark.parametrize(("faster", "dtype"), [(4.0, torch.bfloat16), (1.2, torch.float32), (0.25, torch.float32)])
def test_bfloat16_is_taken_by_who_was_trained_in_it_where_it_is_clearly_faster(
    monkeypatch, saved, tmp_path, faster, dtype
):
    asked = []
    monkeypatch.setattr(network, "bfloat16_speedup", lambda device: asked.append(device.type) or faster)
    assert load_network_dtype(saved, "auto") == torch.float32 and asked == []
    save_inpainter(SweepNet(SweepConfig(num_views=2, width=8, place_channels=4, features=8)), tmp_path / "whole", "")
    assert load_network_dtype(tmp_path / "whole", "auto") == dtype and asked == ["cpu"]
    assert load_network_dtype(tmp_path / "whole", "float32") == torch.float32
    with pytest.raises(ValueError, match="float32, bfloat16 or auto"):
        load_inpainter(saved, precision="half")


def load_network_dtype(folder, precision):
    loaded = load_inpainter(folder, precision=precision)
    return (loaded.inner if isinstance(loaded, TemporalAccumulation) else loaded).compute_dtype


def test_the_probe_measures_both():
    assert 0.02 < network.bfloat16_speedup(torch.device("cpu")) < 50
