"""The files of `viewmend mend`: rendered, completed and true views, and a contact sheet. All of them, or none."""

import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32, UInt8
from torch import Tensor

from viewmend.cli.console import in_db
from viewmend.data.images import MAX_DEPTH_M, read_rgb, read_rgba, write_depth, write_image
from viewmend.data.videos import write_mp4, write_webm
from viewmend.geometry.hull import FOREGROUND
from viewmend.mending import MendStep, MendSummary
from viewmend.models.compositing import cutout
from viewmend.types import CompletedView
from viewmend.utils.contact_sheet import Tile, contact_sheet, picture
from viewmend.utils.output_folder import OutputFolder

SHEET_ROWS = 4
"""The contact sheet has at most this many rows."""
RESULTS = (
    "completed",
    "holes",
    "rendered",
    "true",
    "cutout",
    "depth",
    "completed.mp4",
    "compared.mp4",
    "cutout.webm",
    "contact_sheet.png",
)
"""A run writes these folders and files."""
HOLE_COLOUR = (1.0, 0.0, 1.0)
"""The contact sheet shows holes in this colour, RGB in [0, 1]."""
DIFFERENCE_GAIN = 3.0
"""The contact sheet shows differences multiplied by this factor."""


class MendOutput:
    """Context manager that collects views in a hidden draft folder, and publishes the files if there was no error."""

    def __init__(self, out: Path, fps: float, alpha: bool = False, depth: bool = False):
        self._folder = OutputFolder(out)
        self._fps = fps
        self._alpha = alpha
        self._depth = depth
        self._draft = self._folder.draft
        self._count = 0
        self._rows: list[list[Tile]] = []
        self._stride = 1
        """The contact sheet has a row for each n-th view; n doubles when the sheet is full."""

    def __enter__(self) -> "MendOutput":
        """Lock the folder.

        Raises:
            ValueError: the folder has files of these names that no run wrote, or another run writes there.
            OSError: the folder cannot be created.
        """
        self._folder.__enter__()
        try:
            self._folder.check_own_files(*RESULTS)
        except ValueError:
            self._folder.__exit__()
            raise
        return self

    @property
    def replaces(self) -> bool:
        """Whether the folder has results of an earlier run, which this one will replace."""
        return self._folder.listed

    def add(self, step: MendStep) -> None:
        """Write one view, and keep a few views, spread over the run, as rows of the contact sheet."""
        completed = step.completed
        number = f"{self._count:06d}.png"
        images = {
            "completed": step.completed_rgb,
            "holes": completed.view.error[None],
            "rendered": step.rendered,
        }
        if step.truth is not None:
            images["true"] = step.truth
        for name, image in images.items():
            write_image(self._draft / name / number, picture(image))
        if self._alpha:
            write_image(self._draft / "cutout" / number, cutout(completed))
        if self._depth:
            write_depth(self._draft / "depth" / number, depth_image_m(completed))
        if self._count % self._stride == 0:
            if len(self._rows) == SHEET_ROWS:
                self._rows = self._rows[::2]
                self._stride = 2 * self._stride
            if self._count % self._stride == 0:
                self._rows.append(sheet_row(step))
        self._count += 1

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        try:
            if kind is None and self._count:
                write_image(self._draft / "contact_sheet.png", contact_sheet(self._rows, 260, 400))
                if self._count > 1:
                    self._write_videos()
                self._folder.publish(*RESULTS)
        finally:
            self._folder.__exit__()

    def _write_videos(self) -> None:
        """Encode the images as videos; completed.mp4 replaces its images."""
        write_mp4(self._draft / "completed.mp4", self._read("completed"), self._fps)
        kinds = [name for name in ("rendered", "completed", "true") if (self._draft / name).is_dir()]
        panels = (side_by_side(self._panels(file, kinds)) for file in self._images("rendered"))
        write_mp4(self._draft / "compared.mp4", panels, self._fps)
        if self._alpha:
            cut = (read_rgba(file, str(file)) for file in self._images("cutout"))
            write_webm(self._draft / "cutout.webm", cut, self._fps)
        shutil.rmtree(self._draft / "completed")

    def _panels(self, rendered: Path, kinds: Sequence[str]) -> dict[str, UInt8[np.ndarray, "height width 3"]]:
        """The images of one view by kind; black where the held-out camera is absent and there is no true one."""
        black = np.zeros_like(read_rgb(rendered, str(rendered)))
        files = {kind: self._draft / kind / rendered.name for kind in kinds}
        return {kind: read_rgb(file, str(file)) if file.is_file() else black for kind, file in files.items()}

    def _images(self, name: str) -> list[Path]:
        return sorted((self._draft / name).glob("*.png"))

    def _read(self, name: str) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
        return (read_rgb(file, str(file)) for file in self._images(name))


def depth_image_m(completed: CompletedView) -> Float32[np.ndarray, "height width"]:
    """z-depth of the subject in metres: the refined depth, or the proxy's; 0 without subject, clamped at 65.535."""
    return completed.surface_depth.clamp(max=MAX_DEPTH_M).float().cpu().numpy()


def side_by_side(
    images: dict[str, UInt8[np.ndarray, "height width 3"]],
) -> UInt8[np.ndarray, "_height _width 3"]:
    """Whole views in their own size with their names above."""
    width = max(image.shape[1] for image in images.values())
    return contact_sheet([[Tile(name, image) for name, image in images.items()]], width)


def sheet_row(step: MendStep) -> list[Tile]:
    """Source cameras, rendered, holes, completed, alpha and confidence, true, differences; cropped to the subject."""
    completed = step.completed
    view = step.completed.view
    truth = step.truth
    empty = float(step.background == "white")
    box = _box(view.mask > 0 if truth is None else (view.mask > 0) | (truth != empty).any(0))
    tiles = []
    for name in view.source_views:
        own = step.frame.select([name])
        assert own.mask is not None, "frames without masks are refused"
        tiles.append(Tile(f"input {name}", picture(own.rgb[0])[_box(own.mask[0] > FOREGROUND)]))
    magenta = torch.tensor(HOLE_COLOUR, device=step.rendered.device)[:, None, None]
    holes = torch.where(view.holes, magenta, step.rendered)
    images = {f"rendered, frame {view.time}": step.rendered, "holes": holes, "completed": step.completed_rgb}
    images |= {
        name: image[None] for name, image in completed.images.items() if name in ("alpha", "confidence")
    }
    if truth is not None:
        images["true"] = truth
        for name, rgb in {"rendered": step.rendered, "completed": step.completed_rgb}.items():
            difference = DIFFERENCE_GAIN * (rgb - truth).abs()
            images[f"{name} - true, x{DIFFERENCE_GAIN:.0f}"] = difference.clamp(0, 1)
    return tiles + [Tile(name, picture(image)[box]) for name, image in images.items()]


def _box(mask: Tensor) -> tuple[slice, slice]:
    """Rows and columns of the mask with a margin; everything for an empty mask."""
    rows = mask.any(1).nonzero()[:, 0]
    columns = mask.any(0).nonzero()[:, 0]
    if not len(rows):
        return slice(None), slice(None)
    margin = 4 + len(rows) // 20
    top = int(rows[0])
    bottom = int(rows[-1])
    left = int(columns[0])
    right = int(columns[-1])
    return slice(max(0, top - margin), bottom + 1 + margin), slice(max(0, left - margin), right + 1 + margin)


def as_text(summary: MendSummary) -> list[str]:
    """The scores and times of a run, as lines of text."""
    iou = [value for values in summary.hull_iou.values() for value in values]
    lines = [
        f"{summary.frames} view{'s' if summary.frames != 1 else ''}; holes {100 * (summary.hole_fraction or 0):.2f} % "
        f"of the hull's pixels, {100 * (summary.completed_fraction or 0):.2f} % to be completed; "
        + (f"hull IoU {sum(iou) / len(iou):.3f}, lowest {min(iou):.3f}" if iou else "no subject"),
        "a frame takes " + ", ".join(f"{name} {ms:.1f} ms" for name, ms in summary.stage_ms().items()),
    ]
    if summary.mean("ours", "psnr_whole") is None:
        return lines
    scored = summary.scored_frames
    over = f"; {scored} of {summary.frames} views are scored" if scored < summary.frames else ""
    whole = in_db(summary.mean("ours", "psnr_whole"))
    whole_rendered = in_db(summary.mean("unfilled", "psnr_whole"))
    lines += [
        f"PSNR on {summary.background}, dB; protocol {summary.protocol}{over}",
        f"  whole image           {whole}   rendered {whole_rendered}",
        f"  subject               {in_db(summary.mean('ours', 'psnr_subject'))}",
        f"  coloured pixels       {in_db(summary.mean('ours', 'psnr_valid'))}",
    ]
    for kind, metric in {"holes": "psnr_holes", "holes on the subject": "psnr_holes_fg"}.items():
        ours = summary.mean("ours", metric)
        telea = summary.mean("telea", metric)
        lines.append(f"  {kind:<20}  {in_db(ours)}   Telea {in_db(telea)}")
    lpips = summary.mean("ours", "lpips_alex_whole")
    if lpips is None:
        return lines
    lpips_rendered = summary.mean("unfilled", "lpips_alex_whole")
    lpips_subject = summary.mean("ours", "lpips_alex_subject")
    lines += [
        "LPIPS (AlexNet), lower is better",
        f"  whole image           {lpips:.3f}   rendered {lpips_rendered:.3f}",
    ]
    return lines if lpips_subject is None else [*lines, f"  subject               {lpips_subject:.3f}"]
