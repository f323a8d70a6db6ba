"""`viewmend make-dataset`: resumes exactly, and does not mix its files with others."""

import pytest

from viewmend.cli import main
from viewmend.training.rays import RayBatch
from viewmend.training.shards import read_shard
from viewmend.training.stored_scenes import StoredScene

BRIEF = ["--sizes-px", "96", "--cameras", "5", "5", "--num-holdout-views", "1", "--workers", "0"]


def make(out, count, *more, recipe="views"):
    return main(["make-dataset", recipe, "--out", str(out), "--count", str(count), *BRIEF, *more])


@pytest.mark.slow
@pytest.mark.parametrize(("recipe", "kind", "views"), [("views", StoredScene, "1"), ("rays", RayBatch, "3")])
def test_an_interrupted_data_set_is_completed_exactly(recipe, kind, views, tmp_path, monkeypatch, capsys):
    """Also from the middle of a scene."""
    for module in (
        "viewmend.training.views.ViewsObjectiveConfig",
        "viewmend.training.rays.RaysObjectiveConfig",
    ):
        monkeypatch.setattr(f"{module}.shard_size", 2)
    more = ("--num-holdout-views", views)
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    assert make(whole, 4, *more, recipe=recipe) == 0
    assert make(parts, 2, *more, recipe=recipe) == 0
    position = (parts / "next.json").read_text()
    assert make(parts, 4, *more, recipe=recipe) == 0
    (parts / "next.json").write_text(
        position
    )  # killed after the second shard, before its position was recorded
    assert make(parts, 4, *more, recipe=recipe) == 0
    names = ["next.json", "plan.txt", "shard-00000.tar", "shard-00001.tar"]
    assert sorted(path.name for path in parts.iterdir() if path.suffix) == names
    assert [(parts / name).read_bytes() for name in names] == [(whole / name).read_bytes() for name in names]
    assert all(isinstance(item, kind) for item in read_shard(parts / "shard-00000.tar"))
    capsys.readouterr()
    assert make(parts, 4, *more, recipe=recipe) == 0 and "already holds 4 samples" in capsys.readouterr().err
    assert make(parts, 6, "--seed", "1", *more, recipe=recipe) == 2
    assert "the same options and seed" in capsys.readouterr().err
    (parts / "shard-00001.tar").unlink()
    assert (
        make(parts, 6, *more, recipe=recipe) == 2 and "expected 2 shards, found 1" in capsys.readouterr().err
    )
    (parts / "next.json").unlink()
    assert make(parts, 6, *more, recipe=recipe) == 2 and "without next.json" in capsys.readouterr().err


def test_other_shards_are_not_overwritten(tmp_path, capsys):
    (tmp_path / "shard-00001.tar").write_bytes(b"mine")
    assert make(tmp_path, 99) == 2
    assert "expected shard-00000.tar before shard-00001.tar, found none" in capsys.readouterr().err
    assert (tmp_path / "shard-00001.tar").read_bytes() == b"mine"


def test_views_are_trained_without_the_mask_of_the_held_out_camera(tmp_path, capsys):
    assert make(tmp_path / "out", 1, "--protocols", "target-mask") == 2
    assert "expected --protocols strict for views, got target-mask" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
