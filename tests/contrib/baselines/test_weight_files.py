"""Weights load strictly, what is not the network's is refused in words, and nothing in a file is run."""

import pickle

import pytest
import torch
from safetensors.torch import save_file
from torch import nn

from viewmend.contrib.baselines.e2fgvi import E2FGVI, E2FGVIHQ
from viewmend.contrib.baselines.token_transformers import DSTT, FuseFormer
from viewmend.utils.weight_files import DamagedWeightsError, MismatchedWeightsError, construct, load_weights

NETWORKS = {"DSTT": DSTT, "FuseFormer": FuseFormer, "E2FGVI": E2FGVI, "E2FGVI_HQ": E2FGVIHQ}


@pytest.mark.parametrize("name", NETWORKS)
def test_keys_and_shapes_are_the_published_ones(name, shared):
    listed = {}
    for line in (shared / "parity" / f"keys_{name}.txt").read_text().splitlines():
        key, shape = line.split(" ", 1)
        listed[key] = tuple(int(side) for side in shape.strip("()").split(",") if side.strip())
    assert {
        key: tuple(value.shape) for key, value in construct(NETWORKS[name]).state_dict().items()
    } == listed


@pytest.fixture(scope="module")
def weights():
    torch.manual_seed(1)
    return DSTT().state_dict()


def fresh():
    torch.manual_seed(2)
    return DSTT()


@pytest.mark.parametrize("form", ["wrapped.pth", "plain.pth", "plain.safetensors", "legacy.pth"])
def test_official_weights_load_in_each_form(form, weights, tmp_path):
    path = tmp_path / form
    if form.endswith("safetensors"):
        save_file(weights, path)
    else:
        contents = {"netG": weights} if form == "wrapped.pth" else weights
        torch.save(contents, path, _use_new_zipfile_serialization=form != "legacy.pth")
    network = load_weights(fresh(), path)
    assert not network.training
    assert all(torch.equal(value, weights[key]) for key, value in network.state_dict().items())


def test_a_network_that_gets_its_weights_from_a_file_draws_none():
    before = torch.random.get_rng_state()
    network = construct(DSTT)
    assert torch.equal(torch.random.get_rng_state(), before)
    assert network.state_dict().keys() == DSTT().state_dict().keys()
    assert not torch.equal(torch.random.get_rng_state(), before), "on its own it does"


def saved(path, contents):
    torch.save(contents, path)
    return path


def test_another_networks_weights_are_refused(weights, tmp_path):
    path = saved(tmp_path / "DSTT.pth", {"netG": weights})
    with pytest.raises(
        MismatchedWeightsError, match=r"expected the 160 tensors of FuseFormer, got 158: \d+ missing"
    ):
        load_weights(construct(FuseFormer), path)
    # HQ and plain E2FGVI differ in one bias alone.
    path = saved(tmp_path / "E2FGVI.pth", construct(E2FGVI).state_dict())
    with pytest.raises(
        MismatchedWeightsError, match=r"2 missing \(sc.bias_conv.bias.*1 unknown \(sc.bias ...\)"
    ):
        load_weights(construct(E2FGVIHQ), path)
    wrong = weights | {"patch2vec.bias": torch.zeros(7)}
    with pytest.raises(
        MismatchedWeightsError, match=r"1 of another shape \(patch2vec.bias \(7,\) for \(512,\) "
    ):
        load_weights(construct(DSTT), saved(tmp_path / "x.pth", wrong))


def test_absent_counters_do_not_matter(tmp_path):
    network, right = nn.BatchNorm1d(2), {key: torch.full((2,), 3.0) for key in nn.BatchNorm1d(2).state_dict()}
    del right["num_batches_tracked"]
    assert load_weights(network, saved(tmp_path / "x.pth", right)).weight.eq(3).all()
    path = saved(tmp_path / "x.pth", right | {"head.weight": torch.ones(1)})
    with pytest.raises(MismatchedWeightsError, match=r"1 unknown \(head.weight"):
        load_weights(network, path)
    with pytest.raises(MismatchedWeightsError, match=r"1 missing \(bias"):
        load_weights(network, saved(path, {key: value for key, value in right.items() if key != "bias"}))


@pytest.mark.parametrize("form", ["pth", "safetensors"])
def test_damaged_files_are_refused(form, weights, tmp_path):
    path = tmp_path / f"x.{form}"
    if form == "pth":
        torch.save(weights, path)
    else:
        save_file(weights, path)
    whole = path.read_bytes()
    for part in (b"", whole[:100], whole[: len(whole) // 2], whole[:-1]):
        path.write_bytes(part)
        with pytest.raises(DamagedWeightsError, match=f"got {len(part)} bytes that do not read"):
            load_weights(construct(DSTT), path)


@pytest.mark.parametrize(
    "contents", [[1, 2], {"netG": {"epoch": 3}}, {"state_dict": {"a": torch.zeros(1)}}, {"a": 1}]
)
def test_files_without_weights_are_refused(contents, tmp_path):
    with pytest.raises(MismatchedWeightsError, match="expected a dictionary of tensors"):
        load_weights(construct(DSTT), saved(tmp_path / "x.pth", contents))


class Trap:
    """Would leave a trace if it were unpickled."""

    trace = None

    def __reduce__(self):
        return (open, (self.trace, "w"))


@pytest.mark.parametrize("saver", ["torch", "pickle"])
def test_no_code_in_a_checkpoint_is_run(saver, weights, tmp_path):
    trap, path = Trap(), tmp_path / "x.pth"
    trap.trace = str(tmp_path / "trace")
    contents = {"netG": {"encoder.0.weight": weights["encoder.0.weight"], "trap": trap}}
    if saver == "torch":
        torch.save(contents, path)
    else:
        path.write_bytes(pickle.dumps(trap, protocol=2))
    with pytest.raises(DamagedWeightsError, match="do not read"):
        load_weights(construct(DSTT), path)
    assert not (tmp_path / "trace").exists()
