"""Reading files on disk, and data sets in HDF5 files by path: `take.smc/Camera_5mp/0/color/17`."""

import os
import unicodedata
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import h5py

SUFFIXES = (".smc", ".h5", ".hdf5")
MAX_BYTES = 2**28
"""The largest data set that is read: an encoded image."""


def container_of(path: Path) -> Path:
    """The file on disk that a path refers to: the path itself, or the HDF5 file that it leads into."""
    for number, part in enumerate(path.parts[:-1], 1):
        if part.lower().endswith(SUFFIXES) and (file := Path(*path.parts[:number])).is_file():
            return file
    return path


def stored_path(folder: Path, path: str, frames: Sequence[str] = ("",)) -> str:
    """A path in the folder with names as they are on disk, where "ä" is one character or two: systems differ.

    `{frame}` stands for each of `frames`; one that exists is enough. The path is unchanged if none does.
    """
    if path.isascii():
        return path
    parent, slash, name = path.rpartition("/")
    there = stored_path(folder, parent, frames)
    forms = (path, *(f"{there}{slash}{unicodedata.normalize(form, name)}" for form in ("NFC", "NFD")))
    files = ((form, folder / form.replace("{frame}", frame)) for form in forms for frame in frames)
    try:
        return next((form for form, file in files if file.exists()), path)
    except OSError:  # such as a name that is too long, which its reader reports
        return path


def names_in(folder: Path) -> frozenset[str]:
    """Names of the files in a folder, or of the members of an HDF5 group; empty if there is no such folder or group."""
    file = container_of(folder / "any")
    try:
        if file == folder / "any":
            with os.scandir(folder) as entries:
                return frozenset(entry.name for entry in entries if entry.is_file())
        with open_container(file) as root:
            group = member(root, folder.relative_to(file).parts)
            members = group if hasattr(group, "keys") else ()
            # h5py returns names of invalid UTF-8 as bytes
            return frozenset(name for name in members if isinstance(name, str))
    except OSError:
        return frozenset()


def read_bytes(path: Path, count: int | None = None) -> bytes:
    """Read all bytes of a file or data set, or the first `count`; OSError or ValueError if it has no readable bytes."""
    file = container_of(path)
    if file == path:
        with path.open("rb") as stream:
            return stream.read(-1 if count is None else count)
    with open_container(file) as root:
        data = member(root, path.relative_to(file).parts)
        size = getattr(data, "size", None)  # groups and named types have none
        if size is None or size > MAX_BYTES or data.dtype not in (np.uint8, np.int8):
            raise ValueError(
                f"{path}: expected the bytes of an image, got something else; copy the file again"
            )
        return np.asarray(data[()] if count is None or data.ndim != 1 else data[:count]).tobytes()


@contextmanager
def open_container(file: Path) -> "Iterator[h5py.File]":
    """Open an HDF5 file for reading; OSError for another or a damaged file."""
    import h5py

    try:
        with h5py.File(file, "r", locking=False) as root:
            yield root
    except (RuntimeError, KeyError) as error:  # raised by h5py for damaged files
        raise OSError(0, str(error)[:200]) from None


def member(root: Any, parts: tuple[str, ...]) -> Any:
    """The group or data set at this path, OSError without one. Links and data outside the file are not followed."""
    import h5py

    for part in parts:
        link = root.get(part, getlink=True) if isinstance(root, h5py.Group) else None
        if not isinstance(link, h5py.HardLink):
            raise FileNotFoundError(2, f"no {'/'.join(parts)} in the file")
        root = root[part]
        if isinstance(root, h5py.Dataset) and (root.external or root.is_virtual):
            raise PermissionError(1, "its data are stored in another file")
    return root
