"""Files that are whole or not there."""

import pytest
import torch

from viewmend.atomic_writes import write_atomically, write_tensors


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
    with pytest.raises(OSError, match=r"a\.safetensors: expected room for the file"):
        write_tensors(tmp_path / "nowhere" / "a.safetensors", {"x": torch.zeros(2)}, {})
    assert list(tmp_path.iterdir()) == []
