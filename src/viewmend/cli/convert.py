"""`viewmend convert`: a capture of any format that is read, as a plain one."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro


@dataclass(frozen=True, kw_only=True)
class Options:
    """Write a capture of any format that is read as a plain one: undistorted images, masks, cameras.json.

    Or as a data set of RIFTCast (--to riftcast): JPEG images, masks as run lengths, calibration.json, dataset.json.
    """

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SRC")]
    """The capture's folder, or the file that stands for it (a .smc file of DNA-Rendering, a meta file of RIFTCast)."""
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """Folder for what is written; it must not be in use."""
    to: Literal["plain", "riftcast"] = "plain"
    """What is written."""
    kind: str | None = None
    """The source's format, as docs/formats.md names it; by default it is recognised."""
    frames: str | None = None
    """Which frames, as FIRST:END by index; either may be left out."""
    scale: float = 1.0
    """Scale of the images' sides, above 0 and at most 1; below 1 depth is left out."""
    cameras: tuple[str, ...] = ()
    """Names of the cameras to keep; by default all."""
    images: Literal["jpeg", "png"] = "png"
    """Image files of a plain capture: exact, or smaller."""


def run(options: Options) -> int:
    """Run the command; the exit code."""
    from viewmend.capture.part import CapturePart
    from viewmend.capture.plain import open_capture
    from viewmend.capture.plain_writer import write_capture
    from viewmend.capture.riftcast_writer import write_riftcast
    from viewmend.cli.checks import chosen_times
    from viewmend.cli.console import say, track

    if not 0 < options.scale <= 1:
        raise ValueError(f"expected --scale above 0 and at most 1, got {options.scale}; choose again")
    capture = open_capture(options.source, options.cameras or None, options.kind)
    part = CapturePart(capture, chosen_times(options.frames, len(capture.frame_ids)), options.scale)

    def progress(times: Iterable[int]) -> Iterable[int]:
        return track(times, options.out.name)

    if options.to == "riftcast":
        write_riftcast(part, options.out, progress=progress)
    else:
        write_capture(part, options.out, images=options.images, progress=progress)
    say(f"{options.out}: {len(part.cameras)} cameras, {len(part.frame_ids)} frames")
    return 0
