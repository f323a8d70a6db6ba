"""`viewmend samples` shares its folder with nobody, and counts whole shards alone."""

import pytest

from viewmend.cli import main
from viewmend.output_folder import OutputFolder


@pytest.mark.parametrize("recipe", ["views", "small"])
def test_one_run_at_a_time_makes_samples(recipe, tmp_path, capsys):
    with OutputFolder(tmp_path / "out"):
        assert main(["samples", recipe, "--out", str(tmp_path / "out"), "--count", "1"]) == 2
    assert "expected a folder that no other run writes to" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_what_a_killed_run_left_is_no_shard_and_is_removed(tmp_path, capsys):
    for name in ("shard-00000.tar", ".half-77-shard-00001.tar"):
        (tmp_path / name).write_bytes(b"x")
    assert main(["samples", "views", "--out", str(tmp_path), "--count", "16"]) == 0
    assert "16 samples are there already" in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == [".viewmend", "plan.txt", "shard-00000.tar"]


def test_no_shard_takes_the_name_of_another(tmp_path, capsys):
    (tmp_path / "shard-00001.tar").write_bytes(b"mine")
    assert main(["samples", "views", "--out", str(tmp_path), "--count", "99"]) == 2
    assert "expected shard-00000.tar before shard-00001.tar, found none" in capsys.readouterr().err
    assert (tmp_path / "shard-00001.tar").read_bytes() == b"mine"
