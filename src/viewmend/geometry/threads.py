"""Multithreading on the CPU where it pays off."""

import itertools
import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache

import torch

_torch = threading.local()


def parallel_for(work: Callable[[int], object], count: int) -> None:
    """Call `work(0)` to `work(count - 1)` on as many threads as torch may use; `work` must release the GIL to gain.

    Uses plain threads instead of numba's, which abort the process when two callers run at once and
    do not survive a fork. The calling thread takes part and does not wait for the others to start;
    the pool is reused, because starting threads costs a millisecond on busy cores.
    """
    items = itertools.count()

    def run() -> None:
        while (item := next(items)) < count:
            work(item)

    threads = _most_threads()
    others = [_pool(threads).submit(run) for _ in range(min(threads, count) - 1)]
    try:
        run()
    finally:
        for other in others:
            if not other.cancel():
                other.result()


@contextmanager
def one_thread() -> Iterator[None]:
    """Run torch operations on the calling thread only, except in `all_threads`; `parallel_for` is unaffected.

    Most operations on one view take less time than waking another thread. Context manager and
    decorator.
    """
    with _torch_threads(1):
        yield


@contextmanager
def all_threads() -> Iterator[None]:
    """Run torch operations on all threads again, inside `one_thread`: convolutions and networks gain by that."""
    with _torch_threads(_most_threads()):
        yield


@contextmanager
def _torch_threads(count: int) -> Iterator[None]:
    before = torch.get_num_threads()
    most = getattr(_torch, "most", None)
    _torch.most = _most_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
        _torch.most = most


def _most_threads() -> int:
    """How many threads torch uses outside of `one_thread`."""
    return getattr(_torch, "most", None) or torch.get_num_threads()


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="share")


if hasattr(os, "register_at_fork"):  # a forked child does not have its parent's threads
    os.register_at_fork(after_in_child=_pool.cache_clear)
