"""Idle OpenMP threads sleep, whether torch is imported before or after the package."""

import os
import subprocess
import sys

import pytest

from viewmend.utils.openmp import CHOICES, POLICY, let_idle_threads_sleep

BUSY_PROCESSES = 3
CONVOLUTIONS = """
import time
{first}
import torch
{second}
torch.set_num_threads(2)
layer = torch.nn.Conv2d(16, 16, 3, padding=1)
image = torch.rand(1, 16, 64, 64)

def work():
    with torch.no_grad():
        for _ in range(150):
            layer(image)
            torch.rand(100_000).add_(1)

work()
start = time.process_time()
work()
print(time.process_time() - start)
"""


def without_choice() -> dict[str, str]:
    return {name: value for name, value in os.environ.items() if name not in CHOICES}


def processor_seconds(first: str, second: str) -> float:
    """Processor time of convolutions on two threads in a process that imports these modules before and after torch."""
    script = CONVOLUTIONS.format(first=first, second=second)
    done = subprocess.run(
        [sys.executable, "-c", script], env=without_choice(), capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return float(done.stdout)


@pytest.fixture
def busy_cores():
    """Other programs that use every core."""
    count = BUSY_PROCESSES * (os.cpu_count() or 1)
    others = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    yield
    for other in others:
        other.kill()
        other.wait()


@pytest.mark.slow
@pytest.mark.skipif((os.cpu_count() or 1) < 2, reason="needs two cores")
@pytest.mark.parametrize("order", [("import viewmend", ""), ("", "import viewmend")], ids=["before", "after"])
def test_threads_do_not_spin_next_to_other_programs(busy_cores, order):
    spinning = processor_seconds("", "")
    sleeping = processor_seconds(*order)
    assert sleeping < 0.8 * spinning, (
        f"{sleeping:.2f} s of processor time, {spinning:.2f} s with spinning threads"
    )


@pytest.mark.parametrize("name", CHOICES)
def test_what_the_user_chose_stays(monkeypatch, name):
    for other in CHOICES:
        monkeypatch.delenv(other, raising=False)
    monkeypatch.setenv(name, "7")
    let_idle_threads_sleep()
    assert os.environ[name] == "7"
    assert {other for other in CHOICES if other in os.environ} == {name}


def test_processes_that_are_started_inherit_the_policy():
    script = f"import os, viewmend; print(os.environ['{POLICY}'])"
    done = subprocess.run(
        [sys.executable, "-c", script], env=without_choice(), capture_output=True, text=True
    )
    assert done.stdout == "PASSIVE\n", done.stderr


def test_importing_the_package_does_not_import_torch():
    script = "import sys, viewmend; print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.stdout == "False\n", done.stderr
