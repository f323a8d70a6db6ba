"""Free memory is returned to the system."""

import gc
import re
import weakref
from pathlib import Path

import pytest
from live.live_servers import FakeClock

from viewmend.utils import heap

pytestmark = pytest.mark.skipif(heap._glibc() is None, reason="needs glibc")


def resident_mb() -> float:
    found = re.search(r"VmRSS:\s+(\d+)", Path("/proc/self/status").read_text())
    return int(found[1]) / 1024 if found else 0.0


def trim_now() -> bool:
    """Trim with a trimmer whose time has come."""
    clock = FakeClock()
    trimmer = heap.HeapTrimmer(clock)
    clock.advance(heap.IDLE_S)
    return trimmer.trim_if_due(idle=True)


def test_memory_between_long_lived_objects_is_returned():
    blocks = [bytearray(60_000) for _ in range(6000)]  # below glibc's threshold for mapping
    kept = blocks[::40]
    before = resident_mb()
    del blocks
    assert resident_mb() > before - 50
    assert trim_now()
    assert resident_mb() < before - 200
    assert sum(map(len, kept)) == 150 * 60_000


def test_trims_are_due_at_intervals_and_after_growth(monkeypatch):
    clock, resident = FakeClock(), [500e6]
    monkeypatch.setattr(heap, "resident_bytes", lambda: resident[0])
    trimmer = heap.HeapTrimmer(clock)
    assert not trimmer.trim_if_due(idle=True)
    clock.advance(heap.IDLE_S)
    assert not trimmer.trim_if_due(idle=False)
    assert trimmer.trim_if_due(idle=True)
    for grown in (0, 2 * heap.MIN_GROWTH_BYTES):
        resident[0] += grown
        clock.advance(heap.BUSY_S)
        assert trimmer.trim_if_due(idle=False), "what was in use at the last trim may be free"
        if grown:
            clock.advance(heap.BUSY_S)
            assert trimmer.trim_if_due(idle=False)
        clock.advance(heap.BUSY_S)
        assert not trimmer.trim_if_due(idle=True), "it has not grown since"


def test_reference_cycles_are_collected_before_memory_is_returned():
    class Connection:
        def __init__(self):
            self.scope = {"connection": self}

    gc.disable()
    try:
        gone = weakref.ref(Connection())
        assert isinstance(gone(), Connection)
        assert trim_now()
        assert gone() is None
    finally:
        gc.enable()


def test_loaded_objects_are_excluded_from_collection():
    try:
        heap.freeze_loaded_objects()
        assert gc.get_freeze_count() > 1000
    finally:
        gc.unfreeze()


def test_compiled_convolutions_are_bounded(monkeypatch):
    monkeypatch.setenv("ONEDNN_PRIMITIVE_CACHE_CAPACITY", "7")
    assert heap.configure_allocator() and heap.os.environ["ONEDNN_PRIMITIVE_CACHE_CAPACITY"] == "7", (
        "the user's choice"
    )
    monkeypatch.delenv("ONEDNN_PRIMITIVE_CACHE_CAPACITY")
    assert heap.configure_allocator()
    assert heap.os.environ["ONEDNN_PRIMITIVE_CACHE_CAPACITY"] == str(heap.KERNELS)
