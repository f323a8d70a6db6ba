"""Masks by a clean plate: an image of the same camera without the subject."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32

from viewmend.data.capture_folder import CaptureFolder
from viewmend.data.errors import CaptureError
from viewmend.data.formats.files import match_names
from viewmend.data.images import read_rgb
from viewmend.data.source import CaptureSource
from viewmend.data.videos import VideoFile, is_video, video_properties
from viewmend.preprocess.masks.maker import Colours, Mask, Rgb, Values, demand_size, soft_mask
from viewmend.preprocess.masks.masked import view_rgb

SURE = 28.0
"""Pixels that differ from the plate by this distance in CIELAB (L from 0 to 255) are foreground."""
POSSIBLE = 14.0
"""Pixels that differ from the plate by this distance are foreground where they are connected to sure ones."""
DEEPEST_SHADOW = 0.6
"""How much of the plate's brightness the deepest shadow leaves."""
SHADOW_COST = 0.1
"""How much of a shadow's darkening counts as difference."""
MOST_GAIN = 1.6
"""A camera whose exposure wandered by more than this factor is not brought back to its plate."""
CAMERA = "{camera}"
"""Stands for a camera's name in the path of plates."""
MOST_FRAMES = 25
"""Maximum number of frames for the median, evenly spread."""


class PlateMasks:
    """Makes masks of what differs from the plate, shadows apart; the same for the same image, at any time.

    Exposure that wandered since the plate is brought back first. A shadow is the plate times one
    number a pixel.
    """

    def __init__(self, plate: Rgb):
        self._plate = _smooth(plate)
        self._lab = _lab(self._plate)
        self._square = np.maximum(_dot(self._plate, self._plate), 1e-4)

    def mask(self, rgb: Rgb) -> Mask:
        """Foreground of an image, 0 to 255; ValueError if it is not of the plate's size."""
        demand_size(rgb, self._plate, "the plate")
        image = _smooth(rgb)
        image = np.minimum(image * exposure_gain(image, self._plate), 1)
        lit = (_dot(image, self._plate) / self._square).clip(DEEPEST_SHADOW, 1).astype(np.float32)
        shaded = _lab(self._plate * lit[..., None])
        lab = _lab(image)
        as_shadow = _length(lab - shaded) + SHADOW_COST * (self._lab[..., 0] - shaded[..., 0])
        return soft_mask(np.minimum(as_shadow, _length(lab - self._lab)), SURE, POSSIBLE)


def median_plate(images: Iterable[Rgb]) -> Rgb:
    """The median of one or more images: the plate, where less than half of them show the subject."""
    stack = list(images)
    if not stack:
        raise ValueError("expected at least one image to make a plate of, got none; choose other frames")
    return np.median(np.stack(stack), axis=0).astype(np.uint8)


def exposure_gain(image: Colours, plate: Colours) -> Float32[np.ndarray, "3"]:
    """Factors of an image's channels that make it as bright as its plate: medians, since most of it is background."""
    image = image[::4, ::4]
    plate = plate[::4, ::4]
    usable = ((image > 0.05) & (image < 0.95) & (plate > 0.05) & (plate < 0.95)).all(-1)
    if usable.mean() < 0.05:
        return np.ones(3, np.float32)
    gain = np.median(plate[usable] / image[usable], axis=0).astype(np.float32)
    return gain if gain.min() > 1 / MOST_GAIN and gain.max() < MOST_GAIN else np.ones(3, np.float32)


def _dot(one: Colours, other: Colours) -> Values:
    """Products of each pixel's channels, added up: several times as fast as `sum` along so short an axis."""
    return np.einsum("hwc,hwc->hw", one, other)


def _length(difference: Colours) -> Values:
    return np.sqrt(_dot(difference, difference))


def _smooth(rgb: Rgb) -> Colours:
    """Convert to floats in [0, 1], without the noise of single pixels."""
    return np.asarray(cv2.GaussianBlur(rgb, (0, 0), 1.0), np.float32) / 255


def _lab(rgb: Colours) -> Colours:
    """CIELAB with L from 0 to 255, like OpenCV's of 8 bits."""
    return np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2LAB), np.float32) * np.array([2.55, 1, 1], np.float32)


def plates_from_files(capture: CaptureFolder, place: str) -> dict[str, Rgb]:
    """The plate of each camera, undistorted: `place` is a path with `{camera}`, or a folder of files named after them.

    Of a video the median is taken. CaptureError if a camera has no plate that can be read and is of
    its images' size.
    """
    plates = {}
    for name, path in zip(capture.cameras.names, _paths(capture.cameras.names, place), strict=True):
        if not path.is_file():
            raise CaptureError(
                f"{path}: expected the clean plate of camera '{name}', got no file; check --plate"
            )
        where = f"{path}: plate of camera '{name}'"
        plate = read_plate(path, where)
        width, height = capture.cameras.select([name]).max_size_px
        if plate.shape[:2] != (height, width):
            got = f"{plate.shape[1]} x {plate.shape[0]}"
            raise CaptureError(
                f"{where}: expected {width} x {height} pixels as the images have, got {got}; resize it"
            )
        plates[name] = capture.undistort(name, plate)
    return plates


def read_plate(path: Path, where: str) -> Rgb:
    """The plate that an image is, or the median of a video; CaptureError, which `where` begins, for other files."""
    if not is_video(path.name):
        return read_rgb(path, where)
    video = VideoFile(path)
    images = (video.read(index, where) for index in spread(range(video_properties(path).frames)))
    return median_plate(image for image in images if image is not None)


def plates_from_frames(source: CaptureSource, times: range) -> dict[str, Rgb]:
    """The plate of each camera, as the median of its images at some of these times; CaptureError if it has none."""
    images: dict[str, list[Rgb]] = {name: [] for name in source.cameras.names}
    for time in spread(times):
        frame = source.read(time)
        for view, name in enumerate(frame.cameras.names):
            images[name].append(view_rgb(frame, view))
    absent = [name for name, seen in images.items() if not seen]
    if absent:
        raise CaptureError(
            f"{source.name}: expected images of camera '{absent[0]}' for its plate, got none there"
        )
    return {name: median_plate(seen) for name, seen in images.items()}


def spread(times: range) -> range:
    """Select at most `MOST_FRAMES` of these times, evenly spread."""
    return times[:: -(-len(times) // MOST_FRAMES)]


def _paths(names: Sequence[str], place: str) -> list[Path]:
    if CAMERA in place:
        return [Path(place.replace(CAMERA, name)) for name in names]
    folder = Path(place)
    found = (
        {path.stem: path for path in sorted(folder.iterdir()) if path.is_file()} if folder.is_dir() else {}
    )
    chosen = match_names(names, found)
    if chosen is None:
        raise CaptureError(
            f"{place}: expected a folder with one image or video named after each camera ({', '.join(names)[:80]}), "
            f"or a path with {CAMERA} in it, got neither; rename the files"
        )
    return [found[stem] for stem in chosen]
