"""Clean plates as people have them: an image or a video a camera, or times at which nobody is there."""

from collections.abc import Sequence
from pathlib import Path

from viewmend.capture.errors import CaptureError
from viewmend.capture.formats.footage import paired
from viewmend.capture.images import read_rgb
from viewmend.capture.masks.maker import Rgb
from viewmend.capture.masks.masked import view_rgb
from viewmend.capture.masks.plate import median_plate
from viewmend.capture.plain import PlainCapture
from viewmend.capture.source import CaptureSource
from viewmend.capture.videos import VideoFile, is_video, video_facts

CAMERA = "{camera}"
"""Stands for a camera's name in the path of plates."""
MOST_FRAMES = 25
"""The median is taken of so many frames at most, evenly spread."""


def plates_from_files(capture: PlainCapture, place: str) -> dict[str, Rgb]:
    """The plate of each camera, undistorted: `place` is a path with `{camera}`, or a folder of files named after them.

    Of a video the median is taken.

    Raises:
        CaptureError: a camera has no plate, or one that cannot be read or is not of its images' size.
    """
    plates = {}
    for name, path in zip(capture.cameras.names, _paths(capture.cameras.names, place), strict=True):
        if not path.is_file():
            raise CaptureError(f"{path}: expected the clean plate of camera '{name}', got no file; check --plate")
        where = f"{path}: plate of camera '{name}'"
        plate = read_plate(path, where)
        width, height = capture.cameras.select([name]).max_size_px
        if plate.shape[:2] != (height, width):
            got = f"{plate.shape[1]} x {plate.shape[0]}"
            raise CaptureError(f"{where}: expected {width} x {height} pixels as the images have, got {got}; resize it")
        plates[name] = capture.straightened(name, plate)
    return plates


def read_plate(path: Path, where: str) -> Rgb:
    """The plate that an image is, or the median of a video; `where` begins the messages.

    Raises:
        CaptureError: the file cannot be read.
    """
    return median_plate(_video_frames(path, where)) if is_video(path.name) else read_rgb(path, where)


def plates_from_frames(source: CaptureSource, times: range) -> dict[str, Rgb]:
    """The plate of each camera as the median of its images at some of these times.

    Raises:
        CaptureError: a camera is there at none of them, or the source cannot be read.
    """
    images: dict[str, list[Rgb]] = {name: [] for name in source.cameras.names}
    for time in spread(times):
        frame = source.read(time)
        for view, name in enumerate(frame.cameras.names):
            images[name].append(view_rgb(frame, view))
    absent = [name for name, seen in images.items() if not seen]
    if absent:
        raise CaptureError(f"{source.name}: expected images of camera '{absent[0]}' for its plate, got none there")
    return {name: median_plate(seen) for name, seen in images.items()}


def spread(times: range) -> range:
    """At most `MOST_FRAMES` of these times, evenly spread."""
    return times[:: -(-len(times) // MOST_FRAMES)]


def _paths(names: Sequence[str], place: str) -> list[Path]:
    if CAMERA in place:
        return [Path(place.replace(CAMERA, name)) for name in names]
    folder = Path(place)
    found = {path.stem: path for path in sorted(folder.iterdir()) if path.is_file()} if folder.is_dir() else {}
    chosen = paired(names, found)
    if chosen is None:
        raise CaptureError(
            f"{place}: expected a folder with one image or video named after each camera ({', '.join(names)[:80]}), "
            f"or a path with {CAMERA} in it, got neither; rename the files"
        )
    return [found[stem] for stem in chosen]


def _video_frames(path: Path, where: str) -> list[Rgb]:
    video = VideoFile(path)
    return [video.read(index, where) for index in spread(range(video_facts(path).frames))]
