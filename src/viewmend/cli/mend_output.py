"""The files of `viewmend mend`: mended views, holes, and a contact sheet. All of them, or none."""

import shutil
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from viewmend.capture.images import read_rgb, write_image
from viewmend.contact_sheet import Tile, contact_sheet, picture
from viewmend.evaluation.mending import MendStep
from viewmend.geometry.hull import FOREGROUND
from viewmend.output_folder import OutputFolder
from viewmend.views import IncompleteView

SHEET_ROWS = 4
RESULTS = ("mended", "mended.mp4", "holes", "contact_sheet.png")
HOLE_COLOUR = (1.0, 0.0, 1.0)
DIFFERENCE_GAIN = 3.0


class MendOutput:
    """Takes one step after another; a context manager that puts the files into `out` when all went well.

    Until then they lie in a hidden folder of it, which an error removes.
    """

    def __init__(self, out: Path, fps: float):
        self._folder, self._fps = OutputFolder(out), fps
        self._draft = self._folder.draft
        self._count = 0
        self._rows: list[list[Tile]] = []
        self._stride = 1

    def __enter__(self) -> "MendOutput":
        """Begin.

        Raises:
            ValueError: files lie there that no earlier run made, or another run writes there.
            OSError: the folder cannot be made.
        """
        self._folder.__enter__()
        try:
            self._folder.demand_own(*RESULTS)
        except ValueError:
            self._folder.__exit__()
            raise
        return self

    def add(self, step: MendStep) -> None:
        """Write one view and, of a few spread over the run, remember a row of the sheet."""
        number = f"{self._count:06d}.png"
        write_image(self._draft / "mended" / number, picture(step.completed.rgb))
        write_image(self._draft / "holes" / number, picture(step.completed.view.error[None]))
        if self._count % self._stride == 0:
            if len(self._rows) == SHEET_ROWS:
                self._rows, self._stride = self._rows[::2], 2 * self._stride
            if self._count % self._stride == 0:
                self._rows.append(sheet_row(step))
        self._count += 1

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        try:
            if kind is None and self._count:
                write_image(self._draft / "contact_sheet.png", contact_sheet(self._rows, 260, 400))
                if self._count > 1:
                    self._to_video()
                self._folder.publish(*RESULTS)
        finally:
            self._folder.__exit__()

    def _to_video(self) -> None:
        """Replace the mended pictures by a video, where PyAV is installed."""
        from viewmend.capture.video_writer import write_mp4

        files = sorted((self._draft / "mended").glob("*.png"))
        try:
            write_mp4(self._draft / "mended.mp4", (read_rgb(file, str(file)) for file in files), self._fps)
        except ImportError:
            return
        shutil.rmtree(self._draft / "mended")


def sheet_row(step: MendStep) -> list[Tile]:
    """Input cameras, rendered, holes marked, mended, truth and difference; cut to the subject."""
    view, rgb = step.completed.view, step.completed.rgb
    box = _box(view.mask > 0)
    tiles = []
    for name in view.source_views:
        own = step.frame.select([name])
        assert own.mask is not None, "frames without masks are refused"
        tiles.append(Tile(f"input {name}", picture(own.rgb[0])[_box(own.mask[0] > FOREGROUND)]))
    tiles += [
        Tile(f"rendered, frame {view.time}", picture(view.rgb)[box]),
        Tile("holes", picture(holes_marked(view))[box]),
        Tile("mended", picture(rgb)[box]),
    ]
    if step.truth is None:
        return tiles
    difference = (DIFFERENCE_GAIN * (rgb - step.truth).abs()).clamp(0, 1)
    return [
        *tiles,
        Tile("truth", picture(step.truth)[box]),
        Tile(f"difference x{DIFFERENCE_GAIN:.0f}", picture(difference)[box]),
    ]


def holes_marked(view: IncompleteView) -> Float[Tensor, "3 height width"]:
    """F with the pixels of E in magenta."""
    colour = torch.tensor(HOLE_COLOUR, device=view.rgb.device)[:, None, None]
    return torch.lerp(view.rgb, colour.expand_as(view.rgb), view.error)


def _box(mask: Tensor) -> tuple[slice, slice]:
    """Rows and columns of what is not empty, and a margin; all where it is empty."""
    rows, columns = mask.any(1).nonzero()[:, 0], mask.any(0).nonzero()[:, 0]
    if not len(rows):
        return slice(None), slice(None)
    margin = 4 + len(rows) // 20
    top, bottom, left, right = int(rows[0]), int(rows[-1]), int(columns[0]), int(columns[-1])
    return slice(max(0, top - margin), bottom + 1 + margin), slice(max(0, left - margin), right + 1 + margin)
