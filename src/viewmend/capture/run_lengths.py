"""Binary masks as run lengths, as RIFTCast stores them: an int32 of the first pixel, then where each run ends."""

from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from viewmend.capture.containers import read_bytes
from viewmend.capture.errors import CaptureError

RUN_LENGTHS = ".bin"
"""The suffix of such masks."""


def read_runs(path: Path, where: str, size: tuple[int, int]) -> UInt8[np.ndarray, "height width"]:
    """A mask of 0 and 255 of this height and width, which the file does not tell. `where` begins the messages.

    Raises:
        CaptureError: it cannot be read, or its runs do not fill that size.
    """
    height, width = size
    try:
        data = read_bytes(path)
    except OSError as error:
        raise CaptureError(f"{where}: expected a readable file, got: {error.strerror}; check its permissions") from None
    numbers = np.frombuffer(data[: len(data) // 4 * 4], "<i4")
    runs = np.diff(numbers[1:].astype(np.int64), prepend=0)
    if (
        len(data) % 4
        or len(numbers) < 2
        or numbers[0] not in (0, 1)
        or (runs < 0).any()
        or runs.sum() != width * height
    ):
        end = int(numbers[-1]) if len(numbers) else 0
        raise CaptureError(
            f"{where}: expected runs of 0 and 1 that end at {width} x {height} = {width * height} pixels, got "
            f"{len(data)} bytes that end at {end}; write it for the calibration's size"
        )
    values = (np.arange(len(runs)) + numbers[0]) % 2 * 255
    return np.repeat(values.astype(np.uint8), runs).reshape(height, width)


def run_lengths(mask: UInt8[np.ndarray, "height width"], threshold: int = 127) -> bytes:
    """The mask as run lengths; foreground is what lies above the threshold."""
    flat = mask.ravel() > threshold
    ends = np.append(np.flatnonzero(flat[1:] != flat[:-1]) + 1, flat.size)
    return np.concatenate([[int(flat[0])], ends]).astype("<i4").tobytes()
