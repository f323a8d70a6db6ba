"""`viewmend convert`: a capture of any format that is read, as a plain one."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro


@dataclass(frozen=True, kw_only=True)
class Options:
    """Write a capture of any format that is read as a plain one: undistorted images, masks, cameras.json."""

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SRC")]
    """The capture's folder."""
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """Folder for the plain capture; it must not be in use."""
    kind: str | None = None
    """The source's format, as docs/formats.md names it; by default it is recognised."""
    frames: str | None = None
    """Which frames, as FIRST:END by index; either may be left out."""
    scale: float = 1.0
    """Scale of the images' sides, above 0 and at most 1; below 1 depth is left out."""
    cameras: tuple[str, ...] = ()
    """Names of the cameras to keep; by default all."""
    images: Literal["jpeg", "png"] = "png"
    """Image files: exact, or smaller."""


def run(options: Options) -> int:
    """Run the command; the exit code."""
    from viewmend.capture.part import CapturePart
    from viewmend.capture.plain import open_capture
    from viewmend.capture.plain_writer import write_capture
    from viewmend.cli.checks import chosen_times
    from viewmend.cli.console import say, track

    if not 0 < options.scale <= 1:
        raise ValueError(f"expected --scale above 0 and at most 1, got {options.scale}; choose again")
    capture = open_capture(options.source, options.cameras or None, options.kind)
    part = CapturePart(capture, chosen_times(options.frames, len(capture.frame_ids)), options.scale)
    write_capture(part, options.out, images=options.images, progress=lambda times: track(times, options.out.name))
    say(f"{options.out}: {len(part.cameras)} cameras, {len(part.frame_ids)} frames")
    return 0
