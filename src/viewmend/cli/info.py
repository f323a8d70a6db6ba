"""`viewmend info`: what a capture or a model is, and whether a calibration is right."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True, kw_only=True)
class Options:
    """Say what a capture or a model is; for a capture, also draw a picture that checks its calibration."""

    target: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="CAPTURE|MODEL")]
    """A capture folder (with cameras.json), or a model: a name or a folder with config.json and model.safetensors."""
    out: Path | None = None
    """Where to write the check picture of a capture (PNG or JPEG)."""
    time: int = 0
    """Index of the frame to look at."""
    json: bool = False
    """Write one JSON object to standard output and nothing else there."""


def run(options: Options) -> int:
    """Run the command; the exit code."""
    raise ValueError(f"expected a capture or a model, got '{options.target}'; this command is not written yet")
