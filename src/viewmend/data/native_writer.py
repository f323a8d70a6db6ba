"""Writing any source of frames as a capture folder in our own format."""

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
    unmasked: Callable[[int], MultiViewFrame | None] | None = None,
) -> tuple[int, ...]:
    """Write all frames of a source to the folder `out`: images, masks and depth if present, and `cameras.json`.

    With PNG, reading the folder returns the same frames bit for bit (depth to half a
    millimetre). JPEG (quality 95, no chroma subsampling) is smaller; masks and depth are
    always PNG. The folder is complete or absent, see `atomic_folder`. Returns the indices
    of frames with masks but without a subject.

    Args:
        source: a capture, a studio, or any other `CaptureSource`.
        out: a new or empty folder.
        images: the format of the camera images.
        progress: wraps the frame indices while they are iterated over, as a progress bar does.
        unmasked: returns, for the index of a frame, the cameras that were left out of it because
            they have no mask; their images are written, too.

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
        return writer.write(times if progress is None else progress(times), unmasked)


@contextmanager
def atomic_folder(out: Path | str) -> Iterator[Path]:
    """Yield the path of a temporary folder, to be created and filled, which becomes `out` at the end.

    So `out` is complete or absent. CaptureError if it exists and is not an empty folder.
    """
    out = Path(out)
    if out.exists() and not (out.is_dir() and not any(out.iterdir())):
        raise CaptureError(
            f"{out}: expected a new or empty folder, got one in use; remove it or choose another"
        )
    out.parent.mkdir(parents=True, exist_ok=True)
    unfinished = out.parent / f".{out.name}.unfinished-{os.getpid()}"
    remove_unfinished(out)
    try:
        with name_path_in_errors(out):
            yield unfinished
        if out.exists():
            out.rmdir()
        unfinished.rename(out)
    finally:
        with defer_signals():
            shutil.rmtree(unfinished, ignore_errors=True)


def remove_unfinished(out: Path) -> None:
    """Remove temporary folders of `out` that killed processes have left."""
    for left in out.parent.glob(f".{escape(out.name)}.unfinished-*"):
        if not is_running(left.name.rpartition("-")[2]):
            shutil.rmtree(left, ignore_errors=True)


class _Writer:
    """Writes the files of one capture into a new folder."""

    def __init__(self, source: CaptureSource, folder: Path, suffix: str):
        self.source = source
        self.folder = folder
        self.suffix = suffix
        self.kinds: set[FileKind] = {"image"}
        self.masked: set[str] = set()
        names = source.cameras.names
        self.folder_names = {name: _folder_name(name, index) for index, name in enumerate(names)}
        if len({name.lower() for name in self.folder_names.values()}) < len(names):
            self.folder_names = {name: _folder_name("", index) for index, name in enumerate(names)}
        unsafe = [frame for frame in source.frame_ids if not stays_inside(frame)]
        if unsafe:
            expected = "frame ids that can be file names"
            raise CaptureError(f"{source.name}: expected {expected}, got {unsafe}; rename the frames")
        folder.mkdir()

    def write(
        self, times: Iterable[int], unmasked: Callable[[int], MultiViewFrame | None] | None = None
    ) -> tuple[int, ...]:
        """Write these frames; arguments and return value are those of `write_capture`."""
        empty = []
        with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
            for frame in prefetch(self.source, times):
                self._write_frame(frame, pool)
                left_out = None if unmasked is None else unmasked(frame.time)
                if left_out is not None:
                    self._write_frame(left_out, pool)
                if frame.mask is not None and not frame.has_subject:
                    empty.append(frame.time)
        write_calibration(self.folder, self._calibration())
        return tuple(empty)

    def _write_frame(self, frame: MultiViewFrame, pool: ThreadPoolExecutor) -> None:
        """Write the images of all cameras of a frame, in parallel."""
        written = pool.map(lambda view: self._write_view(frame, view), range(len(frame.cameras)))
        list(written)  # waits, and raises their errors

    def _write_view(self, frame: MultiViewFrame, view: int) -> None:
        name = frame.cameras.names[view]
        frame_id = self.source.frame_ids[frame.time]
        width, height = (int(n) for n in frame.cameras.size_px[view])

        def file(kind: FileKind) -> Path:
            self.kinds.add(kind)
            return self.folder / self._path(name, kind).replace("{frame}", frame_id)

        write_image(
            file("image"), frame.rgb[view, :, :height, :width].permute(1, 2, 0).contiguous().cpu().numpy()
        )
        if frame.mask is not None:
            self.masked.add(name)
            write_image(file("mask"), frame.mask[view, :height, :width].contiguous().cpu().numpy())
        if frame.depth is not None:
            write_depth(file("depth"), frame.depth[view, :height, :width].float().contiguous().cpu().numpy())

    def _path(self, camera: str, kind: FileKind) -> str:
        return f"{kind}/{self.folder_names[camera]}/{{frame}}{self.suffix if kind == 'image' else '.png'}"

    def _calibration(self) -> NativeCalibration:
        source = self.source
        bounds = self.source.bounds
        cameras = self.source.cameras.to("cpu")
        K = cameras.K.double().numpy()
        pose = cameras.camera_from_world.double().numpy()
        entries = []
        for view, (name, (width, height)) in enumerate(
            zip(cameras.names, cameras.size_px.tolist(), strict=True)
        ):
            kinds = self.kinds if name in self.masked else self.kinds - {"mask"}
            files: Any = {kind: self._path(name, kind) if kind in kinds else None for kind in FILE_KINDS}
            R, t_m = exact_pose(pose[view, :3, :3], pose[view, :3, 3])
            entries.append(NativeCamera(name, width, height, K[view], R, t_m, np.zeros(5), **files))
        return NativeCalibration(
            frames=tuple(source.frame_ids),
            cameras=tuple(entries),
            up=None if source.up is None else source.up.double().cpu().numpy(),
            fps=source.fps,
            bounds_m=None
            if bounds is None
            else torch.stack([bounds.low, bounds.high]).double().cpu().numpy(),
            metres_per_unit=1.0,
            file=self.folder / CALIBRATION,
            folder=self.folder,
            origin_m=origin_of(source),
        )


def _folder_name(camera: str, index: int) -> str:
    """The camera's name if it is a valid folder name on every system, else one with its number."""
    valid = re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]*[A-Za-z0-9_-]|[A-Za-z0-9]", camera)
    return camera if valid else f"camera{index:02d}"
