"""The files of `viewmend demo`: a film of whole views side by side, and a contact sheet."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from viewmend.atomic_writes import write_atomically
from viewmend.capture.images import write_image
from viewmend.capture.video_writer import write_mp4
from viewmend.cli.console import say
from viewmend.cli.mend_output import SHEET_ROWS, sheet_row, side_by_side
from viewmend.contact_sheet import contact_sheet, picture
from viewmend.evaluation.mending import MendStep

RESULTS = ("demo.mp4", "frames", "contact_sheet.png")
APART = 4
"""Frames of the sheet are at least so many apart."""


def write_demo(out: Path, steps: Sequence[MendStep], fps: float) -> list[Path]:
    """Write demo.mp4 (frames/*.png without PyAV) and contact_sheet.png into `out`; the files written.

    The sheet shows the frames with the most holes, in order of time.
    """
    out.mkdir(parents=True, exist_ok=True)
    panels = [_panel(step) for step in steps]
    files = [_write_video(out / "demo.mp4", panels, fps)]
    rows = [sheet_row(steps[n]) for n in _worth_seeing(steps)]
    write_image(out / "contact_sheet.png", contact_sheet(rows, 260, 340))
    return [*files, out / "contact_sheet.png"]


def _worth_seeing(steps: Sequence[MendStep]) -> list[int]:
    """A few frames with many holes, some frames apart, in order of time."""
    chosen: list[int] = []
    for n in sorted(range(len(steps)), key=lambda n: -int(steps[n].completed.view.holes.sum())):
        if len(chosen) < SHEET_ROWS and all(abs(n - other) >= APART for other in chosen):
            chosen.append(n)
    return sorted(chosen)


def _panel(step: MendStep) -> UInt8[np.ndarray, "height width 3"]:
    assert step.truth is not None, "the studio knows the truth"
    images = {"rendered": step.rendered, "mended": step.mended, "truth": step.truth}
    return side_by_side({name: picture(image) for name, image in images.items()})


def _write_video(file: Path, panels: Sequence[UInt8[np.ndarray, "height width 3"]], fps: float) -> Path:
    try:
        write_atomically(file, lambda beside: write_mp4(beside, panels, fps))
    except ImportError as missing:
        say(f"{missing}; writing pictures instead")
        for n, panel in enumerate(panels):
            write_image(file.parent / "frames" / f"{n:06d}.png", panel)
        return file.parent / "frames"
    return file
