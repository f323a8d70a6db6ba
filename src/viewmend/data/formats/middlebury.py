"""Middlebury's multi-view data sets (`*_par.txt`). Each image is a camera of a single frame."""

from pathlib import Path
from typing import Any

from viewmend.data.formats.files import (
    decode_text,
    files_like,
    find_mask,
    first_of,
    image_size_px,
    names_from_paths,
    warn_of_unused_images,
)
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
    entries = []
    for words, name in zip(lines[1:], names_from_paths([words[0] for words in lines[1:]]), strict=True):
        numbers = [float(word) for word in words[1:]]
        rows = [numbers[start : start + 3] for start in range(0, NUMBERS, 3)]
        place = "" if (folder / words[0]).is_file() else "images/"
        width, height = image_size_px(folder, place + words[0])
        entry = {"name": name, "width": width, "height": height, "K": rows[:3], "R": rows[3:6], "t": rows[6]}
        entries.append(entry | {"image": place + words[0], "mask": find_mask(folder, words[0])})
    warn_of_unused_images(folder, [entry["image"] for entry in entries])
    return {"frames": ["0"], "cameras": entries}
