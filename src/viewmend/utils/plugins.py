"""Objects named by text: MODULE:NAME in registries, FILE.py:NAME of a user's file on the command line."""

import hashlib
import importlib
import importlib.util
import sys
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any


def import_object(name: str) -> Any:
    """Import NAME from MODULE:NAME, as registries name optional parts."""
    module, _, attribute = name.partition(":")
    return getattr(importlib.import_module(module), attribute)


def load_from_file(name: str) -> Callable[..., object]:
    """Import NAME from FILE.py:NAME, a class or a function.

    The module name contains the file's hash, so that a changed file is imported again; an
    unchanged file is not.

    Raises:
        ValueError: there is no such file, or it has no callable of that name.
    """
    file, _, wanted = name.rpartition(":")
    path = Path(file)
    if not path.is_file():
        raise ValueError(f"expected FILE.py:NAME, got '{name}', and there is no such file; check the path")
    module_name = _module_name(path.resolve(), path.stat().st_mtime_ns, path.stat().st_size)
    if module_name not in sys.modules:
        spec = importlib.util.spec_from_file_location(module_name, path)
        assert spec is not None and spec.loader is not None, "the suffix is .py"
        module = importlib.util.module_from_spec(spec)
        sys.modules[module_name] = module  # before it runs: dataclasses look their module up
        try:
            spec.loader.exec_module(module)
        except BaseException:
            del sys.modules[module_name]
            raise
    make = getattr(sys.modules[module_name], wanted, None)
    if not callable(make):
        raise ValueError(
            f"expected '{wanted}' in {path} to be a class or a function, found none; check FILE.py:NAME"
        )
    return make


@lru_cache(maxsize=16)
def _module_name(path: Path, changed_ns: int, size: int) -> str:
    return f"{path.stem}_{hashlib.sha256(path.read_bytes()).hexdigest()[:12]}"
