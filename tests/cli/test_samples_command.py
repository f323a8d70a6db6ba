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


BRIEF = ["--windows", "2", "--sizes-px", "128", "--cameras", "5", "5", "--held-cameras", "1", "--workers", "0"]
BRIEF += ["--hull-resolution", "32", "--imperfect-fraction", "0"]


def test_windows_go_on_within_a_scene(tmp_path, monkeypatch, capsys):
    """Five at once are the same as two, then, from the middle of a scene on, the others."""
    monkeypatch.setattr("viewmend.cli.samples.SAMPLES_A_SHARD", 3)

    def make(folder, count, *more):
        return main(["samples", "windows", "--out", str(tmp_path / folder), "--count", str(count), *BRIEF, *more])

    assert make("whole", 9) == 0
    assert make("parts", 3) == 0
    position = (tmp_path / "parts/next.json").read_text()
    assert make("parts", 6) == 0
    (tmp_path / "parts/next.json").write_text(position)  # killed after the second shard, before this
    assert make("parts", 9) == 0
    names = ["next.json", "plan.txt", *(f"shard-0000{n}.tar" for n in range(3))]
    assert sorted(path.name for path in (tmp_path / "parts").iterdir() if path.suffix) == names
    for name in names:
        assert (tmp_path / "parts" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes(), name
    capsys.readouterr()
    assert make("parts", 9) == 0 and "9 samples are there already" in capsys.readouterr().err
    assert make("parts", 12, "--seed", "1") == 2 and "the same plan and seed" in capsys.readouterr().err
    (tmp_path / "parts/shard-00002.tar").unlink()
    assert make("parts", 12) == 2 and "expected 3 shards, found 2" in capsys.readouterr().err
    (tmp_path / "parts/next.json").unlink()
    assert make("parts", 12) == 2 and "expected no samples yet" in capsys.readouterr().err
