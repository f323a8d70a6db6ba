"""Returning free memory to the system.

The frame caches are bounded and use memory pages of their own (`utils/tensors.py`). But glibc keeps the free
memory between small long-lived objects, where the buffers of earlier views were. It would exceed the caches.
"""

import ctypes
import gc
import os
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path

IDLE_S = 5.0
"""Trims are at least this many seconds apart while no view is requested."""
BUSY_S = 20.0
"""Trims are at least this many seconds apart while views are requested."""
MIN_GROWTH_BYTES = 10e6
"""Smaller growth is not trimmed: to return 100 MB takes 10 ms, and to allocate them again takes longer."""
TOP_BYTES = 50_000_000
"""Free memory at the end of the heap that glibc keeps, as it is soon used again."""
ARENAS = 1
"""Heaps of glibc. By default there are eight per core, each with its own free memory; here one
thread renders."""
LARGE_BYTES = 8_000_000
"""Larger buffers are mapped separately and unmapped after use; no moving view needs one. By
default, glibc raises this threshold up to 32 MB."""
KERNELS = 64
"""Compiled convolutions that oneDNN keeps, each for one size of image. By default 1024, which fill
150 MB and more."""
_M_TRIM_THRESHOLD = -1
_M_MMAP_THRESHOLD = -3
_M_ARENA_MAX = -8


@cache
def _glibc() -> ctypes.CDLL | None:
    """The C library, if it is glibc."""
    try:
        library = ctypes.CDLL(None)
        library.malloc_trim.argtypes = [ctypes.c_size_t]
        library.mallopt.argtypes = [ctypes.c_int, ctypes.c_int]
    except (OSError, AttributeError, TypeError):  # other systems have other allocators
        return None
    return library


def configure_allocator(large_bytes: int = LARGE_BYTES) -> bool:
    """Set the allocator's options and oneDNN's, before threads are started and images processed; True on success.

    Buffers of more than `large_bytes` are mapped separately.
    """
    os.environ.setdefault("ONEDNN_PRIMITIVE_CACHE_CAPACITY", str(KERNELS))
    library = _glibc()
    options = ((_M_ARENA_MAX, ARENAS), (_M_MMAP_THRESHOLD, large_bytes), (_M_TRIM_THRESHOLD, TOP_BYTES))
    return library is not None and all(library.mallopt(*option) == 1 for option in options)


def freeze_loaded_objects() -> None:
    """Exclude all present objects from garbage collection, which took 0.16 s per collection with them."""
    gc.collect()
    gc.freeze()


def resident_bytes() -> int | None:
    """Physical memory of the process; None if /proc does not provide it."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[1])
    except (OSError, IndexError, ValueError):
        return None
    return pages * os.sysconf("SC_PAGE_SIZE")


class HeapTrimmer:
    """Returns free memory to the system at intervals."""

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self._now = now
        self._trimmed_at = now()
        self._baseline_bytes = 0
        """Resident memory after the last trim: mostly memory in use."""
        self._grew = False
        """Whether the last trim followed growth: what was in use then may be free by the next."""

    def trim_if_due(self, idle: bool) -> bool:
        """Trim if it is due; True if memory was returned. Call it between views, as it takes hundredths of a second."""
        now = self._now()
        if now - self._trimmed_at < (IDLE_S if idle else BUSY_S):
            return False
        self._trimmed_at = now
        library = _glibc()
        resident = resident_bytes()
        if library is None or resident is None:
            return False
        grew_before = self._grew
        self._grew = resident - self._baseline_bytes >= MIN_GROWTH_BYTES
        if not (self._grew or grew_before):
            return False
        gc.collect()  # closed connections are reference cycles, which Python collects after 100,000 more objects
        library.malloc_trim(0)
        self._baseline_bytes = resident_bytes() or 0
        return True
