"""No file imports another that imports it, directly or through others; layers are import-linter's (pyproject.toml)."""

from collections.abc import Mapping
from graphlib import CycleError, TopologicalSorter

import grimp
import pytest


def cycle(imports: Mapping[str, set[str]]) -> list[str]:
    """A cycle in a graph of imports, or nothing."""
    try:
        TopologicalSorter(imports).prepare()
    except CycleError as error:
        return error.args[1]
    return []


def test_there_are_no_import_cycles():
    graph = grimp.build_graph("viewmend", exclude_type_checking_imports=True, cache_dir=None)
    imports = {name: graph.find_modules_directly_imported_by(name) for name in graph.modules}
    assert len(imports) > 100
    assert cycle(imports) == []


@pytest.mark.parametrize("last, expected", [(set(), []), ({"a"}, ["a", "b", "c"])])
def test_a_cycle_is_found(last, expected):
    assert sorted(set(cycle({"a": {"b"}, "b": {"c"}, "c": last}))) == expected
