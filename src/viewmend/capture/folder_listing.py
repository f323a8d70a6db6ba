"""Which files a folder has, asking the disk once per folder instead of once per file."""

import os
from pathlib import Path


class FolderListing:
    """The files below a folder, each subfolder listed when it is first asked about. A snapshot: it does not refresh."""

    def __init__(self, folder: Path):
        self.folder = folder
        self._names: dict[str, frozenset[str]] = {}

    def has(self, path: str) -> bool:
        """Whether `path`, relative to the folder, is a file."""
        parent, name = os.path.split(path)
        names = self._names.get(parent)
        if names is None:
            names = self._names[parent] = self._list(parent)
        return name in names

    def _list(self, parent: str) -> frozenset[str]:
        try:
            with os.scandir(self.folder / parent) as entries:
                return frozenset(entry.name for entry in entries if entry.is_file())
        except OSError:
            return frozenset()
