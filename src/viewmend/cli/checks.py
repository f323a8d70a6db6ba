"""Checks of options, and messages, that several commands share."""

import re
from pathlib import Path
from typing import TYPE_CHECKING

from viewmend.cli.console import say

if TYPE_CHECKING:
    from viewmend.data.prepare import PreparedCapture
    from viewmend.models.base import Inpainter


def check_device(name: str) -> None:
    """Raise a ValueError unless this device exists."""
    import torch

    if name != "cpu" and not (name.startswith("cuda") and torch.cuda.is_available()):
        raise ValueError(f"expected an available device, got '{name}'; use --device cpu")


def check_people(performers: Path | None, motions: Path | None) -> None:
    """Raise a ValueError unless both or neither are given, and exist."""
    if (performers is None) != (motions is None):
        raise ValueError("expected both --performers and --motions, got one of them; give both folders")
    for folder in (performers, motions):
        if folder is not None and not folder.exists():
            raise ValueError(f"{folder}: expected characters or motions, found nothing; check --performers, --motions")


def load_named(name: str | None, device: str) -> "Inpainter":
    """Load the method of this name (`make_method`); by default the shipped model, or Telea's fill without one.

    Raises:
        ValueError: there is no such method, it is damaged, or the device does not exist.
    """
    from viewmend.models.registry import default_method, make_method

    check_device(device)
    if name is None and (name := default_method()) == "telea":
        say("this version ships no model: holes are filled with OpenCV's Telea inpainting")
    return make_method(name, device)


def chosen_times(text: str | None, count: int) -> range:
    """The frame indices that `--frames FIRST:END` selects out of `count`; all by default.

    Negative indices count from the end. Says so if there are fewer frames than asked for.

    Raises:
        ValueError: there is no such frame.
    """
    parts = re.fullmatch(r"(-?\d{1,9})?:(-?\d{1,9})?", text or ":")
    first, end = (None if part is None else int(part) for part in parts.groups()) if parts else (0, 0)
    times = range(count)[first:end]
    if not times:
        raise ValueError(f"expected --frames FIRST:END within 0:{count}, got '{text}'; for example 0:{count}")
    if any(abs(index) > count for index in (first, end) if index is not None):
        say(f"--frames {text}: there are {count} frames, so {times[0]}:{times[-1] + 1} is used")
    return times


def log_preparation(capture: "PreparedCapture") -> None:
    """Report what preparation changed in a capture. Issues have already been logged as warnings."""
    for text in capture.changes:
        say(text)
