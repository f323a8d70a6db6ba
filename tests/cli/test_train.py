"""`viewmend train` and `viewmend samples` from the command line."""

import json
import shutil
from dataclasses import replace

import pytest

from viewmend.baselines.published import NETWORKS
from viewmend.capture.plain_writer import write_capture
from viewmend.cli import main
from viewmend.inpainting.chain import build
from viewmend.inpainting.checkpoint import load_inpainter, save_inpainter
from viewmend.inpainting.config import small as small_model
from viewmend.studio.stage import Studio, StudioConfig
from viewmend.training.recipes import RECIPES
from viewmend.training.sample_files import read_shard

MODEL = replace(small_model(), widths=(8,) * 9, dim=32, heads=2, groups=1, blocks=2, num_ray_views=3)
BRIEF = ("--steps", "2", "--batch", "2", "--workers", "0", "--validate-every", "0")


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("captures") / "mine"
    write_capture(Studio(StudioConfig(seed=3, cameras=5, frames=2, size_px=192)), folder)
    return folder


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    folder = tmp_path_factory.mktemp("models") / "tiny"
    save_inpainter(build(MODEL), folder, "# tiny\n")
    return folder


def test_the_help_names_every_recipe(capsys):
    assert main(["train", "--help"]) == 0
    words = set(capsys.readouterr().out.replace(",", " ").replace(";", " ").replace(".", " ").split())
    assert words >= {*RECIPES, *NETWORKS}


def test_fine_tuning_on_a_capture_of_ones_own_goes_on_from_a_model(capture, model, tmp_path, capsys):
    out = tmp_path / "mine"
    command = ["train", "finetune", "--captures", str(capture), "--from", str(model), "--out", str(out), *BRIEF]
    assert main(command) == 0
    assert load_inpainter(out).config == MODEL
    steps = [json.loads(line)["step"] for line in (out / "log.jsonl").read_text().splitlines()]
    assert steps == [1, 2]
    assert main(command) == 0
    assert "nothing to do" in capsys.readouterr().err


def test_samples_made_ahead_train_a_model(capture, model, tmp_path):
    shards = tmp_path / "shards"
    command = ["samples", "finetune", "--captures", str(capture), "--out", str(shards)]
    assert main([*command, "--clip-length", "2", "--count", "3", "--workers", "0"]) == 0
    assert sorted(p.name for p in shards.glob("*.*") if p.suffix) == ["next.json", "plan.txt", "shard-00000.tar"]
    assert [len(sample.clip) for sample in read_shard(shards / "shard-00000.tar")] == [2, 2, 2]
    before = (shards / "shard-00000.tar").read_bytes()
    assert main([*command, "--clip-length", "2", "--count", "1", "--workers", "0"]) == 0
    assert (shards / "shard-00000.tar").read_bytes() == before, "shards are never replaced"
    trained = ["train", "finetune", "--shards", str(shards), "--from", str(model), "--out", str(tmp_path / "out")]
    assert main([*trained, "--clip-length", "3", *BRIEF]) == 2, "clips are too short"
    assert main([*trained, "--no-bfloat16", *BRIEF]) == 0
    assert load_inpainter(tmp_path / "out").config == MODEL


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["train", "smal"], "expected a recipe among"),
        (["train", "finetune"], "expected --captures DIR"),
        (["train", "finetune", "--captures", "here", "--from=nothing"], "one of the shipped models"),
        (["train", "small", "--performers", "people"], "--performers and --motions together"),
        (["train", "small", "--adversarial", "1", "--discriminator", "clip"], "give --clip-length 2"),
        (["train", "small_rays", "--adversarial", "0.01"], "no adversarial loss for rays"),
        (["train", "small", "--shards", "nowhere", *BRIEF], "expected tar files, found none"),
        (["train", "small", "--from", "nothing"], "one of the shipped models"),
        (["train", "paper", "--from", "small", *BRIEF], "of which anything fits paper"),
        (["train", "small", "--steps", "0"], "steps of 0"),
        (["train", "small", "--checkpoint-every", "0"], "checkpoint_every of 0"),
        (["train", "small", "--minutes", "nan"], "minutes of nan"),
        (["train", "small", "--batch", "0"], "batch of 0"),
        (["train", "small", "--clip-length", "-1"], "clip_length of -1"),
        (["train", "small", "--data-device", "abacus"], "expected a device that is there"),
        (["train", "small", "--performers", "nobody", "--motions", "nobody"], "nobody: expected people or motions"),
        (["samples", "--out", "x", "--count", "0"], "count of at least 1"),
        (["ablation", "--out", "x", "--variants", "no-ropes"], "expected variants among"),
    ],
)
def test_what_cannot_be_is_one_clear_error(arguments, said, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and said in lines[0], lines


def test_a_model_that_lies_there_is_not_overwritten(capture, model, tmp_path, capsys):
    out = tmp_path / "mine"
    shutil.copytree(model, out)
    before = (out / "model.safetensors").read_bytes()
    command = ["train", "finetune", "--captures", str(capture), "--from", str(model), "--out", str(out), *BRIEF]
    assert main(command) == 2
    assert "model.safetensors: expected no such file, or one that an earlier run made" in capsys.readouterr().err
    assert (out / "model.safetensors").read_bytes() == before


def test_a_sample_that_cannot_be_made_in_a_worker_is_one_line(capture, tmp_path, capfd):
    broken = tmp_path / "broken"
    shutil.copytree(capture, broken)
    for image in broken.glob("image/*/*1.*"):
        image.write_bytes(b"none")
    command = ["samples", "finetune", "--captures", str(broken), "--out", str(tmp_path / "out")]
    assert main([*command, "--count", "40", "--workers", "1"]) == 2
    said = [line for line in capfd.readouterr().err.splitlines() if "error" in line]
    assert len(said) == 1 and "expected an image" in said[0] and "Traceback" not in said[0]


@pytest.mark.slow
def test_an_ablation_trains_evaluates_and_goes_on(tmp_path, capsys):
    command = ["ablation", "--out", str(tmp_path), "--variants", "no-rope", "--seeds", "1", "--samples", "4"]
    command += ["--steps", "1", "--scenes", "1", "--frames", "1", "--size", "128", "--jobs", "1"]
    assert main(command) == 0
    first = capsys.readouterr().out
    assert "| no-rope |" in first and "| 64 |" in first and "| all |" in first
    assert {p.name for p in tmp_path.iterdir()} >= {"ablation.md", "ablation.json", "ablation.svg", "models", "samples"}
    assert load_inpainter(tmp_path / "models/no-rope-s0").config.rope is False
    assert load_inpainter(tmp_path / "models/full-s0-k64").config.top_k == 64
    (tmp_path / "ablation.md").unlink()
    assert main(command) == 0
    assert capsys.readouterr().out == first
