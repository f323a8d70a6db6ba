"""Reading ahead, so that the disk is not what limits."""

from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice

from viewmend.capture.source import CaptureSource
from viewmend.views import MultiViewFrame


def prefetch(
    source: CaptureSource, times: Iterable[int] | None = None, ahead: int = 2, workers: int = 1
) -> Iterator[MultiViewFrame]:
    """The frames at `times` (default: all) in order, the next `ahead` of them being read while one is used.

    `workers` frames are read at once. One is right for folders, which read their cameras in parallel, and for videos,
    whose frames must be asked for in order; more help a source that uses one core. An error of reading a frame is
    raised where that frame would have come. Closing the iterator, or leaving its loop, drops what was not begun.

    Raises:
        ValueError: `ahead` or `workers` is below one.
    """
    if ahead < 1 or workers < 1:
        raise ValueError(
            f"expected to read at least 1 frame ahead with 1 worker, got {ahead} and {workers}; raise them"
        )
    return _read_ahead(source, range(len(source.frame_ids)) if times is None else times, ahead, workers)


def _read_ahead(source: CaptureSource, times: Iterable[int], ahead: int, workers: int) -> Iterator[MultiViewFrame]:
    coming = iter(times)
    reading: deque[Future[MultiViewFrame]] = deque()
    pool = ThreadPoolExecutor(workers, thread_name_prefix="prefetch")
    try:
        while True:
            reading.extend(pool.submit(source.read, time) for time in islice(coming, ahead + 1 - len(reading)))
            if not reading:
                return
            yield reading.popleft().result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
