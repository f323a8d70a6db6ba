"""Image files: colours, masks and depths, decoded from bytes and encoded to them."""

import functools
import io
import struct
from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt8

from viewmend.atomic_writes import write_atomically
from viewmend.capture.containers import read_bytes
from viewmend.capture.errors import CaptureError

DEPTH_UNITS_PER_M = 1000
"""Depth is stored in whole millimetres, 16 bit."""
MAX_DEPTH_M = 65.535
MAX_PIXELS = 2**27
"""The most pixels of one image; its head is asked, before anything is decoded."""
PNG, PART = b"\x89PNG\r\n\x1a\n", 12
"""How a PNG begins, and the bytes that each of its parts has beside its own: length, kind, check."""
FULL_16_BIT = 4096
"""16-bit images whose values stay below this hold 8, 10 or 12 bits, and would be read as black."""


def read_rgb(path: Path, where: str) -> UInt8[np.ndarray, "height width 3"]:
    """An image file as RGB, 8 bit, exactly as its pixels are stored (no turning by EXIF: calibrations know none).

    `where` begins the messages: file, camera, frame.

    Raises:
        CaptureError: the file cannot be read or decoded.
    """
    import cv2

    bgr = _decode(path, where, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION)
    if bgr.dtype == np.uint16 and not 0 < bgr.max() < FULL_16_BIT:
        bgr = (bgr >> 8).astype(np.uint8)
    if bgr.dtype != np.uint8:
        got = f"{bgr.dtype} with values up to {bgr.max():g}"
        raise CaptureError(f"{where}: expected 8 bit, or 16 bit that are used, got {got}; write it as 8-bit PNG")
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)


def exif_turn(path: Path) -> str | None:
    """How the file's EXIF says that its image should be turned, in words; None where it should not, or is no image."""
    import cv2

    small, data = cv2.IMREAD_REDUCED_COLOR_4, np.frombuffer(read_bytes(path), np.uint8)
    stored, turned = cv2.imdecode(data, small | cv2.IMREAD_IGNORE_ORIENTATION), cv2.imdecode(data, small)
    if stored is None or turned is None or (stored.shape == turned.shape and (stored == turned).all()):
        return None
    if stored.shape != turned.shape or not any(
        (stored[::y, ::x] == turned).all() for y, x in ((-1, -1), (1, -1), (-1, 1))
    ):
        return "turned by 90 degrees"
    return "turned by 180 degrees" if (stored[::-1, ::-1] == turned).all() else "mirrored"


def read_rgba(path: Path, where: str) -> UInt8[np.ndarray, "height width 4"]:
    """An 8-bit image file with alpha, as its pixels are stored.

    Raises:
        CaptureError: the file cannot be read or decoded, or has other channels.
    """
    import cv2

    bgra = _decode(path, where, cv2.IMREAD_UNCHANGED)
    if bgra.dtype != np.uint8 or bgra.ndim != 3 or bgra.shape[2] != 4:
        raise CaptureError(f"{where}: expected RGB and alpha of 8 bit, got {bgra.dtype} of shape {bgra.shape}")
    return cv2.cvtColor(bgra, cv2.COLOR_BGRA2RGBA)


def read_mask(path: Path, where: str) -> UInt8[np.ndarray, "height width"]:
    """An 8-bit mask file of any number of channels: alpha where it is used, else the largest colour.

    Raises:
        CaptureError: the file cannot be read or decoded, or is not 8 bit.
    """
    import cv2

    mask = _decode(path, where, cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
    if mask.dtype != np.uint8:
        raise CaptureError(f"{where}: expected a mask of 8 bit, got {mask.dtype}; write it as 8-bit PNG")
    return as_mask(mask)


def as_mask(image: UInt8[np.ndarray, "height width *channel"]) -> UInt8[np.ndarray, "height width"]:
    """The mask that an image of 1, 3 or 4 channels means."""
    import cv2

    if image.ndim == 2:
        return image
    channels = cv2.split(image)
    if len(channels) in (2, 4):
        alpha = channels[-1]
        if (alpha != 255).any():
            return alpha
        channels = channels[:-1]
    return functools.reduce(cv2.max, channels)  # pyright: ignore[reportArgumentType]


def read_depth(path: Path, where: str) -> Float32[np.ndarray, "height width"]:
    """A 16-bit PNG of millimetres as metres; 0 stays 0, no surface.

    Raises:
        CaptureError: the file cannot be read or decoded, or is not one channel of 16 bit.
    """
    import cv2

    depth = _decode(path, where, cv2.IMREAD_UNCHANGED)
    if depth.dtype != np.uint16 or depth.ndim != 2:
        got = f"{depth.dtype} of shape {depth.shape}"
        raise CaptureError(f"{where}: expected one channel of 16 bit, millimetres, got {got}; write it as 16-bit PNG")
    return depth.astype(np.float32) / DEPTH_UNITS_PER_M


def told_size(data: bytes) -> tuple[int, int] | None:
    """Width and height as the head of image data tells them, without decoding; None where it tells none."""
    import imagesize

    try:
        width, height = imagesize.get(io.BytesIO(data))
    except Exception:  # of foreign bytes it raises almost anything
        return None
    return (int(width), int(height)) if width > 0 and height > 0 else None


def _decode(path: Path, where: str, flags: int) -> np.ndarray:
    try:
        data = read_bytes(path)
    except OSError as error:
        raise CaptureError(f"{where}: expected a readable file, got: {error.strerror}; check its permissions") from None
    if (told := told_size(data)) is not None and told[0] * told[1] > MAX_PIXELS:
        raise CaptureError(
            f"{where}: expected an image of at most {MAX_PIXELS / 1e6:.0f} million pixels, got {told[0]} x {told[1]}; "
            "make it smaller"
        )
    if (image := decoded(data, flags)) is None:
        got = f"{len(data)} bytes that are none, or cut short"
        raise CaptureError(f"{where}: expected an image, got {got}; copy or export the file again")
    return image


def decoded(data: bytes, flags: int, most_pixels: int = MAX_PIXELS) -> np.ndarray | None:
    """Image data of others as OpenCV decodes them with these flags; None for what is none, cut short or too large.

    Its head and, of a PNG, the lengths of its parts are looked at before anything is made for them.
    """
    import cv2

    told = told_size(data) or (0, 0)
    if not data or told[0] * told[1] > most_pixels or not _is_complete(data):
        return None
    try:
        return cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:  # it claims more pixels than OpenCV takes
        return None


def _is_complete(data: bytes) -> bool:
    """Whether PNG and JPEG data have their end: some decoders fill up what is missing with grey.

    Nor may a part of a PNG be longer than the data: OpenCV makes room for it first.
    """
    if data.startswith(PNG):
        at = len(PNG)
        while at + 8 <= len(data):
            length, kind = struct.unpack_from(">I4s", data, at)
            at += PART + length
            if at > len(data) or kind == b"IEND":
                return kind == b"IEND"
        return False
    if data.startswith(b"\xff\xd8"):
        return b"\xff\xd9" in data[len(data) // 2 :]
    return True


def write_image(
    path: Path,
    image: UInt8[np.ndarray, "height width"] | UInt8[np.ndarray, "height width channel"],
    jpeg_quality: int = 95,
) -> None:
    """Write a grey image, RGB, or RGB and straight alpha; the suffix (.png, .jpg, ...) says how.

    Raises:
        ValueError: the suffix names no image format.
        OSError: the file cannot be written.
    """
    import cv2

    # 4:4:4: coloured edges of cloth are what an inpainter is judged by.
    jpeg = (cv2.IMWRITE_JPEG_QUALITY, jpeg_quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, 0x111111)
    options = jpeg if path.suffix.lower() in (".jpg", ".jpeg") else (cv2.IMWRITE_PNG_COMPRESSION, 3)
    swapped = {3: cv2.COLOR_RGB2BGR, 4: cv2.COLOR_RGBA2BGRA}
    _encode(path, cv2.cvtColor(image, swapped[image.shape[2]]) if image.ndim == 3 else image, options)


def write_depth(path: Path, depth_m: Float32[np.ndarray, "height width"]) -> None:
    """Write z-depth in metres as a 16-bit PNG of millimetres, rounded.

    Raises:
        CaptureError: a depth is negative, not a number, or beyond 65.535 m.
    """
    if not ((depth_m >= 0) & (depth_m <= MAX_DEPTH_M)).all():
        got = f"{np.nanmin(depth_m)} to {np.nanmax(depth_m)} m"
        raise CaptureError(f"{path}: expected depths of 0 to {MAX_DEPTH_M} m, got {got}; check the scene's units")
    _encode(path, np.rint(depth_m * DEPTH_UNITS_PER_M).astype(np.uint16), ())


def _encode(path: Path, image: np.ndarray, options: tuple[int, ...]) -> None:
    import cv2

    if not path.suffix or not cv2.haveImageWriter(path.suffix):
        raise ValueError(f"expected a picture's file name, .png or .jpg, got {path}; give it such a suffix")
    done, data = cv2.imencode(path.suffix, image, options)
    if not done:
        raise ValueError(
            f"{path}: expected an image that the format can hold, got {image.shape} {image.dtype}; use .png"
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, lambda beside: beside.write_bytes(data.tobytes()))
