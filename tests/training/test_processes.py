"""Runs in processes of their own: killed, and several at once."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from viewmend.training.run_files import FILE


def log_of(out):
    return [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]


SCRIPT = """
import sys
from dataclasses import replace
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from conftest import MODEL, PLAN
from dataclasses import replace
from viewmend.training.loop import train
from viewmend.training.plan import Recipe

plan = replace(PLAN, clip_length=2, shards=Path(sys.argv[5]))
recipe = Recipe(name="tiny", model=MODEL, data=plan, steps=int(sys.argv[3]), batch=2, new_per_batch=1, replay_size=3,
                warmup=1, workers=0, ema=0.5, bfloat16=False, checkpoint_every=1, validate_every=0,
                streams=int(sys.argv[4]))
train(recipe, Path(sys.argv[2]))
"""


LAST = """
import sys, time
from pathlib import Path
from viewmend.training.processes import processes
with processes() as own:
    if own.first:
        time.sleep(1)
        Path(sys.argv[2]).mkdir()
assert Path(sys.argv[2]).is_dir()
"""
TORCHRUN = ("-m", "torch.distributed.run", "--nproc-per-node=2", "--standalone")  # on any free port


def started(out, steps, shards, streams=1, launcher=(), text=SCRIPT):
    script = out.with_suffix(".py")
    script.write_text(text)
    here = str(Path(__file__).parent)
    environment = os.environ | {"OMP_NUM_THREADS": "1", "JAXTYPING_DISABLE": "1"}
    command = [sys.executable, *launcher, str(script), here, str(out), str(steps), str(streams), str(shards)]
    with out.with_suffix(".log").open("w") as log:
        return subprocess.Popen(command, env=environment, stdout=log, stderr=log)


def test_a_killed_run_goes_on_from_a_whole_checkpoint(shards, tmp_path):
    run = started(tmp_path / "killed", 1000, shards)
    while not (tmp_path / "killed" / FILE).exists():
        assert run.poll() is None
        time.sleep(0.02)
    time.sleep(0.3)
    run.send_signal(signal.SIGKILL)
    run.wait()
    before = len(log_of(tmp_path / "killed"))
    assert started(tmp_path / "killed", before + 1, shards).wait() == 0
    assert started(tmp_path / "whole", before + 1, shards).wait() == 0
    # The cosine of a run of other steps is another: only that it went on, with every step in the log once.
    assert [entry["step"] for entry in log_of(tmp_path / "killed")] == list(range(1, before + 2))
    killed, whole = (log_of(tmp_path / name)[0]["losses"] for name in ("killed", "whole"))
    assert killed == whole


def test_two_processes_make_the_loss_curve_of_one_with_the_double_batch(shards, tmp_path):
    assert started(tmp_path / "one", 4, shards, streams=2).wait() == 0
    two = started(tmp_path / "two", 4, shards, launcher=TORCHRUN)
    assert two.wait() == 0, (tmp_path / "two.log").read_text()[-3000:]
    one, two = (load_file(tmp_path / n / "model.safetensors") for n in ("one", "two"))
    for key in one:
        assert torch.allclose(one[key], two[key], atol=2e-5), key
    curves = [[e["losses"]["total"] for e in log_of(tmp_path / n)] for n in ("one", "two")]
    assert curves[0] == pytest.approx(curves[1], rel=1e-4)
    assert len(set(curves[0])) == 4


def test_processes_leave_together(tmp_path):
    assert started(tmp_path / "made", 0, "", launcher=TORCHRUN, text=LAST).wait() == 0, "one left before the other"
