"""Masks by a matting network of the user's: an ONNX file, run by onnxruntime."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32

from viewmend.preprocess.masks.maker import Mask, Rgb, demand_size

PLATE_INPUTS = ("bgr", "background")
"""Names by which a network asks for the clean plate; "bgr" is BackgroundMattingV2's."""
ALPHA_OUTPUTS = ("pha", "alpha", "matte", "output", "mask")
"""Names by which the matte is found; else it is the first output with one channel."""
MODNET_PX = 512
"""Images are resized to this shorter side, pixels, for networks of any input size."""
MODNET_STEP = 32
"""Both sides are then a multiple of this many pixels."""


class NetworkMasks:
    """Makes masks by a network of one image, or of an image and its clean plate.

    Images are given as (1, 3, height, width) in float32, in the size that the file fixes.
    Where it fixes none, two inputs (BackgroundMattingV2) come at full size, one (MODNet)
    reduced. Two are in [0, 1], one is in [-1, 1]. ValueError if the file is no such
    network, or needs a plate and there is none.
    """

    def __init__(self, file: Path, plate: Rgb | None = None):
        self._session = _session(file)
        inputs = self._session.get_inputs()
        self._plate_name = next((i.name for i in inputs if i.name.lower() in PLATE_INPUTS), None)
        images = [i for i in inputs if i.name != self._plate_name]
        if len(images) != 1 or any(len(i.shape) != 4 or i.shape[1] not in (3, None) for i in inputs):
            shapes = ", ".join(f"{i.name} {i.shape}" for i in inputs)[:200]
            expected = "a network of an image (1, 3, height, width), and a plate named 'bgr' or none"
            raise ValueError(f"{file}: expected {expected}, got {shapes}; export it so")
        if self._plate_name is not None and plate is None:
            raise ValueError(f"{file}: expected clean plates for this network, got none; give --plate")
        self._file = file
        self._image = images[0]
        self._plate = plate

    def mask(self, rgb: Rgb) -> Mask:
        """Foreground of an image, 0 to 255; ValueError for another size than the plate's, or without a matte."""
        height, width = rgb.shape[:2]
        size = self._size(width, height)
        given = {self._image.name: _tensor(rgb, size, self._plate_name is None)}
        if self._plate_name is not None and self._plate is not None:
            demand_size(rgb, self._plate, "the plate")
            given[self._plate_name] = _tensor(self._plate, size, False)
        alpha = self._matte(given)
        return np.asarray(cv2.resize(alpha, (width, height)) * 255).round().clip(0, 255).astype(np.uint8)

    def _size(self, width: int, height: int) -> tuple[int, int]:
        fixed = self._image.shape[2:]
        if all(isinstance(side, int) for side in fixed):
            return fixed[1], fixed[0]
        if self._plate_name is not None:
            return width, height
        scale = min(1.0, MODNET_PX / min(width, height))
        wide, high = (
            max(MODNET_STEP, round(side * scale / MODNET_STEP) * MODNET_STEP) for side in (width, height)
        )
        return wide, high

    def _matte(
        self, given: dict[str, Float32[np.ndarray, "1 3 height width"]]
    ) -> Float32[np.ndarray, "height width"]:
        names = [output.name for output in self._session.get_outputs()]
        try:
            found = dict(zip(names, self._session.run(None, given), strict=True))
        except Exception as error:  # onnxruntime's own classes, one a cause
            raise ValueError(
                f"{self._file}: expected a network that takes images, got: {str(error)[:200]}"
            ) from None
        order = sorted(
            names, key=lambda n: ALPHA_OUTPUTS.index(n.lower()) if n.lower() in ALPHA_OUTPUTS else 9
        )
        for name in order:
            value = np.asarray(found[name])
            if value.ndim == 4 and value.shape[:2] == (1, 1) and np.isfinite(value).all():
                return value[0, 0].astype(np.float32)
        raise ValueError(
            f"{self._file}: expected an output (1, 1, height, width), the matte, got none; export it so"
        )


def _session(file: Path):
    import onnxruntime

    if not file.is_file():
        raise ValueError(f"{file}: expected a network as an ONNX file, got no file; check --network")
    try:
        return onnxruntime.InferenceSession(str(file), providers=onnxruntime.get_available_providers())
    except Exception as error:  # onnxruntime's own classes, one a cause
        got = str(error)[:200]
        raise ValueError(f"{file}: expected a network as an ONNX file, got: {got}; export it again") from None


def _tensor(rgb: Rgb, size: tuple[int, int], signed: bool) -> Float32[np.ndarray, "1 3 rows columns"]:
    smaller = size[0] * size[1] < rgb.shape[0] * rgb.shape[1]
    image = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR)
    values = np.asarray(image, np.float32) / 255
    return np.ascontiguousarray((2 * values - 1 if signed else values).transpose(2, 0, 1)[None])
