"""`viewmend train` from the command line."""

import json
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from training.conftest import MODEL, VIEWS_MODEL

from viewmend.cli import main
from viewmend.data.native_writer import write_capture
from viewmend.models.checkpoint import load_config, save_inpainter
from viewmend.models.paper.patch_transformer import PatchTransformer
from viewmend.models.views.model import ViewSynthNet
from viewmend.studio.stage import Studio, StudioConfig
from viewmend.training.held_back import HeldBackValidation
from viewmend.training.recipes import RECIPES

BRIEF = ["--steps", "2", "--batch", "2", "--workers", "0", "--validate-every", "0"]
BRIEF += ["--sizes-px", "96", "--num-holdout-views", "2"]


@pytest.fixture(scope="session")
def capture(takes):
    return takes / "ada"


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    """Tiny models of both architectures."""
    folder = tmp_path_factory.mktemp("models")
    torch.manual_seed(0)
    save_inpainter(ViewSynthNet(VIEWS_MODEL), folder / "views", "# tiny\n")
    save_inpainter(PatchTransformer(replace(MODEL, n_c=1, n_w=0)), folder / "paper", "# tiny\n")
    return folder


def finetune(capture, model, out, *more):
    command = ["train", "finetune", str(capture), "--from", str(model), "--out", str(out)]
    return main([*command, "--captures-fraction", "1", *BRIEF, *more])


def test_the_help_names_every_recipe(capsys):
    assert main(["train", "--help"]) == 0
    words = set(capsys.readouterr().out.replace(",", " ").replace(":", " ").replace(".", " ").split())
    assert words >= set(RECIPES)


@pytest.mark.parametrize("rank", [0, 1])
def test_only_the_first_process_speaks_and_counts_no_steps_that_it_did_not_make(
    rank, tmp_path, capsys, monkeypatch
):
    def train(*_, **__):
        time.sleep(0.2)
        os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr("viewmend.training.loop.train", train)
    monkeypatch.setattr("viewmend.cli.console.INTERVAL_S", 0.01)
    monkeypatch.setenv("RANK", str(rank))
    assert main(["train", "rays", "--out", str(tmp_path)]) == 128 + signal.SIGTERM
    said = capsys.readouterr().err
    assert ("making the first samples" in said) == (rank == 0)
    assert (f"{tmp_path}: stopped; run the same command to resume" in said) == (rank == 0)
    assert "step 0" not in said


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["views", "paper"])
def test_a_model_is_fine_tuned_on_a_capture_and_resumed(kind, capture, models, tmp_path, capsys):
    out = tmp_path / "mine"
    assert finetune(capture, models / kind, out) == 0
    assert load_config(out) == load_config(models / kind)
    steps = [json.loads(line)["step"] for line in (out / "log.jsonl").read_text().splitlines()]
    assert steps == [1, 2]
    card = (out / "README.md").read_text()
    assert "100% of the scenes from captures (ada)" in card and f"from `{models / kind}`" in card
    assert finetune(capture, models / kind, out) == 0
    assert "nothing to do" in capsys.readouterr().err
    assert finetune(capture, models / kind, out, "--seed", "1") == 2
    assert "differs in seed" in capsys.readouterr().err


@pytest.mark.slow
def test_a_run_that_keeps_its_first_weights_says_so(capture, models, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(HeldBackValidation, "__call__", lambda *_: {"score": 20.0})
    assert finetune(capture, models / "views", tmp_path / "mine", "--validate-every", "1") == 0
    said = capsys.readouterr()
    assert "camera 'cam02' and the last frame (from" in said.err, "before the run begins"
    assert "up to 20 minutes; scoring views of each camera comes after them" in said.err
    assert f"kept the first weights: the result is '{models / 'views'}' unchanged" in said.out
    assert "| camera | PSNR rendered | completed | LPIPS rendered | completed |" in said.out
    assert "minutes of training and" in said.out
    assert (tmp_path / "mine/comparison.png").exists()


def test_a_model_in_the_folder_is_not_overwritten(capture, models, tmp_path, capsys):
    out = tmp_path / "mine"
    shutil.copytree(models / "views", out)
    before = (out / "model.safetensors").read_bytes()
    assert finetune(capture, models / "views", out) == 2
    assert "model.safetensors: expected no such file" in capsys.readouterr().err
    assert (out / "model.safetensors").read_bytes() == before


def test_a_damaged_capture_is_one_line_also_from_a_worker(capture, tmp_path, capfd):
    broken = tmp_path / "broken"
    shutil.copytree(capture, broken)
    for image in broken.glob("image/*/*1.*"):
        image.write_bytes(b"none")
    command = ["make-dataset", "finetune", "--captures", str(broken), "--out", str(tmp_path / "out")]
    assert main([*command, "--hold-out", "None", "--count", "40", "--workers", "1"]) == 2
    lines = [line for line in capfd.readouterr().err.splitlines() if "error" in line]
    assert len(lines) == 1 and "expected an image" in lines[0] and "Traceback" not in lines[0]
    assert not multiprocessing.active_children()


@pytest.mark.slow
def test_sigterm_to_the_process_group_ends_a_run_with_a_checkpoint(models, tmp_path):
    """As service managers send it: to the worker processes, too."""
    out = tmp_path / "run"
    command = [sys.executable, "-m", "viewmend", "train", "finetune", "--captures", "none", "--out", str(out)]
    command += ["--from", str(models / "views"), "--workers", "1", "--steps", "100000", "--minutes", "None"]
    capture = tmp_path / "mine"
    write_capture(Studio(StudioConfig(seed=3, cameras=5, frames=1, size_px=96)), capture)
    command[command.index("none")] = str(capture)
    environment = os.environ | {
        "PYTHONPATH": str(Path(__file__).parents[2] / "src"),
        "JAXTYPING_DISABLE": "1",
    }
    process = subprocess.Popen(
        command, env=environment, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    assert process.stderr is not None
    log = out / "log.jsonl"
    while (
        not log.exists() or '"losses"' not in log.read_text()
    ):  # the validation before the first step is logged, too
        assert process.poll() is None, process.stderr.read()
        time.sleep(0.2)
    os.killpg(process.pid, signal.SIGTERM)
    printed = process.communicate(timeout=120)[1]
    assert process.returncode == 128 + signal.SIGTERM, printed
    assert "run the same command to resume" in printed and "Traceback" not in printed
    assert (out / "run.safetensors").exists()
