"""Fixtures of the live server's tests."""

import pytest
from live.live_servers import ball, ball_view
from reference.computed_once import compute_once

__all__ = ["ball", "ball_view"]


@pytest.fixture(autouse=True)
def _computed_once(monkeypatch):
    """Checks of a capture and people of the studio are computed once, not in each test."""
    compute_once(monkeypatch)
