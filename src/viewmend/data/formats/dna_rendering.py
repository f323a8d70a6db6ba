"""DNA-Rendering's pairs of HDF5 files: `0012_11.smc` with images, `0012_11_annots.smc` with cameras and masks."""

import os
from pathlib import Path
from typing import Any

import numpy as np

from viewmend.data.containers import member, names_in, open_container
from viewmend.data.formats.files import (
    files_like,
    folders_containing,
    image_size_px,
    invert_pose,
    to_distortion,
    warn_of_unmatched,
)

SUFFIX = ".smc"
"""Files of the data set have this suffix."""
ANNOTATIONS = "_annots.smc"
"""Names of files with calibration and masks end with this."""
GROUPS = ("Camera_5mp", "Camera_12mp")
"""The two camera models; their cameras are numbered consecutively."""
FPS = 15.0


def find(path: Path) -> Path | None:
    """The file with images: the path itself or its pair, or the first in the folder or in a subfolder `*main*`."""
    if path.suffix == SUFFIX and path.is_file():
        stem = path.name.removesuffix(ANNOTATIONS)
        return (
            path if stem == path.name else _paired(path.absolute(), f"{stem}{SUFFIX}", "annotations", "main")
        )
    return next(iter(_image_files(path)), None)


def root(path: Path, file: Path) -> Path:
    """The folder that contains both files of a pair."""
    return Path(os.path.commonpath([one.absolute().parent for one in (file, _annotations_of(file) or file)]))


def content(path: Path, file: Path) -> dict[str, Any]:
    """The cameras that have images and parameters, of a single sequence."""
    files = [file] if path.is_file() else _image_files(path)
    if len(files) > 1:
        raise ValueError(
            f"expected one sequence, got {len(files)} in {path}; open one of them, e.g. {files[0].name}"
        )
    annotations = _annotations_of(file)
    if annotations is None:
        expected = f"{file.stem}{ANNOTATIONS} next to it or in the folder of annotations"
        raise ValueError(f"expected {expected}, got none; copy it too")
    folder = root(path, file)
    main, masks = (os.path.relpath(one.absolute(), folder) for one in (file, annotations))
    parameters = _parameters(annotations)
    masked = _camera_numbers(annotations, "Mask")
    recorded = [camera for group in GROUPS for camera in sorted(_camera_numbers(file, group), key=int)]
    without = [camera for camera in sorted(parameters, key=int) if camera not in recorded]
    warn_of_unmatched(folder, without, [camera for camera in recorded if camera not in parameters])
    entries = []
    frames = set()
    for group in GROUPS:
        for camera in sorted(_camera_numbers(file, group) & parameters.keys(), key=int):
            own = {frame for frame in names_in(file / group / camera / "color") if frame.isdecimal()}
            if not own:
                continue
            frames |= own
            entry: dict[str, Any] = {
                "name": f"{int(camera):02d}",
                "image": f"{main}/{group}/{camera}/color/{{frame}}",
            }
            first = entry["image"].replace("{frame}", min(own, key=int))
            entry["width"], entry["height"] = image_size_px(folder, first)
            if camera in masked:
                entry["mask"] = f"{masks}/Mask/{camera}/mask/{{frame}}"
            entries.append(entry | parameters[camera])
    return {"fps": FPS, "frames": sorted(frames, key=int), "cameras": entries}


def _image_files(folder: Path) -> list[Path]:
    """The files with images in the folder, or else in its subfolders `*main*`."""
    for places in ([folder], folders_containing(folder, "main")[1:]):
        files = [file for place in places for file in files_like(place, f"*{SUFFIX}")]
        found = [file for file in files if not file.name.endswith(ANNOTATIONS)]
        if found:
            return found
    return []


def _annotations_of(file: Path) -> Path | None:
    return _paired(file.absolute(), f"{file.stem}{ANNOTATIONS}", "main", "annotations")


def _paired(file: Path, name: str, old: str, new: str) -> Path | None:
    """The file of this name in the same folder, or in the one whose name has `new` in place of `old`."""
    folders = file.parent, file.parent.with_name(file.parent.name.replace(old, new))
    return next((path for folder in folders if (path := folder / name).is_file()), None)


def _camera_numbers(file: Path, group: str) -> set[str]:
    return {name for name in names_in(file / group) if name.isdecimal() and len(name) < 5}


def _parameters(annotations: Path) -> dict[str, dict[str, Any]]:
    """Lens, pose and colour correction of each camera, by its number without leading zeros."""
    found = {}
    try:
        with open_container(annotations) as file:
            for key in sorted(_camera_numbers(annotations, "Camera_Parameter")):
                camera = member(file, ("Camera_Parameter", key))
                K, D, RT = (_numbers(camera, name, size) for name, size in (("K", 9), ("D", 5), ("RT", 16)))
                entry = {"K": K.reshape(3, 3).tolist(), "dist": to_distortion(key, D)}
                entry |= invert_pose(RT.reshape(4, 4))
                if "Color_Calibration" in camera:  # stored as BGR
                    entry["colour"] = _numbers(camera, "Color_Calibration", 9).reshape(3, 3)[::-1].tolist()
                found[str(int(key))] = entry
    except OSError as error:
        raise ValueError(
            f"expected cameras in {annotations.name}, got: {error.strerror}; copy it again"
        ) from None
    return found


def _numbers(camera: Any, name: str, size: int) -> np.ndarray:
    data = member(camera, (name,))
    if getattr(data, "size", None) != size or data.dtype.kind not in "fiu":
        raise ValueError(
            f"expected {size} numbers of {data.name[:60]}, got others; copy the annotations again"
        )
    return np.asarray(data[()], float).ravel()
