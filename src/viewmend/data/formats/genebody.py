"""GeneBody: `annots.npy` with cameras by name, `image/<camera>/<frame>` and `mask/<camera>/mask<frame>`."""

from pathlib import Path
from typing import Any

from viewmend.data.formats.files import collect_footage, invert_pose, to_distortion, with_folders
from viewmend.utils.safe_pickle import numbers, read_objects

FPS = 15.0


def find(folder: Path) -> Path | None:
    """The annotations."""
    return (
        folder / "annots.npy" if (folder / "annots.npy").is_file() and (folder / "image").is_dir() else None
    )


def content(folder: Path, file: Path) -> dict[str, Any]:
    """The cameras that have images; some subjects lack some."""
    annotations = read_objects(file)
    cameras = annotations.get("cams") if isinstance(annotations, dict) else None
    if not isinstance(cameras, dict) or not all(isinstance(camera, dict) for camera in cameras.values()):
        raise ValueError("expected cameras by name in 'cams', got others; is it a file of GeneBody?")
    named = {str(name): camera for name, camera in cameras.items()}
    used = {name: named[name] for name in with_folders(folder, "image", named)}
    footage = collect_footage(folder, {name: f"image/{name}" for name in used})
    entries = []
    for name, camera in used.items():
        lens = {
            "K": numbers(camera.get("K"), 3, 3).tolist(),
            "dist": to_distortion(name, numbers(camera.get("D"), 5)),
        }
        entries.append(footage.entry(name) | lens | invert_pose(numbers(camera.get("c2w"), 4, 4)))
    return {"up": [0.0, -1.0, 0.0], "fps": FPS, "frames": footage.frames, "cameras": entries}
