"""Sharing work among threads on the CPU."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import torch


def share(work: Callable[[int], object], count: int) -> None:
    """Call `work(0)` to `work(count - 1)` on as many threads as torch uses; `work` must release the GIL to gain.

    Plain threads and not numba's own: those abort the process when two of our callers run at once, and may not be
    forked. Starting them costs about a tenth of a millisecond.
    """
    threads = min(torch.get_num_threads(), count)
    if threads <= 1:
        for item in range(count):
            work(item)
        return
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(work, range(count)))
