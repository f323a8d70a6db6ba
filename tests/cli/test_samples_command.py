"""`viewmend samples` shares its folder with nobody, and counts whole shards alone."""

from dataclasses import replace

import pytest
import torch

from viewmend.cli import main
from viewmend.inpainting.chain import build
from viewmend.inpainting.checkpoint import load_network, save_inpainter
from viewmend.inpainting.config import paper_small
from viewmend.output_folder import OutputFolder
from viewmend.training.encoded import fingerprint
from viewmend.training.sample_files import read_shard, shards_of


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


def test_windows_are_encoded_by_a_model_that_then_learns_from_them(tmp_path, capsys):
    torch.manual_seed(0)
    tiny = replace(paper_small(), widths=(8,) * 9, dim=32, heads=2, groups=1, blocks=2)
    save_inpainter(build(tiny), tmp_path / "model", "# tiny\n")
    windows, tokens = str(tmp_path / "windows"), str(tmp_path / "tokens")
    assert main(["samples", "windows", "--out", windows, "--count", "4", "--matches", *BRIEF]) == 0
    asked = ["samples", "tokens", "--shards", windows, "--workers", "0", "--count", "4", "--out", tokens]
    assert main(asked) == 2
    assert "expected --encoder MODEL for tokens, and for nothing else, got none for tokens" in capsys.readouterr().err
    assert not list((tmp_path / "tokens").glob("*.t*")), "nothing was begun"
    assert main([*asked, "--encoder", str(tmp_path / "model")]) == 0
    own = fingerprint(load_network(tmp_path / "model"))
    (made,) = (read_shard(path) for path in shards_of(tmp_path / "tokens"))
    sources = [sample for path in shards_of(tmp_path / "windows") for sample in read_shard(path)]
    assert len(made) == len(sources) == 4
    for sample in made:
        assert sample.context == () and sample.encoded.encoder == own and sample.encoded.frames
        assert any(sample.truth.equal(source.truth) for source in sources)
    assert main([*asked, "--encoder", "small"]) == 2
    assert "expected a model of patches alone to encode with, got small" in capsys.readouterr().err
    again = tmp_path / "again"
    save_inpainter(build(tiny), again, "# another\n")
    assert main([*asked, "--encoder", str(again)]) == 2 and "the same plan and seed" in capsys.readouterr().err
    narrow = ["--model.dim", "32", "--model.heads", "2", "--model.groups", "1", "--model.blocks", "2"]
    run = ["--steps", "2", "--minutes", "None", "--workers", "0", "--model.widths", *["8"] * 9]
    start = ["--shards", tokens, "--from", str(tmp_path / "model"), "--out", str(tmp_path / "run")]
    assert main(["train", "tokens", *start, *run, *narrow]) == 0
    assert main(["samples", "windows", "--encoder", "small", "--out", str(tmp_path / "x"), *BRIEF]) == 2
    assert "got small for windows" in capsys.readouterr().err
