"""The mask maker of a live camera."""

import numpy as np

from viewmend.capture.errors import CaptureError
from viewmend.capture.live_rig.rig_file import LiveCamera
from viewmend.capture.masks.maker import Mask, MaskMaker, Rgb
from viewmend.capture.masks.model import ModelMasks
from viewmend.capture.masks.plate import PlateMasks
from viewmend.capture.masks.plates import read_plate


class ReducedMasks:
    """Makes masks of smaller pictures, and enlarges them."""

    def __init__(self, maker: MaskMaker, size_px: tuple[int, int]) -> None:
        self._maker = maker
        self._size_px = size_px

    def mask(self, rgb: Rgb) -> Mask:
        """Foreground of the next image, of its size.

        Raises:
            ValueError: the image is not of the size that the maker was made for.
        """
        import cv2

        small = self._maker.mask(reduced(rgb, self._size_px))
        return np.asarray(cv2.resize(small, rgb.shape[1::-1], interpolation=cv2.INTER_LINEAR), np.uint8)


def reduced(rgb: Rgb, size_px: tuple[int, int]) -> Rgb:
    """An image of this width and height; itself where it has them."""
    import cv2

    if rgb.shape[1::-1] == size_px:
        return rgb
    return np.asarray(cv2.resize(rgb, size_px, interpolation=cv2.INTER_AREA), np.uint8)


def mask_maker(camera: LiveCamera) -> MaskMaker:
    """What makes the masks of this camera's pictures, as its rig says.

    Raises:
        CaptureError: its clean plate is missing, unreadable or of another size.
    """
    size_px = camera.calibration.width, camera.calibration.height
    small_px = max(1, round(size_px[0] * camera.mask.scale)), max(1, round(size_px[1] * camera.mask.scale))
    maker = _maker(camera, small_px)
    return maker if small_px == size_px else ReducedMasks(maker, small_px)


def _maker(camera: LiveCamera, size_px: tuple[int, int]) -> MaskMaker:
    method = camera.mask.method
    if method != "plate":
        return ModelMasks(method, camera.mask.learning)  # pyright: ignore[reportArgumentType]
    where = f"{camera.plate}: the clean plate of camera '{camera.name}'"
    plate = read_plate(camera.plate, where)
    if plate.shape[1::-1] != camera.taken_px:
        expected, got = ("{} x {}".format(*size) for size in (camera.taken_px, plate.shape[1::-1]))
        raise CaptureError(f"{where}: expected {expected} pixels as the calibration says, got {got}; take it again")
    return PlateMasks(reduced(plate, size_px))
