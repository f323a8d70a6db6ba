"""Weights are found, checked and loaded strictly."""

import hashlib

import pytest
import torch
from safetensors.torch import save_file
from torch import nn

from viewmend.metrics.weights import (
    KNOWN,
    KnownWeights,
    MissingWeightsError,
    WeightsError,
    checked_weights,
    fill_network,
    find_weights,
    known_weights,
    places,
)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    for name in ("a", "b", "home"):
        (tmp_path / name).mkdir()
    monkeypatch.setenv("VIEWMEND_WEIGHTS", f"{tmp_path / 'a'}:{tmp_path / 'b'}")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    return tmp_path


def known(**hashes: str) -> KnownWeights:
    return KnownWeights("w", ("w.pth", "other.pth"), "the weights", "their author", "MIT", **hashes)


def test_the_users_folders_come_first(folder):
    assert places() == (
        folder / "a", folder / "b", folder / "home/viewmend/weights", folder / "torch/hub/checkpoints",
    )  # fmt: skip
    assert find_weights(known()) is None
    (folder / "b" / "w.pth").touch()
    (folder / "a" / "other.pth").touch()
    assert find_weights(known()) == folder / "a" / "other.pth"


def test_a_missing_file_is_named_with_all_that_is_needed(folder):
    with pytest.raises(MissingWeightsError) as missing:
        checked_weights(known(sha256="abc123"))
    for word in ("the weights", "w.pth or other.pth", "abc123", str(folder / "b"), "their author", "VIEWMEND_WEIGHTS"):
        assert word in str(missing.value)


def test_hashes_are_checked(folder):
    path = folder / "a" / "w.pth"
    path.write_bytes(b"hello\n")
    sha256 = hashlib.sha256(b"hello\n").hexdigest()
    git = "ce013625030ba8dba906f756967f9e9ca394464a"  # of `echo hello | git hash-object --stdin`
    for right in (known(), known(sha256=sha256), known(sha256=sha256[:8]), known(git_sha1=git)):
        assert checked_weights(right) == path
    for wrong in (known(sha256="0" * 8), known(git_sha1="1" * 40)):
        with pytest.raises(WeightsError, match=f"{sha256}.*damaged or another"):
            checked_weights(wrong)


def test_what_is_known_has_a_hash_and_a_source():
    metrics = ("alexnet", "vgg16", "lpips-alex", "lpips-vgg", "i3d")
    assert len({k.name for k in KNOWN}) == len(KNOWN) and {k.name for k in KNOWN} >= set(metrics)
    assert all(known_weights(name).sha256 or known_weights(name).git_sha1 for name in metrics)
    assert all(k.source and k.licence and k.files for k in KNOWN)
    assert known_weights("i3d").files[0] == "rgb_imagenet.pt"
    with pytest.raises(ValueError, match="expected weights among alexnet"):
        known_weights("resnet")


class Evil:
    def __reduce__(self):
        return print, ("never",)


def test_files_load_strictly_and_run_nothing(tmp_path, capsys):
    network, right = nn.Linear(3, 2), {"weight": torch.ones(2, 3), "bias": torch.ones(2)}
    path = tmp_path / "w.pth"
    torch.save(right | {"head.weight": torch.ones(1)}, path)
    fill_network(network, path, spare=("head.",))
    assert network.weight.eq(1).all() and not network.weight.requires_grad
    save_file(right, tmp_path / "w.safetensors")
    fill_network(network, tmp_path / "w.safetensors")
    whole = path.read_bytes()
    for wrong, said in (
        (right | {"more": torch.ones(1)}, "more is none of its"),
        ({"weight": right["weight"]}, "bias is missing"),
        (right | {"bias": torch.ones(3)}, r"bias is \(3,\), not \(2,\)"),
        ([1], "of other things"),
        (Evil(), "do not read"),
    ):
        torch.save(wrong, path)
        with pytest.raises(WeightsError, match=said):
            fill_network(network, path)
    path.write_bytes(whole[:-30])
    with pytest.raises(WeightsError, match="do not read"):
        fill_network(network, path)
    assert "never" not in capsys.readouterr().out
