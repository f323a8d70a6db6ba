"""DNA-Rendering's pairs of HDF5 files: `0012_11.smc` with images, `0012_11_annots.smc` with cameras and masks."""

import os
from pathlib import Path
from typing import Any

import numpy as np

from viewmend.capture.containers import member, names_in, opened
from viewmend.capture.formats.files import five_coefficients, image_size_px, inverted

SUFFIX, ANNOTATIONS = ".smc", "_annots.smc"
GROUPS = ("Camera_5mp", "Camera_12mp")
"""The two models of cameras, which share one numbering."""
FPS = 15.0


def find(path: Path) -> Path | None:
    """The file with images that this path is, or the first in the folder or in one within it that is named `*main*`."""
    if path.suffix == SUFFIX and path.is_file():
        stem = path.name.removesuffix(ANNOTATIONS)
        return path if stem == path.name else _main_of(path, stem)
    return next(iter(_mains(path)), None)


def root(path: Path, file: Path) -> Path:
    """The folder that holds both files of a pair."""
    pair = [file.absolute().parent, (_annotations_of(file) or file).absolute().parent]
    return Path(os.path.commonpath(pair))


def content(path: Path, file: Path) -> dict[str, Any]:
    """What a `cameras.json` of the sequence would hold, of those cameras that have images and parameters.

    Raises:
        ValueError: the folder has several sequences, the annotations are absent, or a file holds something else.
    """
    mains = [file] if path.is_file() else _mains(path)
    if len(mains) > 1:
        raise ValueError(
            f"expected one sequence, got {len(mains)} in {path}; open one of the files, {mains[0].name} say"
        )
    annotations = _annotations_of(file)
    if annotations is None:
        raise ValueError(f"expected {file.stem}{ANNOTATIONS} beside it or in the folder of annotations; copy it, too")
    folder = root(path, file)
    main, masks = (os.path.relpath(one.absolute(), folder) for one in (file, annotations))
    parameters = _parameters(annotations)
    masked = names_of(annotations, "Mask")
    entries, frames = [], set()
    for group in GROUPS:
        for camera in sorted(names_of(file, group) & parameters.keys(), key=int):
            own = {frame for frame in names_in(file / group / camera / "color") if frame.isdecimal()}
            if not own:
                continue
            frames |= own
            entry: dict[str, Any] = {"name": f"{int(camera):02d}", "image": f"{main}/{group}/{camera}/color/{{frame}}"}
            first = entry["image"].replace("{frame}", min(own, key=int))
            entry["width"], entry["height"] = image_size_px(folder, first)
            if camera in masked:
                entry["mask"] = f"{masks}/Mask/{camera}/mask/{{frame}}"
            entries.append(entry | parameters[camera])
    return {"fps": FPS, "frames": sorted(frames, key=int), "cameras": entries}


def _mains(folder: Path) -> list[Path]:
    """Files with images in the folder, else in those within it that are named so."""
    places = [[folder], sorted(place for place in folder.glob("*main*") if place.is_dir())]
    for place in places:
        found = sorted(file for one in place for file in one.glob(f"*{SUFFIX}") if not file.name.endswith(ANNOTATIONS))
        if found:
            return found
    return []


def _main_of(annotations: Path, stem: str) -> Path | None:
    places = annotations.parent, annotations.parent.with_name(annotations.parent.name.replace("annotations", "main"))
    return next((file for place in places if (file := place / f"{stem}{SUFFIX}").is_file()), None)


def _annotations_of(main: Path) -> Path | None:
    parent = main.absolute().parent
    places = parent, parent.with_name(parent.name.replace("main", "annotations"))
    return next((file for place in places if (file := place / f"{main.stem}{ANNOTATIONS}").is_file()), None)


def names_of(file: Path, group: str) -> set[str]:
    """Numbers of the cameras that a group has members of, none where there is no such group."""
    return {name for name in names_in(file / group) if name.isdecimal() and len(name) < 5}


def _parameters(annotations: Path) -> dict[str, dict[str, Any]]:
    """The keys of a `cameras.json` that say a camera's lens, pose and colours, by its number without zeros."""
    found = {}
    try:
        with opened(annotations) as file:
            for key in sorted(names_of(annotations, "Camera_Parameter")):
                camera = member(file, ("Camera_Parameter", key))
                K, D, RT = (_numbers(camera, name, size) for name, size in (("K", 9), ("D", 5), ("RT", 16)))
                told = {"K": K.reshape(3, 3).tolist(), "dist": five_coefficients(key, D)}
                told |= inverted(RT.reshape(4, 4))
                if "Color_Calibration" in camera:
                    told["colour"] = _numbers(camera, "Color_Calibration", 9).reshape(3, 3)[::-1].tolist()  # BGR
                found[str(int(key))] = told
    except OSError as error:
        raise ValueError(f"expected cameras in {annotations.name}, got: {error.strerror}; copy it again") from None
    return found


def _numbers(camera: Any, name: str, size: int) -> np.ndarray:
    data = member(camera, (name,))
    if getattr(data, "size", None) != size or data.dtype.kind not in "fiu":
        raise ValueError(f"expected {size} numbers of {data.name[:60]}, got others; copy the annotations again")
    return np.asarray(data[()], float).ravel()
