"""Writing any source of frames as a plain capture folder."""

import os
import re
import shutil
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from glob import escape
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from viewmend.atomic_writes import is_running, naming, undisturbed
from viewmend.capture.errors import CaptureError
from viewmend.capture.images import write_depth, write_image
from viewmend.capture.plain_format import (
    CALIBRATION,
    PlainCalibration,
    PlainCamera,
    Stream,
    stays_inside,
    write_calibration,
)
from viewmend.capture.prefetch import prefetch
from viewmend.capture.source import CaptureSource
from viewmend.capture.video_writer import VideoWriter
from viewmend.views import MultiViewFrame


def write_capture(
    source: CaptureSource,
    out: Path,
    *,
    images: Literal["jpeg", "png"] = "jpeg",
    video: bool = False,
    progress: Callable[[Iterable[int]], Iterable[int]] | None = None,
) -> None:
    """Write all frames of `source` to the folder `out`: images, masks and depths as far as it has them, `cameras.json`.

    With PNG, reading the folder gives the same frames bit for bit (depth to half a millimetre). JPEG (quality 95, no
    chroma subsampling) and `video` (one nearly lossless H.264 file per camera, needs the extra `viewmend[video]`) are
    smaller; masks and depths are PNG always. Everything is written to a temporary folder beside `out`, which takes its
    place at the end: `out` is complete or absent. `progress` wraps the times that are iterated over, as a progress bar.

    Raises:
        CaptureError: `out` exists and is not an empty folder, `source` cannot be read, or `video` is wanted of a source
            with gaps.
        ImportError: `video` without PyAV.
    """
    with whole_folder(out) as unfinished:
        writer = _Writer(source, unfinished, ".jpg" if images == "jpeg" else ".png", video)
        writer.write(range(len(source.frame_ids)) if progress is None else progress(range(len(source.frame_ids))))


@contextmanager
def whole_folder(out: Path | str) -> Iterator[Path]:
    """A folder beside `out`, to be made and filled, which takes its place at the end: `out` is complete or absent.

    Raises:
        CaptureError: `out` exists and is not an empty folder.
    """
    out = Path(out)
    if out.exists() and not (out.is_dir() and not any(out.iterdir())):
        raise CaptureError(
            f"{out}: expected no such folder, or an empty one, got one in use; remove it or choose another"
        )
    out.parent.mkdir(parents=True, exist_ok=True)
    unfinished = out.parent / f".{out.name}.unfinished-{os.getpid()}"
    remove_unfinished(out)
    try:
        with naming(out):
            yield unfinished
        if out.exists():
            out.rmdir()
        unfinished.rename(out)
    finally:
        with undisturbed():
            shutil.rmtree(unfinished, ignore_errors=True)


def remove_unfinished(out: Path) -> None:
    """Remove what killed runs have left of this folder beside it."""
    for left in out.parent.glob(f".{escape(out.name)}.unfinished-*"):
        if not is_running(left.name.rpartition("-")[2]):
            shutil.rmtree(left, ignore_errors=True)


class _Writer:
    """Writes the files of one capture into a new folder."""

    def __init__(self, source: CaptureSource, folder: Path, suffix: str, video: bool):
        self.source = source
        self.folder = folder
        self.suffix = suffix
        self.streams: set[Stream] = {"image"}
        names = source.cameras.names
        self.folder_names = {name: _file_name(name, f"camera{index:02d}") for index, name in enumerate(names)}
        if len({name.lower() for name in self.folder_names.values()}) < len(names):
            self.folder_names = {name: f"camera{index:02d}" for index, name in enumerate(names)}
        unsafe = [frame for frame in source.frame_ids if not stays_inside(frame)]
        if unsafe:
            raise CaptureError(f"{source.name}: expected frame ids fit for file names, got {unsafe}; rename the frames")
        folder.mkdir()
        self.videos: dict[str, VideoWriter] = {}
        if video:
            self.videos = {
                name: VideoWriter(folder / self._path(name, "video"), source.fps or 25.0, True) for name in names
            }

    def write(self, times: Iterable[int]) -> None:
        try:
            with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
                for frame in prefetch(self.source, times):
                    self._check_gaps(frame)
                    list(pool.map(lambda view, frame=frame: self._write_view(frame, view), range(len(frame.cameras))))
        finally:
            for writer in self.videos.values():
                writer.close()
        write_calibration(self.folder, self._calibration())

    def _check_gaps(self, frame: MultiViewFrame) -> None:
        absent = [name for name in self.videos if name not in frame.cameras.names]
        if absent:
            raise CaptureError(
                f"{self.source.name}: frame '{self.source.frame_ids[frame.time]}': expected every camera, since "
                f"a video cannot have gaps, got none of {absent}; write images instead"
            )

    def _write_view(self, frame: MultiViewFrame, view: int) -> None:
        name, frame_id = frame.cameras.names[view], self.source.frame_ids[frame.time]
        width, height = (int(n) for n in frame.cameras.size_px[view])

        def file(stream: Stream) -> Path:
            self.streams.add(stream)
            return self.folder / self._path(name, stream).replace("{frame}", frame_id)

        rgb = frame.rgb[view, :, :height, :width].permute(1, 2, 0).contiguous().cpu().numpy()
        if self.videos:
            self.videos[name].add(rgb)
        else:
            write_image(file("image"), rgb)
        if frame.mask is not None:
            write_image(file("mask"), frame.mask[view, :height, :width].contiguous().cpu().numpy())
        if frame.depth is not None:
            write_depth(file("depth"), frame.depth[view, :height, :width].float().contiguous().cpu().numpy())

    def _path(self, camera: str, stream: str) -> str:
        if stream == "video":
            return f"video/{self.folder_names[camera]}.mp4"
        return f"{stream}/{self.folder_names[camera]}/{{frame}}{self.suffix if stream == 'image' else '.png'}"

    def _calibration(self) -> PlainCalibration:
        source, cameras = self.source, self.source.cameras.to("cpu")
        bounds, poses = source.bounds, cameras.camera_from_world.double().numpy()
        streams = {"video" if self.videos else "image", *(self.streams - {"image"})}

        def path(name: str, stream: Stream) -> str | None:
            return self._path(name, stream) if stream in streams else None

        return PlainCalibration(
            frames=tuple(source.frame_ids),
            cameras=tuple(
                PlainCamera(
                    name=name,
                    width=int(cameras.size_px[view, 0]),
                    height=int(cameras.size_px[view, 1]),
                    K=cameras.K[view].double().numpy(),
                    R=poses[view, :3, :3],
                    t_m=poses[view, :3, 3],
                    dist=np.zeros(5),
                    image=path(name, "image"),
                    video=path(name, "video"),
                    mask=path(name, "mask"),
                    depth=path(name, "depth"),
                )
                for view, name in enumerate(cameras.names)
            ),
            up=None if source.up is None else source.up.double().cpu().numpy(),
            fps=source.fps,
            bounds_m=None if bounds is None else torch.stack([bounds.low, bounds.high]).double().cpu().numpy(),
            metres_per_unit=1.0,
            file=self.folder / CALIBRATION,
            folder=self.folder,
        )


def _file_name(name: str, otherwise: str) -> str:
    """A camera's name where it is fit for a folder's on every system."""
    return name if re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]*[A-Za-z0-9_-]|[A-Za-z0-9]", name) else otherwise
