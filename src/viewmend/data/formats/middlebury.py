"""Middlebury's multi-view data sets (`*_par.txt`).

Each image is a camera of a single frame, unless poses and names show that a fixed rig was recorded
at several times.
"""

from pathlib import Path
from typing import Any

import numpy as np

from viewmend.data.formats.files import (
    decode_text,
    files_like,
    first_of,
    image_size_px,
    names_from_paths,
    warn_of_unused_images,
)
from viewmend.data.formats.moments import PosedImage, fixed_cameras, with_masks
from viewmend.utils.untrusted_input import bounded_bytes

MAX_BYTES = 2**22
"""The largest data set has 363 cameras in 130 kB."""
NUMBERS = 21


def find(folder: Path) -> Path | None:
    """The file of parameters."""
    return first_of(files_like(folder, "*_par.txt"))


def content(folder: Path, file: Path) -> dict[str, Any]:
    """All images, in the folder or in `images`."""
    text = decode_text(bounded_bytes(file, MAX_BYTES), file.name)
    lines = [line.split() for line in text.splitlines() if line.strip()]
    wrong = [words for words in lines[1:] if len(words) != 1 + NUMBERS]
    if not lines or wrong or lines[0] != [str(len(lines) - 1)]:
        got = (
            f"{len(wrong[0]) - 1} after {wrong[0][0][:40]!r}" if wrong else f"{max(0, len(lines) - 1)} lines"
        )
        expected = f"a count, then that many lines of a name and {NUMBERS} numbers"
        raise ValueError(f"expected {expected}, got {got}; copy it again")
    posed = [_posed(folder, words[0], [float(word) for word in words[1:]]) for words in lines[1:]]
    posed = with_masks(folder, posed)
    warn_of_unused_images(folder, [image.path for image in posed])
    rig = fixed_cameras(posed)
    if rig is not None:
        cameras, frames = rig
        return {"frames": list(frames), "cameras": cameras}
    entries = []
    for image, name in zip(posed, names_from_paths([words[0] for words in lines[1:]]), strict=True):
        pose = {"R": image.R.tolist(), "t": (-image.R @ image.center).tolist()}
        entries.append({"name": name, **image.lens, **pose, "image": image.path, "mask": image.mask})
    return {"frames": ["0"], "cameras": entries}


def _posed(folder: Path, name: str, numbers: list[float]) -> PosedImage:
    """An image with its lens and pose, from the numbers of its line: K, R and t."""
    place = "" if (folder / name).is_file() else "images/"
    width, height = image_size_px(folder, place + name)
    K, R = np.array(numbers[:18]).reshape(2, 3, 3)
    t = np.array(numbers[18:])
    lens = {"width": width, "height": height, "K": K.tolist()}
    return PosedImage(place + name, None, lens, R, -np.linalg.solve(R, t))
