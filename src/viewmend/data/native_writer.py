"""Writing any source of frames as a capture folder in our own format."""

import logging
import os
import re
import shutil
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from glob import escape
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from viewmend.data.capture_folder import origin_of
from viewmend.data.errors import CaptureError
from viewmend.data.images import write_depth, write_image
from viewmend.data.native_format import (
    CALIBRATION,
    FILE_KINDS,
    FileKind,
    NativeCalibration,
    NativeCamera,
    exact_pose,
    stays_inside,
    write_calibration,
)
from viewmend.data.source import CaptureSource, prefetch
from viewmend.types import MultiViewFrame
from viewmend.utils.atomic_writes import defer_signals, is_running, name_path_in_errors


def write_capture(
    source: CaptureSource,
    out: Path,
    *,
    images: Literal["jpeg", "png"] = "jpeg",
    progress: Callable[[Iterable[int]], Iterable[int]] | None = None,
    read_unmasked: Callable[[int], MultiViewFrame | None] | None = None,
) -> tuple[int, ...]:
    """Write all frames of a source to the folder `out`: images, masks and depth if present, and `cameras.json`.

    With PNG, reading the folder returns the same frames bit for bit (depth to half a
    millimetre). JPEG (quality 95, no chroma subsampling) is smaller; masks and depth are
    always PNG. The folder is complete or absent, see `atomic_folder`. Cameras that are absent
    from all frames are left out, with a warning. Returns the indices of frames with masks but
    without a subject.

    Args:
        source: a capture, a studio, or any other `CaptureSource`.
        out: a new or empty folder.
        images: the format of the camera images.
        progress: wraps the frame indices while they are iterated over, as a progress bar does.
        read_unmasked: called with the index of each frame after it was read. Returns the images of
            cameras that the frame lacks because they have no mask; these are written, too.

    Raises:
        CaptureError: `out` exists and is not empty, or the source cannot be read.

    Examples:
        >>> from pathlib import Path
        >>> from tempfile import TemporaryDirectory
        >>> from viewmend import Studio, StudioConfig, open_capture, write_capture
        >>> with TemporaryDirectory() as folder:
        ...     write_capture(Studio(StudioConfig(cameras=4, frames=1, size_px=64)), Path(folder) / "take")
        ...     open_capture(Path(folder) / "take").cameras.names
        ()
        ('cam00', 'cam01', 'cam02', 'cam03')
    """
    with atomic_folder(out) as unfinished:
        writer = _Writer(source, unfinished, ".jpg" if images == "jpeg" else ".png")
        times = range(len(source.frame_ids))
        return writer.write(times if progress is None else progress(times), read_unmasked)


@contextmanager
def atomic_folder(out: Path | str) -> Iterator[Path]:
    """Yield the path of a temporary folder. The caller creates and fills it; on exit it becomes `out`.

    So `out` is complete, or absent or empty. An existing folder is filled, not replaced, because it may be a
    link, a mount point or the working folder. CaptureError if it exists and is not an empty folder.
    """
    out = Path(out)
    check_new_folder(out)
    is_filled = out.is_dir()
    out.parent.mkdir(parents=True, exist_ok=True)
    unfinished = (out if is_filled else out.parent) / f".{out.absolute().name}.unfinished-{os.getpid()}"
    try:
        with name_path_in_errors(out):
            yield unfinished
        if is_filled:
            with defer_signals():
                for entry in sorted(unfinished.iterdir(), key=lambda entry: entry.name == CALIBRATION):
                    entry.rename(out / entry.name)  # the calibration last: without it, this is no capture
        else:
            unfinished.rename(out)
    finally:
        with defer_signals():
            shutil.rmtree(unfinished, ignore_errors=True)


def check_new_folder(out: Path) -> None:
    """CaptureError unless `out` is absent or an empty folder; leftovers of killed processes are removed."""
    remove_unfinished(out)
    is_empty_folder = out.is_dir() and not any(out.iterdir())
    if os.path.lexists(out) and not is_empty_folder:
        raise CaptureError(
            f"{out}: expected a new or empty folder, got one in use; remove it or choose another"
        )


def remove_unfinished(out: Path) -> None:
    """Remove temporary folders of `out` that processes left behind when they were killed.

    Such a process may have had the id of this one, as in containers.
    """
    pattern = f".{escape(out.absolute().name)}.unfinished-*"
    for folder in (*out.parent.glob(pattern), *out.glob(pattern)):
        _, _, process_id = folder.name.rpartition("-")
        if process_id == str(os.getpid()) or not is_running(process_id):
            shutil.rmtree(folder, ignore_errors=True)


class _Writer:
    """Writes the files of one capture into a new folder."""

    def __init__(self, source: CaptureSource, folder: Path, suffix: str):
        self.source = source
        self.folder = folder
        self.suffix = suffix
        self.kinds: set[FileKind] = {"image"}
        """Kinds of files that were written."""
        self.written: set[str] = set()
        """Names of cameras with an image in any frame."""
        self.masked: set[str] = set()
        """Names of cameras with a mask in any frame."""
        names = source.cameras.names
        self.folder_names = {name: _folder_name(name, index) for index, name in enumerate(names)}
        # Names that differ in case only are one folder on some systems, so all folders get numbers instead
        if len({name.lower() for name in self.folder_names.values()}) < len(names):
            self.folder_names = {name: _numbered_folder(index) for index, name in enumerate(names)}
        unsafe = [frame for frame in source.frame_ids if not stays_inside(frame)]
        if unsafe:
            expected = "frame ids that can be file names"
            raise CaptureError(f"{source.name}: expected {expected}, got {unsafe}; rename the frames")
        folder.mkdir()

    def write(
        self, times: Iterable[int], read_unmasked: Callable[[int], MultiViewFrame | None] | None = None
    ) -> tuple[int, ...]:
        """Write these frames; arguments and return value are those of `write_capture`."""
        empty = []
        with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
            for frame in prefetch(self.source, times):
                self._write_frame(frame, pool)
                unmasked = None if read_unmasked is None else read_unmasked(frame.time)
                if unmasked is not None:
                    self._write_frame(unmasked, pool)
                if frame.mask is not None and not frame.has_subject:
                    empty.append(frame.time)
        absent = [name for name in self.source.cameras.names if name not in self.written]
        if absent:
            logging.getLogger("viewmend").warning(
                f"{self.source.name}: cameras without an image in these frames are left out: {', '.join(absent)}"
            )
        write_calibration(self.folder, self._calibration())
        return tuple(empty)

    def _write_frame(self, frame: MultiViewFrame, pool: ThreadPoolExecutor) -> None:
        """Write the images of all cameras of a frame, in parallel."""
        written = pool.map(lambda view: self._write_view(frame, view), range(len(frame.cameras)))
        list(written)  # waits for the threads, and raises their errors

    def _write_view(self, frame: MultiViewFrame, view: int) -> None:
        name = frame.cameras.names[view]
        frame_id = self.source.frame_ids[frame.time]
        width, height = (int(n) for n in frame.cameras.size_px[view])

        def file(kind: FileKind) -> Path:
            self.kinds.add(kind)
            return self.folder / self._pattern(name, kind).replace("{frame}", frame_id)

        self.written.add(name)
        write_image(
            file("image"), frame.rgb[view, :, :height, :width].permute(1, 2, 0).contiguous().cpu().numpy()
        )
        if frame.mask is not None:
            self.masked.add(name)
            write_image(file("mask"), frame.mask[view, :height, :width].contiguous().cpu().numpy())
        if frame.depth is not None:
            write_depth(file("depth"), frame.depth[view, :height, :width].float().contiguous().cpu().numpy())

    def _pattern(self, camera: str, kind: FileKind) -> str:
        """Path of a camera's files of this kind, with {frame} for the frame id."""
        suffix = self.suffix if kind == "image" else ".png"
        return f"{kind}/{self.folder_names[camera]}/" + "{frame}" + suffix

    def _calibration(self) -> NativeCalibration:
        source = self.source
        bounds = None
        if source.bounds is not None:
            bounds = torch.stack([source.bounds.low, source.bounds.high]).double().cpu().numpy()
        cameras = source.cameras.to("cpu")
        K = cameras.K.double().numpy()
        pose = cameras.camera_from_world.double().numpy()
        entries = []
        for view, (name, (width, height)) in enumerate(
            zip(cameras.names, cameras.size_px.tolist(), strict=True)
        ):
            if name not in self.written:  # a camera without files in all frames is no valid entry
                continue
            kinds = self.kinds if name in self.masked else self.kinds - {"mask"}
            files: Any = {kind: self._pattern(name, kind) if kind in kinds else None for kind in FILE_KINDS}
            R, t_m = exact_pose(pose[view, :3, :3], pose[view, :3, 3])
            entries.append(NativeCamera(name, width, height, K[view], R, t_m, np.zeros(5), **files))
        return NativeCalibration(
            frames=tuple(source.frame_ids),
            cameras=tuple(entries),
            up=None if source.up is None else source.up.double().cpu().numpy(),
            fps=source.fps,
            bounds_m=bounds,
            metres_per_unit=1.0,
            file=self.folder / CALIBRATION,
            folder=self.folder,
            origin_m=origin_of(source),
        )


def _folder_name(camera: str, index: int) -> str:
    """The camera's name if it is a valid folder name on every system, else one with its number."""
    valid = re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]*[A-Za-z0-9_-]|[A-Za-z0-9]", camera)
    return camera if valid else _numbered_folder(index)


def _numbered_folder(index: int) -> str:
    return f"camera{index:02d}"
