"""Handing free memory back to the system.

The caches of frames and of the stream are bounded, and have memory pages of their own (`own_pages.py`). But glibc keeps
the free memory between small objects that live long and buffers of views that are gone. Without this module it comes to
more than the caches.
"""

import ctypes
import gc
import os
import time
from functools import cache
from pathlib import Path

IDLE_S, BUSY_S = 5.0, 20.0
"""Least seconds from one time to the next: while nobody waits for a view, and while somebody does."""
SLACK_BYTES = 10e6
"""Growth that is not worth looking at. To hand 100 MB back takes 10 ms, to get them again more."""
TOP_BYTES = 50_000_000
"""Free memory at the heap's end that glibc keeps by itself, since it is used again at once."""
ARENAS = 1
"""Heaps of glibc. By default there are eight a core, each with free memory that the others do not use; here one thread
renders."""
LARGE_BYTES = 8_000_000
"""Larger buffers are mapped on their own, and unmapped after use; no moving view needs one. By itself glibc would raise
the limit to 32 MB."""
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8


@cache
def _glibc() -> ctypes.CDLL | None:
    """The C library, where it is glibc."""
    try:
        library = ctypes.CDLL(None)
        library.malloc_trim.argtypes = [ctypes.c_size_t]
        library.mallopt.argtypes = [ctypes.c_int, ctypes.c_int]
    except (OSError, AttributeError, TypeError):  # other systems have other allocators
        return None
    return library


def set_up() -> bool:
    """Set the allocator's options, before threads are started; whether it could be done."""
    library = _glibc()
    options = ((_M_ARENA_MAX, ARENAS), (_M_MMAP_THRESHOLD, LARGE_BYTES), (_M_TRIM_THRESHOLD, TOP_BYTES))
    return library is not None and all(library.mallopt(*option) == 1 for option in options)


def loaded() -> None:
    """What is there by now stays: the collector need not look at it again, which took it 0.16 s each time."""
    gc.collect()
    gc.freeze()


def resident_bytes() -> int | None:
    """Physical memory of the process; None where /proc does not say it."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except (OSError, IndexError, ValueError):
        return None
    return pages * os.sysconf("SC_PAGE_SIZE")


class HeapTrimmer:
    """Hands free memory back to the system now and then."""

    def __init__(self) -> None:
        self._last = time.monotonic()
        self._least = 0
        """Resident bytes after the last time: mostly what is in use."""

    def when_due(self, idle: bool) -> bool:
        """Hand memory back if it is time; whether it was. Call it between views: it takes hundredths of a second."""
        now = time.monotonic()
        if now - self._last < (IDLE_S if idle else BUSY_S):
            return False
        self._last = now
        library, resident = _glibc(), resident_bytes()
        if library is None or resident is None or resident - self._least < SLACK_BYTES:
            return False
        gc.collect()  # connections that are gone are cycles, which by itself Python leaves until there are 100,000 more
        library.malloc_trim(0)
        self._least = resident_bytes() or 0
        return True
