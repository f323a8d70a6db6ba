"""Let the idle threads of PyTorch's OpenMP pool sleep, so that other programs do not slow this one down.

By default, threads of GCC's OpenMP library spin for milliseconds whenever they wait. If another
program uses a core, the threads that have a core spin for the one that has none, and a network
takes up to twelve times as long.
"""

import os
import sys
import threading

POLICY = "OMP_WAIT_POLICY"
"""The environment variable that OpenMP libraries read when they are loaded."""

CHOICES = (POLICY, "GOMP_SPINCOUNT", "KMP_BLOCKTIME")
"""The environment variables by which a user decides how long idle threads spin; we change nothing
if one is set."""


def let_idle_threads_sleep() -> None:
    """Make idle OpenMP threads sleep in this process and in those that it starts; called by `import viewmend`.

    The environment variable is enough if torch has not been imported yet. Otherwise its OpenMP
    library has already read the environment. GCC's library then spins briefly only while it manages
    more threads than there are cores (GOMP_SPINCOUNT in its manual), so a pool of threads that
    sleeps until the process ends brings it to that.
    """
    if any(name in os.environ for name in CHOICES):
        return
    os.environ[POLICY] = "PASSIVE"
    if "torch" in sys.modules:
        _occupy_idle_pool()


def _occupy_idle_pool() -> None:
    """Start a pool of one OpenMP thread for each core, and let it sleep."""
    import torch

    is_started = threading.Event()

    def start_and_sleep() -> None:
        torch.set_num_threads(os.cpu_count() or 1)
        torch.zeros(2**20).add_(1)  # large enough for torch to use all threads
        is_started.set()
        threading.Event().wait()

    threading.Thread(target=start_and_sleep, name="sleeping-openmp-pool", daemon=True).start()
    is_started.wait()
