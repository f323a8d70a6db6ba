"""Published weights are found by name and checked by hash."""

import hashlib

import pytest

from viewmend.metrics.weights import (
    KNOWN,
    SHIPPED,
    KnownWeights,
    checked_weights,
    find_weights,
    known_weights,
    weight_folders,
)
from viewmend.utils.weight_files import MissingWeightsError, WeightsError


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
    for word in ("the weights", "w.pth or other.pth", "abc123", str(folder / "b"), "their author", "VIEWMEND_WEIGHTS"):
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
