"""What a module of this package provides to read a capture format."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any


@dataclass(frozen=True)
class Format:
    """The functions of a format's module."""

    find: Callable[[Path], Path | None]
    """The file in a folder that identifies the format; None if it has none."""
    content: Callable[[Path, Path], dict[str, Any]]
    """The content of a `cameras.json`, from the folder and that file."""
    root: Callable[[Path, Path], Path] = lambda path, _: path
    """The folder that the paths in the content are relative to."""

    @classmethod
    def of_module(cls, module: ModuleType) -> "Format":
        """The functions of a module; `root` is optional."""
        return cls(module.find, module.content, getattr(module, "root", cls.root))
