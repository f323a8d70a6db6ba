"""The small capture folder of the data tests."""

from data.conftest import plain

__all__ = ["plain"]
