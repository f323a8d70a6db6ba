"""Files on disk, and data sets within HDF5 files as if these were folders: `take.smc/Camera_5mp/0/color/17`."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import h5py

SUFFIXES = (".smc", ".h5", ".hdf5")
MOST_BYTES = 2**28
"""The largest data set that is read: an encoded image."""


def container_of(path: Path) -> Path:
    """The file on disk that holds what this path names: itself, or the HDF5 file that it leads into."""
    for number, part in enumerate(path.parts[:-1], 1):
        if part.lower().endswith(SUFFIXES) and (file := Path(*path.parts[:number])).is_file():
            return file
    return path


def names_in(folder: Path) -> frozenset[str]:
    """Names of the files in a folder, or of the members of a group; none where there is no such place."""
    file = container_of(folder / "any")
    if file == folder / "any":
        try:
            with os.scandir(folder) as entries:
                return frozenset(entry.name for entry in entries if entry.is_file())
        except OSError:
            return frozenset()
    try:
        with opened(file) as root:
            group = member(root, folder.relative_to(file).parts)
            members = group if hasattr(group, "keys") else ()
            return frozenset(name for name in members if isinstance(name, str))  # bytes that are no text stay bytes
    except OSError:
        return frozenset()


def read_bytes(path: Path, most: int | None = None) -> bytes:
    """All bytes of a file or a data set, or the first `most` of them.

    Raises:
        OSError: it cannot be read.
        ValueError: what the container has there is no series of bytes.
    """
    file = container_of(path)
    if file == path:
        with path.open("rb") as stream:
            return stream.read(-1 if most is None else most)
    with opened(file) as root:
        data = member(root, path.relative_to(file).parts)
        size = getattr(data, "size", None)  # groups and named types have none
        if size is None or size > MOST_BYTES or data.dtype not in (np.uint8, np.int8):
            raise ValueError(f"{path}: expected the bytes of an image, got something else; copy the file again")
        return np.asarray(data[()] if most is None or data.ndim != 1 else data[:most]).tobytes()


@contextmanager
def opened(file: Path) -> "Iterator[h5py.File]":
    """An HDF5 file, for reading.

    Raises:
        OSError: it is none, or damaged.
        ValueError: h5py is not there.
    """
    try:
        import h5py
    except ImportError:
        raise ValueError(f"{file}: expected h5py to read it, got none; pip install 'viewmend[datasets]'") from None
    try:
        with h5py.File(file, "r", locking=False) as root:
            yield root
    except (RuntimeError, KeyError) as error:  # what h5py says of damaged files
        raise OSError(0, str(error)[:200]) from None


def member(root: Any, parts: tuple[str, ...]) -> Any:
    """The group or data set at the end of these names. Nothing outside the file is followed.

    Raises:
        OSError: there is none.
    """
    import h5py

    for part in parts:
        link = root.get(part, getlink=True) if isinstance(root, h5py.Group) else None
        if not isinstance(link, h5py.HardLink):
            raise FileNotFoundError(2, f"no {'/'.join(parts)} in the file")
        root = root[part]
        if isinstance(root, h5py.Dataset) and (root.external or root.is_virtual):
            raise PermissionError(1, "its data lie in another file")
    return root
