"""Sharing work among threads on the CPU."""

import itertools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache

import torch


def parallel_for(work: Callable[[int], object], count: int) -> None:
    """Call `work(0)` to `work(count - 1)` on as many threads as torch uses; `work` must release the GIL to gain.

    Plain threads and not numba's own: those abort the process when two of our callers run at once, and may not be
    forked. The caller works, too, and waits for none of them to begin: started anew each time, threads cost a
    millisecond where the cores are busy.
    """
    items = itertools.count()

    def run() -> None:
        while (item := next(items)) < count:
            work(item)

    threads = torch.get_num_threads()
    others = [_pool(threads).submit(run) for _ in range(min(threads, count) - 1)]
    try:
        run()
    finally:
        for other in others:
            if not other.cancel():
                other.result()


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="share")


if hasattr(os, "register_at_fork"):  # a child has none of its parent's threads
    os.register_at_fork(after_in_child=_pool.cache_clear)
