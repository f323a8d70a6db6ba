"""GeneBody: `annots.npy` with cameras by their names, `image/<camera>/<frame>` and `mask/<camera>/mask<frame>`."""

from pathlib import Path
from typing import Any

from viewmend.capture.formats.files import five_coefficients, inverted
from viewmend.capture.formats.footage import footage_of
from viewmend.capture.formats.numpy_objects import numbers, read_objects

FPS = 15.0


def find(folder: Path) -> Path | None:
    """The file by which the folder is recognised."""
    return folder / "annots.npy" if (folder / "annots.npy").is_file() and (folder / "image").is_dir() else None


def content(folder: Path, file: Path) -> dict[str, Any]:
    """What a `cameras.json` of these cameras would hold, of those that have images: some subjects lack some.

    Raises:
        ValueError: the annotations hold something else, or a camera's matrix is absent.
    """
    told = read_objects(file)
    cams = told.get("cams") if isinstance(told, dict) else None
    if not isinstance(cams, dict) or not all(isinstance(cam, dict) for cam in cams.values()):
        raise ValueError("expected cameras by their names in 'cams', got others; is it GeneBody's file?")
    there = {str(name): cam for name, cam in cams.items() if (folder / "image" / str(name)).is_dir()}
    footage = footage_of(folder, {name: f"image/{name}" for name in there})
    entries = []
    for name, cam in there.items():
        lens = {"K": numbers(cam.get("K"), 3, 3).tolist(), "dist": five_coefficients(name, numbers(cam.get("D"), 5))}
        entries.append(footage.of(name) | lens | inverted(numbers(cam.get("c2w"), 4, 4)))
    return {"up": [0.0, -1.0, 0.0], "fps": FPS, "frames": footage.frames, "cameras": entries}
