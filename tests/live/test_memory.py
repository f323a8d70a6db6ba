"""Memory that lies free goes back to the system."""

import gc
import re
import sys
import weakref
from pathlib import Path

import pytest

from viewmend.live import memory

pytestmark = pytest.mark.skipif(memory._glibc() is None, reason="needs glibc")


def resident_mb() -> float:
    found = re.search(r"VmRSS:\s+(\d+)", Path("/proc/self/status").read_text())
    return int(found[1]) / 1024 if found else 0.0


def test_what_lies_between_things_that_live_long_is_handed_back(monkeypatch):
    monkeypatch.setattr(memory, "IDLE_S", 0.0)
    blocks = [bytearray(60_000) for _ in range(6000)]  # below glibc's limit for mapping
    kept = blocks[::40]
    before = resident_mb()
    del blocks
    assert resident_mb() > before - 50
    assert memory.HeapTrimmer().when_due(idle=True)
    assert resident_mb() < before - 200
    assert sum(map(len, kept)) == 150 * 60_000


def test_a_little_is_kept_and_busy_times_are_left_alone(monkeypatch):
    monkeypatch.setattr(memory, "SLACK_BYTES", sys.maxsize)
    monkeypatch.setattr(memory, "IDLE_S", 0.0)
    tidying = memory.HeapTrimmer()
    assert not tidying.when_due(idle=True)
    monkeypatch.setattr(memory, "SLACK_BYTES", 50e6)
    assert not tidying.when_due(idle=False)
    assert tidying.when_due(idle=True)
    assert not tidying.when_due(idle=True), "nothing has come since"
    grown = bytearray(b"x") * 100_000_000
    assert tidying.when_due(idle=True) and len(grown) == 100_000_000


def test_cycles_go_before_memory_is_handed_back(monkeypatch):
    monkeypatch.setattr(memory, "IDLE_S", 0.0)

    class Connection:
        def __init__(self):
            self.scope = {"visitor": self}

    gc.disable()
    try:
        gone = weakref.ref(Connection())
        assert isinstance(gone(), Connection)
        grown = bytearray(b"x") * 50_000_000
        assert memory.HeapTrimmer().when_due(idle=True) and grown
        assert gone() is None
    finally:
        gc.enable()


def test_what_is_loaded_is_not_looked_at_again():
    try:
        memory.loaded()
        assert gc.get_freeze_count() > 1000
    finally:
        gc.unfreeze()
