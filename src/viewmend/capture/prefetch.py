"""Reading ahead, so that the disk is not what limits."""

from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice

from viewmend.capture.source import CaptureSource
from viewmend.views import MultiViewFrame

AHEAD = 2
"""So many frames are read while one is used."""


def prefetch(source: CaptureSource, times: Iterable[int] | None = None) -> Iterator[MultiViewFrame]:
    """The frames at `times` (default: all) in order, the next ones being read while one is used.

    One frame is read at once: folders read its cameras in parallel, and videos must be asked for frames in order. An
    error of reading a frame is raised where that frame would have come. Closing the iterator, or leaving its loop,
    drops what was not begun.
    """
    coming = iter(range(len(source.frame_ids)) if times is None else times)
    reading: deque[Future[MultiViewFrame]] = deque()
    pool = ThreadPoolExecutor(1, thread_name_prefix="prefetch")
    try:
        while True:
            reading.extend(pool.submit(source.read, time) for time in islice(coming, AHEAD + 1 - len(reading)))
            if not reading:
                return
            yield reading.popleft().result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
