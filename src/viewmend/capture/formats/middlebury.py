"""Middlebury's multi-view sets (`*_par.txt`): each image is a camera of one time."""

from pathlib import Path
from typing import Any

from viewmend.capture.formats.files import camera_names, image_size_px, mask_beside
from viewmend.foreign_input import bounded_bytes

MOST_BYTES = 2**22
"""The largest of these files that is read; the largest of the sets has 363 cameras in 130 kB."""
NUMBERS = 21


def find(folder: Path) -> Path | None:
    """The file by which the folder is recognised."""
    return next(iter(sorted(folder.glob("*_par.txt"))), None)


def content(folder: Path, file: Path) -> dict[str, Any]:
    """What a `cameras.json` of these images would hold; they lie in the folder or in `images`.

    Raises:
        ValueError: a line has other numbers, or an image is absent.
    """
    lines = [line.split() for line in bounded_bytes(file, MOST_BYTES).decode().splitlines() if line.strip()]
    wrong = [words for words in lines[1:] if len(words) != 1 + NUMBERS]
    if not lines or wrong or lines[0] != [str(len(lines) - 1)]:
        got = f"{len(wrong[0]) - 1} after {wrong[0][0][:40]!r}" if wrong else f"{max(0, len(lines) - 1)} lines"
        raise ValueError(
            f"expected a count, then so many lines of a name and {NUMBERS} numbers, got {got}; copy it again"
        )
    entries = []
    for words, name in zip(lines[1:], camera_names([words[0] for words in lines[1:]]), strict=True):
        numbers = [float(word) for word in words[1:]]
        rows = [numbers[start : start + 3] for start in range(0, NUMBERS, 3)]
        place = "" if "\0" not in words[0] and (folder / words[0]).is_file() else "images/"
        width, height = image_size_px(folder, place + words[0])
        entry = {"name": name, "width": width, "height": height, "K": rows[:3], "R": rows[3:6], "t": rows[6]}
        entries.append(entry | {"image": place + words[0], "mask": mask_beside(folder, words[0])})
    return {"frames": ["0"], "cameras": entries}
