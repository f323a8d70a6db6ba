"""Which steps of `research/gpu_first_hour.py` count as failures."""

from gpu_first_hour import OUT_OF_TIME, failed


def test_making_windows_ends_with_its_time_and_nothing_else_does():
    codes = {"tests": 5, "parity": 0, "windows": OUT_OF_TIME, "paper": 0}
    steps = {name: {"code": code} for name, code in codes.items()}
    assert failed(steps) == []
    assert failed(steps | {"windows": {"code": 1}, "paper": {"code": OUT_OF_TIME}}) == ["windows", "paper"]
