"""Files that are whole or not there."""

import errno
import os

import pytest
import torch

from viewmend.utils.atomic_writes import write_atomically
from viewmend.utils.weight_files import write_tensors


def test_what_was_there_stays_if_writing_fails(tmp_path):
    path = tmp_path / "a.txt"
    write_atomically(path, lambda beside: beside.write_text("old"))

    def fails(beside):
        beside.write_text("ne")
        raise OSError("full")

    with pytest.raises(OSError, match="full"):
        write_atomically(path, fails)
    assert path.read_text() == "old" and [f.name for f in tmp_path.iterdir()] == ["a.txt"]


def test_tensors_that_cannot_be_written_are_an_os_error(tmp_path):
    with pytest.raises(OSError, match=r"a\.safetensors: expected space for the file"):
        write_tensors(tmp_path / "nowhere" / "a.safetensors", {"x": torch.zeros(2)}, {})
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_is_said_with_the_path(tmp_path):
    def full(_):
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OSError, match=r"No space left on device: .*a\.txt") as raised:
        write_atomically(tmp_path / "a.txt", full)
    assert raised.value.errno == errno.ENOSPC


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_numbers_that_are_not_finite_never_replace_good_ones(tmp_path, value):
    path = tmp_path / "a.safetensors"
    write_tensors(path, {"x": torch.zeros(2)}, {})
    before = path.read_bytes()
    with pytest.raises(FloatingPointError, match=r"a\.safetensors: expected finite values.*\(y\)"):
        write_tensors(path, {"x": torch.zeros(2), "y": torch.tensor([1.0, value]), "n": torch.tensor(3)}, {})
    assert path.read_bytes() == before and [f.name for f in tmp_path.iterdir()] == ["a.safetensors"]


def test_tensors_are_on_the_disk_before_they_take_their_place(tmp_path, monkeypatch):
    path, order, fsync = tmp_path / "a.safetensors", [], os.fsync
    monkeypatch.setattr(os, "fsync", lambda number: (order.append(path.exists()), fsync(number)))
    write_tensors(path, {"x": torch.zeros(2)}, {})
    assert order == [False, True], "the file, then its folder"
