"""What cameras saw of a board: a video or a folder of images each."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from viewmend.capture.calibration.board import Board, Corners
from viewmend.capture.camera_reader import CameraReader
from viewmend.capture.errors import CaptureError
from viewmend.capture.formats.footage import footage_of, listing
from viewmend.capture.plain_format import STREAMS, PlainCalibration, PlainCamera
from viewmend.capture.videos import is_video


def open_footage(folder: Path) -> PlainCalibration:
    """The cameras of a folder of videos, or of folders of images, by name; with K and pose that say nothing yet.

    Raises:
        CaptureError: there are not two or more, or a video cannot be read.
    """
    entries = sorted(entry for entry in folder.iterdir() if entry.name[0] != ".") if folder.is_dir() else []
    videos = {entry.stem: entry.name for entry in entries if entry.is_file() and is_video(entry.name)}
    chosen = videos or {entry.name: entry.name for entry in entries if entry.is_dir() and listing(folder, entry.name)}
    if len(chosen) < 2:
        raise CaptureError(
            f"{folder}: expected two or more videos, or folders of images, got {len(chosen)}; put one for each camera "
            "there, named after it"
        )
    try:
        footage = footage_of(folder, chosen)
    except ValueError as error:
        raise CaptureError(f"{folder}: {error}") from None
    nothing: dict[str, Any] = {"K": np.eye(3), "R": np.eye(3), "t_m": np.zeros(3), "dist": np.zeros(5)}
    nothing |= dict.fromkeys(STREAMS)
    cameras = tuple(PlainCamera(name=name, **(nothing | footage.entries[name])) for name in chosen)
    return PlainCalibration(footage.frames, cameras, None, footage.fps, None, 1.0, folder, folder)


def look_for(
    board: Board,
    footage: PlainCalibration,
    times: Sequence[int],
    track: Callable[[Sequence[PlainCamera]], Iterable[PlainCamera]],
) -> dict[tuple[int, int], Corners]:
    """The board's corners, by camera and time, at these indices of the footage's frames.

    `track` wraps the cameras that are iterated over, as a progress bar.

    Raises:
        CaptureError: an image cannot be read, or has another size than the camera's first.
    """
    import cv2

    seen = {}
    for view, camera in enumerate(track(footage.cameras)):
        reader = CameraReader(footage.folder, camera)
        for time in times:
            frame = footage.frames[time]
            if camera.image and not (footage.folder / camera.file("image", frame)).is_file():
                continue
            grey = cv2.cvtColor(reader.read(frame, time).rgb, cv2.COLOR_RGB2GRAY)
            if (corners := board.find(grey)) is not None:
                seen[view, time] = corners
    return seen
