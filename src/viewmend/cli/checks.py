"""What several commands make of their options before they begin."""

import re
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from viewmend.inpainting.protocol import ViewInpainter


def check_device(name: str) -> None:
    """ValueError if this device is not there."""
    import torch

    if name != "cpu" and not (name.startswith("cuda") and torch.cuda.is_available()):
        raise ValueError(f"expected a device that is there, got '{name}'; use --device cpu")


def check_people(performers: Path | None, motions: Path | None) -> None:
    """ValueError unless both are there, or neither is given."""
    if (performers is None) != (motions is None):
        raise ValueError("expected --performers and --motions together, got one of them; give both folders")
    for folder in (performers, motions):
        if folder is not None and not folder.exists():
            raise ValueError(f"{folder}: expected people or motions, found nothing; check --performers and --motions")


def load_named(name: str | None, device: str) -> "ViewInpainter":
    """The method of this name (`methods.make_method`); without a name the model that is shipped, else Telea.

    Raises:
        ValueError: there is none, it is damaged, or the device is not there.
    """
    from viewmend.cli.console import say
    from viewmend.methods import default_method, make_method

    check_device(device)
    if name is None and (name := default_method()) == "telea":
        say("no model is shipped with this version: the holes are filled by OpenCV's Telea")
    return make_method(name, device)


def chosen_times(text: str | None, count: int) -> range:
    """The frames that `--frames FIRST:END` chooses of so many, all by default; ValueError for none."""
    parts = re.fullmatch(r"(\d{0,9}):(\d{0,9})", text or ":")
    times = range(count)[int(parts[1] or 0) : int(parts[2] or count)] if parts else range(0)
    if not times:
        raise ValueError(f"expected --frames as FIRST:END within 0:{count}, got '{text}'; choose again")
    return times
