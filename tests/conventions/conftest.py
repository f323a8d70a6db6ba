"""The syntax trees of the source files, some hundred thousand objects, are kept for these tests only."""

import pytest
from conventions.line_counts import parse


@pytest.fixture(scope="package", autouse=True)
def _trees():
    yield
    parse.cache_clear()
