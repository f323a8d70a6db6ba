"""What a capture in which nobody leaves teaches about its background."""

from collections.abc import Callable, Iterable

import numpy as np

from viewmend.capture.errors import CaptureError
from viewmend.capture.masks.learned import LearnedPlate, full_plate, learned_plates
from viewmend.capture.masks.maker import Rgb
from viewmend.capture.masks.masked import view_rgb
from viewmend.capture.masks.plates import spread
from viewmend.capture.plain import PlainCapture
from viewmend.geometry.cameras import Cameras, concatenate_cameras

LEARNED_PX = 640
"""Images are learned from at this longer side at most."""
LEAST_TIMES = 8
"""From fewer times no background can be told from a subject that stays."""


def plates_of_capture(
    capture: PlainCapture,
    times: range,
    of_camera: Callable[[str], PlainCapture],
    progress: Callable[[Iterable[int]], Iterable[int]] = iter,
) -> dict[str, LearnedPlate]:
    """The plate of each camera, learned from some of these times at which all cameras are there.

    `of_camera` opens the capture with one camera alone: at full size its images are read by themselves.

    Raises:
        CaptureError: there are too few such times, or the capture cannot be read.
    """
    whole = [time for time in times if bool(capture.present[:, time].all())]
    if len(whole) < LEAST_TIMES:
        raise CaptureError(
            f"{capture.folder}: expected {LEAST_TIMES} times or more with all cameras there, got {len(whole)}; "
            "give clean plates (--method plate), or another --method"
        )
    chosen = [whole[index] for index in spread(range(len(whole)))]
    names, small = capture.cameras.names, _small_cameras(capture.cameras)
    images: dict[str, list[Rgb]] = {name: [] for name in names}
    for time in progress(chosen):
        frame = capture.read(time)
        for view, name in enumerate(names):
            images[name].append(_reduced(view_rgb(frame, view), small.select([name]).max_size_px))
    learned = learned_plates(images, small, capture.bounds)
    plates = {}
    for name in names:
        alone = of_camera(name)
        plates[name] = full_plate(learned[name], [view_rgb(alone.read(time), 0) for time in chosen])
    return plates


def _small_cameras(cameras: Cameras) -> Cameras:
    parts = []
    for view, size in enumerate(cameras.size_px.tolist()):
        scale = min(1.0, LEARNED_PX / max(size))
        width, height = (max(1, round(side * scale)) for side in size)
        parts.append(cameras[view].resized(width, height))
    return concatenate_cameras(parts)


def _reduced(rgb: Rgb, size: tuple[int, int]) -> Rgb:
    import cv2

    return np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), np.uint8)
