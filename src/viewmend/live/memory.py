"""Giving memory back.

Stores are bounded, but glibc keeps what lies free between things that live long: large buffers of views that are gone
beside frames that stay. Left alone that comes to more than the frames themselves.
"""

import ctypes
import os
import time
from functools import cache
from pathlib import Path

IDLE_S, BUSY_S = 20.0, 120.0
"""So often at most it is given back while nobody waits for a view, and at least."""
SLACK_BYTES = 128e6
"""What may lie free: it is used again at once, and giving it back takes time (11 ms for 130 MB, 40 for 300)."""
ARENAS = 1
"""Of glibc's heaps. By default there are eight a core, each with holes of its own that no other fills; here one thread
renders."""
LARGE_BYTES = 8_000_000
"""Larger buffers are mapped on their own, and unmapped after use: no view in motion needs such. glibc would raise the
limit to 32 MB by itself."""
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8


class _Usage(ctypes.Structure):
    """glibc's `struct mallinfo2`."""

    _fields_ = tuple(
        (name, ctypes.c_size_t)
        for name in ("arena", "ordblks", "smblks", "hblks", "hblkhd", "usmblks", "fsmblks", "used", "free", "top")
    )


@cache
def _glibc() -> ctypes.CDLL | None:
    """The C library, where it is glibc 2.33 or later."""
    try:
        library = ctypes.CDLL(None)
        library.mallinfo2.restype = _Usage
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


def free_bytes() -> int:
    """What the allocator holds and nobody uses; 0 where that is not known."""
    library = _glibc()
    return 0 if library is None else library.mallinfo2().free


def resident_bytes() -> int | None:
    """What the process occupies of the machine's memory; None where /proc does not say it."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except (OSError, IndexError, ValueError):
        return None
    return pages * os.sysconf("SC_PAGE_SIZE")


class Tidying:
    """Hands free memory back to the system now and then."""

    def __init__(self) -> None:
        self._last = time.monotonic()

    def when_due(self, idle: bool) -> bool:
        """Call it between views; whether something was handed back, which takes up to a tenth of a second."""
        now = time.monotonic()
        if now - self._last < (IDLE_S if idle else BUSY_S):
            return False
        self._last = now
        library = _glibc()
        if library is None or free_bytes() < SLACK_BYTES:
            return False
        library.malloc_trim(0)
        return True
