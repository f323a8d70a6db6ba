"""What readers of formats ask of files: the size of an image, names of cameras."""

from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from viewmend.capture.containers import read_bytes
from viewmend.capture.images import told_size
from viewmend.capture.plain_format import stays_inside

HEAD_BYTES = 2**20
"""How much of an image is read to learn its size."""


def places_named(folder: Path, part: str) -> list[Path]:
    """The folder, and those within it whose name has this part; none where there is no folder."""
    within = sorted(folder.iterdir()) if folder.is_dir() else []
    return [folder, *(path for path in within if path.is_dir() and part in path.name.lower())] if within else []


def image_size_px(folder: Path, name: str) -> tuple[int, int]:
    """Width and height of an image in the folder, from its head.

    Raises:
        ValueError: the path leaves the folder, or there is no such image.
    """
    told = None
    if stays_inside(name):
        try:
            told = told_size(read_bytes(folder / name, HEAD_BYTES))
        except OSError:
            told = None
    if told is None:
        raise ValueError(f"expected an image {name[:200]!r} in the folder that tells the size, got none; add the file")
    return told


def camera_names(paths: Sequence[str]) -> list[str]:
    """A name for the camera of each image: the file's, or the whole path's where files share names."""
    stems = [PurePosixPath(path).stem for path in paths]
    if len(set(stems)) == len(stems):
        return stems
    return [str(PurePosixPath(path).with_suffix("")).replace("/", "_") if path else path for path in paths]


def mask_beside(folder: Path, image: str) -> str | None:
    """The path of an image's mask in `masks`: `a.jpg.png` as COLMAP has it, or `a.png`; None without that folder."""
    if not (folder / "masks").is_dir():
        return None
    own = f"masks/{image}.png"
    replaced = f"masks/{image.rpartition('.')[0]}.png"
    return replaced if "\0" not in image and (folder / replaced).is_file() else own


def rotation_of(name: str, values: object) -> list[list[float]]:
    """A rotation from its nine numbers, or from Rodrigues' vector.

    Raises:
        ValueError: these are neither.
    """
    import cv2

    numbers = _numbers(values)
    if numbers.size not in (3, 9):
        raise ValueError(f"camera '{name}': expected a rotation of 3 or 9 numbers, got {numbers.size}; add it")
    matrix = cv2.Rodrigues(numbers)[0] if numbers.size == 3 else numbers.reshape(3, 3)
    return np.asarray(matrix).tolist()


def five_coefficients(name: str, values: object) -> list[float]:
    """OpenCV's k1 k2 p1 p2 k3, of which the last may be left out; nothing for a lens without distortion.

    Raises:
        ValueError: there are more that are not 0, or fewer.
    """
    numbers = _numbers(values)
    if 0 < numbers.size < 4 or numbers[5:].any():
        raise ValueError(
            f"camera '{name}': expected k1 k2 p1 p2 k3, got {numbers.size} numbers; undistort the images first"
        )
    return [*numbers[:5].tolist(), 0.0, 0.0, 0.0, 0.0, 0.0][:5]


def _numbers(values: object) -> np.ndarray:
    try:
        return np.asarray(values, float).ravel()
    except (TypeError, ValueError, OverflowError):
        raise ValueError("expected numbers, got something else; export the calibration again") from None


def inverted(world_from_camera: np.ndarray) -> dict[str, list[Any]]:
    """R and t of a `cameras.json`, which map world to camera, from a matrix of 3 x 4 or 4 x 4 that maps back."""
    R = world_from_camera[:3, :3].T
    return {"R": R.tolist(), "t": (-R @ world_from_camera[:3, 3]).tolist()}
