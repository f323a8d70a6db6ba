"""What tests of scenes share."""

import pytest
from reference.computed_once import compute_once


@pytest.fixture(autouse=True)
def _computed_once(monkeypatch):
    """Checks of a capture and people of the studio are computed once, not in each test."""
    compute_once(monkeypatch)
