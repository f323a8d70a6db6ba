"""`viewmend convert`: converts a capture of any supported format."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import tyro


@dataclass(frozen=True, kw_only=True)
class Options:
    """Convert a capture of any supported format to viewmend's own: undistorted images, masks and cameras.json."""

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SRC")]
    """Folder of the capture, or its main file (a .smc file of DNA-Rendering, a RIFTCast meta file)."""
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """Output folder; it must be new or empty."""
    format: str | None = None
    """Format of the capture (docs/formats.md); recognised by default."""
    frames: str | None = None
    """Range of frame indices, FIRST:END; either may be omitted."""
    scale: float = 1.0
    """Scale of image width and height, above 0 and at most 1. Below 1, depth is dropped."""
    cameras: tuple[str, ...] = ()
    """Names of the cameras to keep; by default all."""
    images: Literal["jpeg", "png"] = "png"
    """Image files: lossless PNG, or smaller JPEG."""


def run(options: Options) -> int:
    """Run the command and return the exit code."""
    from viewmend.cli.checks import chosen_times
    from viewmend.cli.console import say, track
    from viewmend.data.capture_folder import open_capture
    from viewmend.data.native_writer import write_capture
    from viewmend.data.source import CaptureSubset

    if not 0 < options.scale <= 1:
        raise ValueError(f"expected --scale above 0 and at most 1, got {options.scale}; choose again")
    capture = open_capture(options.source, options.cameras or None, options.format)
    subset = CaptureSubset(capture, chosen_times(options.frames, len(capture.frame_ids)), options.scale)
    write_capture(
        subset, options.out, images=options.images, progress=partial(track, description=options.out.name)
    )
    say(f"{options.out}: {len(subset.cameras)} cameras, {len(subset.frame_ids)} frames")
    return 0
