"""Models on disk: saved atomically, loaded strictly, with clear errors."""

import json
import shutil
from inspect import signature

import pytest
import torch
from models.plates import tiny, tiny_rays
from safetensors.torch import load_file, save_file

from viewmend.models import checkpoint, network
from viewmend.models.checkpoint import (
    MissingCheckpointError,
    load_config,
    load_inpainter,
    load_network,
    save_inpainter,
    shipped_models,
)
from viewmend.models.paper.config import PaperConfig, paper
from viewmend.models.paper.patch_transformer import PatchTransformer
from viewmend.models.views.config import RaysConfig, ViewsConfig
from viewmend.models.views.model import ViewSynthNet
from viewmend.models.views.ray_fill import RayFill
from viewmend.utils import weight_files
from viewmend.utils.weight_files import DamagedWeightsError, MismatchedWeightsError

VIEWS = ViewsConfig(num_views=2, width=8, sample_channels=4, features=8)


@pytest.fixture
def saved(tmp_path):
    save_inpainter(tiny(), tmp_path / "model", "# A card")
    return tmp_path / "model"


def change_config(folder, changes):
    values = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(values | changes))


def test_a_model_that_cannot_be_written_replaces_none(saved):
    before = {path.name: path.read_bytes() for path in saved.iterdir()}
    net = tiny()
    with torch.no_grad():
        next(net.parameters()).fill_(torch.nan)
    with pytest.raises(FloatingPointError):
        save_inpainter(net, saved, "# Another card")
    assert {path.name: path.read_bytes() for path in saved.iterdir()} == before


@pytest.mark.parametrize("make", [tiny, tiny_rays, lambda: ViewSynthNet(VIEWS)])
def test_a_saved_model_loads(make, tmp_path):
    net = make()
    save_inpainter(net, tmp_path / "model", "# A card")
    again = load_inpainter(tmp_path / "model")
    assert type(again) is type(net) and again.config == net.config and not again.training
    pairs = zip(net.state_dict().values(), again.state_dict().values(), strict=True)
    assert all(torch.equal(a, b) for a, b in pairs)
    assert (tmp_path / "model/README.md").read_text() == "# A card"
    assert sorted(p.name for p in (tmp_path / "model").iterdir()) == [
        "README.md",
        "config.json",
        "model.safetensors",
    ]


def test_the_config_is_compatible_with_huggingface_hubs_mixin(saved):
    """The mixin stores a dataclass argument named `config` as its fields, and ignores other keys."""
    values = json.loads((saved / "config.json").read_text())
    assert (values.pop("viewmend_format"), values.pop("network")) == (3, "paper")
    assert list(signature(PatchTransformer.__init__).parameters) == ["self", "config"]
    values["widths"] = tuple(values["widths"])
    assert PaperConfig(**values) == tiny().config


@pytest.mark.parametrize(
    "changes",
    [
        *(
            {"dim": 100},
            {"widths": (8,) * 8},
            {"widths": (8,) * 8 + (9,)},
            {"top_k": 0},
            {"n_c": -1},
            {"blocks": 0},
        ),
        *({"num_source_views": 0}, {"background": "green"}),
    ],
)
def test_impossible_configs_are_refused(changes):
    with pytest.raises(ValueError, match="expected"):
        PaperConfig.from_dict(paper().to_dict() | changes)


def test_missing_and_damaged_files_are_named(saved, tmp_path):
    with pytest.raises(MissingCheckpointError, match="nowhere"):
        load_inpainter(tmp_path / "nowhere")
    (saved / "config.json").unlink()
    with pytest.raises(MissingCheckpointError, match=r"config\.json missing"):
        load_inpainter(saved)
    (saved / "config.json").write_text('{"dim": 12')
    with pytest.raises(DamagedWeightsError, match=r"config\.json"):
        load_inpainter(saved)


@pytest.mark.parametrize(
    "changes",
    [
        *({"dim": 128}, {"blocks": 3}, {"use_depth": False}, {"heads": 3}, {"dim": "64"}, {"novelty": 1}),
        *({"viewmend_format": 99}, {"viewmend_format": 2}, {"network": "chain"}, {"network": "views"}),
    ],
)
def test_a_config_of_another_model_or_version_is_refused(saved, changes):
    change_config(saved, changes)
    with pytest.raises(MismatchedWeightsError, match=str(saved)):
        load_inpainter(saved)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda value: value.to(torch.int8), "of another kind of number"),
        (lambda value: value.to(torch.complex64), "of another kind of number"),
        (lambda value: torch.full_like(value, 1e300, dtype=torch.float64), "not finite"),
        (lambda value: torch.full_like(value, float("nan")), "not finite"),
    ],
)
def test_weights_must_be_finite_floats(saved, change, message):
    weights = load_file(saved / "model.safetensors")
    name = sorted(weights)[3]
    save_file(weights | {name: change(weights[name])}, saved / "model.safetensors")
    with pytest.raises(MismatchedWeightsError, match=f"1 {message} \\({name}"):
        load_network(saved)


def test_an_interrupted_save_leaves_the_old_files(saved, monkeypatch):
    before = (saved / "model.safetensors").read_bytes()

    def fail(weights, path, metadata):
        path.write_bytes(b"half")
        raise OSError("no space left")

    monkeypatch.setattr(weight_files, "save_file", fail)
    with pytest.raises(OSError, match="no space"):
        save_inpainter(tiny(1), saved, "")
    assert (saved / "model.safetensors").read_bytes() == before
    assert len(list(saved.iterdir())) == 3


def test_a_shipped_name_wins_over_a_folder_of_that_name(saved, tmp_path, monkeypatch):
    monkeypatch.setattr(checkpoint, "SHIPPED", tmp_path)
    shutil.copytree(saved, tmp_path / "other")
    assert checkpoint.shipped_models() == ("model", "other")
    (tmp_path / "here/other").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "here")
    assert load_inpainter("other").config == tiny().config
    with pytest.raises(MissingCheckpointError, match=r"config\.json missing"):
        load_inpainter("./other")


def test_rays_is_the_ray_fill_of_views():
    assert shipped_models() == ("paper-small", "rays", "views")
    rays, views = load_inpainter("rays"), load_network("views")
    assert isinstance(rays, RayFill) and rays.config == load_config("rays") == RaysConfig()
    own, inner = rays.state_dict(), views.coarse.state_dict()
    assert own.keys() == inner.keys() and all(torch.equal(own[key], inner[key]) for key in own)
    assert sum(weight.numel() for weight in own.values()) == 855_886


@pytest.mark.parametrize(
    ("features", "dtype"),
    [
        ({"amx_bf16": True, "avx512_bf16": True}, torch.bfloat16),
        ({"amx_bf16": False, "avx512_bf16": True}, torch.bfloat16),
        ({"amx_bf16": False, "avx512_bf16": False, "avx512_f": True}, torch.float32),
        ({}, torch.float32),
    ],
)
def test_auto_precision_is_bfloat16_for_models_trained_in_it_on_processors_with_units_for_it(
    monkeypatch, saved, tmp_path, features, dtype
):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: features)
    assert load_inpainter(saved).compute_dtype == torch.float32
    save_inpainter(ViewSynthNet(VIEWS), tmp_path / "views", "")
    assert load_inpainter(tmp_path / "views").compute_dtype == dtype
    assert load_inpainter(tmp_path / "views", precision="float32").compute_dtype == torch.float32
    with pytest.raises(ValueError, match="float32, bfloat16 or auto"):
        load_inpainter(saved, precision="half")


def test_this_machine_states_the_features_that_precision_depends_on():
    if torch.cpu.get_capabilities()["architecture"] != "x86_64":
        pytest.skip("not an x86 processor")
    assert set(network.BFLOAT16_UNITS) <= torch.cpu.get_capabilities().keys()


@pytest.mark.parametrize(("units", "dtype"), [(True, torch.bfloat16), (False, torch.float32)])
def test_a_gpu_computes_in_bfloat16_if_it_has_units_for_it(monkeypatch, units, dtype):
    monkeypatch.setattr(
        torch.cuda, "is_bf16_supported", lambda including_emulation: units or including_emulation
    )
    assert network.faster_dtype(torch.device("cuda")) == dtype
