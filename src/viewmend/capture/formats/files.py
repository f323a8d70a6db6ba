"""What readers of formats ask of files: bounded bytes, the size of an image, names of cameras."""

from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from viewmend.capture.images import told_size
from viewmend.capture.plain_format import stays_inside

MOST_BYTES = 2**29
"""The largest calibration file that is read; a COLMAP model of a thousand images has about 100 MB."""
HEAD_BYTES = 2**20
"""How much of an image is read to learn its size."""


def bounded_bytes(path: Path, most: int = MOST_BYTES) -> bytes:
    """All bytes of a file.

    Raises:
        ValueError: the file is larger than `most`.
        OSError: it cannot be read.
    """
    with path.open("rb") as file:
        data = file.read(most + 1)
    if len(data) > most:
        raise ValueError(f"expected {path.name} to have at most {most} bytes, got more; is it the right file?")
    return data


def image_size_px(folder: Path, name: str) -> tuple[int, int]:
    """Width and height of an image in the folder, from its head.

    Raises:
        ValueError: the path leaves the folder, or there is no such image.
    """
    told = None
    if stays_inside(name) and (folder / name).is_file():
        with (folder / name).open("rb") as file:
            told = told_size(file.read(HEAD_BYTES))
    if told is None:
        raise ValueError(f"expected an image {name[:200]!r} in the folder that tells the size, got none; add the file")
    return told


def camera_names(paths: Sequence[str]) -> list[str]:
    """A name for the camera of each image: the file's, or the whole path's where files share names."""
    stems = [PurePosixPath(path).stem for path in paths]
    if len(set(stems)) == len(stems):
        return stems
    return [str(PurePosixPath(path).with_suffix("")).replace("/", "_") if path else path for path in paths]
