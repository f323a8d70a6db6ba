"""Giving memory back.

Stores are bounded, and have pages of their own (`own_pages.py`). But glibc keeps what lies free between small things
that live long and buffers of views that are gone. Left alone that comes to more than the stores.
"""

import ctypes
import os
import time
from functools import cache
from pathlib import Path

IDLE_S, BUSY_S = 5.0, 60.0
"""So often at most it is given back while nobody waits for a view, and while somebody does."""
SLACK_BYTES = 100e6
"""What may lie free, for it is used again at once: giving 100 MB back takes 10 ms, and getting them again more."""
ARENAS = 1
"""Of glibc's heaps. By default there are eight a core, each with holes of its own that no other fills; here one thread
renders."""
LARGE_BYTES = 8_000_000
"""Larger buffers are mapped on their own, and unmapped after use: no view in motion needs such. glibc would raise the
limit to 32 MB by itself."""
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
    """Call it before threads are started; whether it could be done."""
    library = _glibc()
    options = ((_M_ARENA_MAX, ARENAS), (_M_MMAP_THRESHOLD, LARGE_BYTES), (_M_TRIM_THRESHOLD, int(SLACK_BYTES / 2)))
    return library is not None and all(library.mallopt(*option) == 1 for option in options)


def resident_bytes() -> int | None:
    """What the process occupies of the machine's memory; None where /proc does not say it."""
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
        """What was resident when it was last given back: mostly what is in use."""

    def when_due(self, idle: bool) -> bool:
        """Call it between views; whether something was handed back, which takes some hundredths of a second."""
        now = time.monotonic()
        if now - self._last < (IDLE_S if idle else BUSY_S):
            return False
        self._last = now
        library, resident = _glibc(), resident_bytes()
        if library is None or resident is None or resident - self._least < SLACK_BYTES:
            return False
        library.malloc_trim(0)
        self._least = resident_bytes() or 0
        return True
