"""Runs that are killed, and runs of several processes."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from training.conftest import log_of

from viewmend.training.run_files import CHECKPOINT

SCRIPT = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from training.conftest import MODEL, RUN, SAMPLING, SCENES
from viewmend.training.config import TrainConfig
from viewmend.training.loop import train
from viewmend.training.paper import PaperObjectiveConfig

objective = PaperObjectiveConfig(model=MODEL, sampling=SAMPLING, adversarial=0.0)
changes = dict(steps=int(sys.argv[3]), streams=int(sys.argv[4]), checkpoint_minutes=0.0)
train(TrainConfig(name="tiny", objective=objective, shards=Path(sys.argv[5]), **(RUN | changes)), Path(sys.argv[2]))
"""
LAST = """
import sys, time
from pathlib import Path
from viewmend.training.loop import join_processes
with join_processes() as own:
    if own.is_first:
        time.sleep(1)
        Path(sys.argv[2]).mkdir()
assert Path(sys.argv[2]).is_dir()
"""
TORCHRUN = ("-m", "torch.distributed.run", "--nproc-per-node=2", "--standalone")  # on any free port


def started(out, steps, shards, streams=1, launcher=(), text=SCRIPT):
    script = out.with_suffix(".py")
    script.write_text(text)
    tests = str(Path(__file__).parents[1])
    environment = os.environ | {"OMP_NUM_THREADS": "1", "JAXTYPING_DISABLE": "1"}
    command = [sys.executable, *launcher, str(script), tests, str(out), str(steps), str(streams), str(shards)]
    with out.with_suffix(".log").open("w") as log:
        return subprocess.Popen(command, env=environment, stdout=log, stderr=log)


@pytest.mark.slow
def test_a_killed_run_resumes_from_a_whole_checkpoint(shards, tmp_path):
    run = started(tmp_path / "killed", 1000, shards)
    while len(log_of(tmp_path / "killed")) < 4 or not (tmp_path / "killed" / CHECKPOINT).exists():
        assert run.poll() is None, (tmp_path / "killed.log").read_text()[-3000:]
        time.sleep(0.02)
    run.send_signal(signal.SIGKILL)
    run.wait()
    before = len(log_of(tmp_path / "killed"))
    assert started(tmp_path / "killed", before + 1, shards).wait() == 0
    assert started(tmp_path / "whole", before + 1, shards).wait() == 0
    # The learning rate depends on the number of steps, so only the first losses can be equal.
    assert [entry["step"] for entry in log_of(tmp_path / "killed")] == list(range(1, before + 2))
    killed, whole = (log_of(tmp_path / name)[0]["losses"] for name in ("killed", "whole"))
    assert killed == whole


@pytest.mark.slow
def test_two_processes_equal_one_with_two_streams(shards, tmp_path):
    assert started(tmp_path / "one", 4, shards, streams=2).wait() == 0
    two = started(tmp_path / "two", 4, shards, launcher=TORCHRUN)
    assert two.wait() == 0, (tmp_path / "two.log").read_text()[-3000:]
    one, two = (load_file(tmp_path / n / "model.safetensors") for n in ("one", "two"))
    for key in one:
        assert torch.allclose(one[key], two[key], atol=2e-5), key
    curves = [[e["losses"]["total"] for e in log_of(tmp_path / n)] for n in ("one", "two")]
    assert curves[0] == pytest.approx(curves[1], rel=1e-4)
    assert len(set(curves[0])) == 4


@pytest.mark.slow
def test_no_process_ends_before_the_others(tmp_path):
    assert started(tmp_path / "made", 0, "", launcher=TORCHRUN, text=LAST).wait() == 0
