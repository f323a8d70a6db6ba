"""Image files: colours, masks and depth, read safely from untrusted bytes, and written atomically."""

import functools
import io
import struct
from pathlib import Path

import cv2
import imagesize
import numpy as np
from jaxtyping import Float32, UInt8, UInt16

from viewmend.data.containers import read_bytes
from viewmend.data.errors import CaptureError
from viewmend.data.image_orientation import tiff_orientation
from viewmend.utils.atomic_writes import write_atomically

try:
    import pillow_heif
except ImportError:  # an extra: HEIC images are then refused by name
    pillow_heif = None

DEPTH_UNITS_PER_M = 1000
"""Depth is stored as 16-bit whole millimetres."""
MAX_DEPTH_M = 65.535
"""The largest depth that can be stored, metres."""
MAX_PIXELS = 2**27
"""Images with more pixels by their header are refused before they are decoded."""
PNG_START = b"\x89PNG\r\n\x1a\n"
"""PNG files begin with this signature."""
PNG_COLOUR_TYPE = 25
"""Index of the byte of a PNG file that holds its colour type."""
PNG_CHUNK_OVERHEAD = 12
"""Each chunk of a PNG has this many bytes apart from its data: length, type and checksum."""
PNG_PALETTE = 3
"""The colour type of a PNG whose colours are in a palette."""
PNG_WITHOUT_ALPHA = (b"\0", b"\2")
"""The colour types of a PNG that is grey or RGB, without alpha."""
MAX_LABELS = 32
"""Masks with more values hold opacities, not labels."""
OPAQUE_ALPHA = 128
"""An alpha channel is a mask only if some pixel is below this value of 255."""
FULL_16_BIT = 4096
"""16-bit images whose values stay below this hold 8, 10 or 12 bits; the upper 8 of 16 bits would be black."""
HEIF_BRANDS = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1")
"""HEIC and HEIF files, as phones write them, have one of these at byte 8, after "ftyp"."""
HEIF_REFUSED = (
    "expected an image that OpenCV reads, got HEIC, which needs pillow-heif; install viewmend[heic], or convert "
    "the images to JPEG or PNG"
)
"""Messages about HEIC images say this if the extra is not installed."""
RUN_LENGTH_SUFFIX = ".bin"
"""Suffix of RIFTCast's run-length masks: an int32 for the value of the first pixel, then
the end of each run."""


def read_rgb(path: Path, where: str) -> UInt8[np.ndarray, "height width 3"]:
    """Read an image file as 8-bit RGB, exactly as stored: EXIF rotation is ignored, as calibrations ignore it.

    All readers raise a CaptureError for a file that they cannot use. Its message begins with `where`,
    which names the file, the camera and the frame.
    """
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    bgr = _decode(_read_file(path, where), where, flags)
    if bgr.dtype == np.uint16 and not 0 < bgr.max() < FULL_16_BIT:
        bgr = (bgr >> 8).astype(np.uint8)
    if bgr.dtype != np.uint8:
        got = f"{bgr.dtype} with values up to {bgr.max():g}"
        raise CaptureError(
            f"{where}: expected 8 bit, or 16 bit in full range, got {got}; write it as 8-bit PNG"
        )
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)


def read_rgba(path: Path, where: str) -> UInt8[np.ndarray, "height width 4"]:
    """Read an image file with alpha, of 8 bit or of 16 bit in full range, as stored."""
    bgra = _decode(_read_file(path, where), where, cv2.IMREAD_UNCHANGED)
    channels = 1 if bgra.ndim == 2 else bgra.shape[2]
    if bgra.dtype == np.uint16 and channels == 4 and bgra.max() >= FULL_16_BIT:
        bgra = (bgra >> 8).astype(np.uint8)
    if channels != 4 or bgra.dtype != np.uint8:
        got = f"{channels} channels" + ("" if bgra.dtype == np.uint8 else f" of {bgra.dtype}")
        raise CaptureError(
            f"{where}: expected RGB and alpha, got {got}; export it with alpha, or leave the camera out"
        )
    return cv2.cvtColor(bgra, cv2.COLOR_BGRA2RGBA)


def read_alpha(path: Path, where: str) -> UInt8[np.ndarray, "height width"]:
    """Read the alpha of an image as a mask; CaptureError if it cuts nothing out."""
    alpha = read_rgba(path, where)[..., 3]
    if is_opaque(alpha):
        next_step = "export it with alpha, or leave the camera out"
        raise CaptureError(
            f"{where}: expected alpha that cuts out the subject, got an opaque image; {next_step}"
        )
    return alpha


def is_opaque(alpha: UInt8[np.ndarray, "height width"]) -> bool:
    """Whether an alpha channel cuts nothing out."""
    return int(alpha.min()) >= OPAQUE_ALPHA


def uses_alpha(path: Path) -> bool:
    """Whether this is an image with alpha that cuts something out."""
    try:
        head = read_bytes(path, PNG_COLOUR_TYPE + 1)
        is_jpeg = head.startswith(b"\xff\xd8")
        if is_jpeg or (head.startswith(PNG_START) and head[PNG_COLOUR_TYPE:] in PNG_WITHOUT_ALPHA):
            return False  # these need not be decoded
        read_alpha(path, str(path))
    except (ValueError, OSError):
        return False
    return True


def read_mask(path: Path, where: str) -> UInt8[np.ndarray, "height width"]:
    """Read a mask file: grey or alpha (see `to_mask`), labels of several colours or a palette, or 16 bit.

    Background is index 0 of a coloured palette, black among other colours, and 0 among few values of 16 bit.
    CaptureError if its values have no known meaning, or no colour is black.
    """
    data = _read_file(path, where)
    mask = _decode(data, where, cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
    if mask.dtype == np.uint16:
        mask = _from_16_bit(mask)
    if mask.dtype != np.uint8:
        raise CaptureError(f"{where}: expected an 8-bit mask, got {mask.dtype}; write it as 8-bit PNG")
    if mask.ndim == 3 and (mask.shape[2] == 3 or (mask.shape[2] == 4 and is_opaque(mask[..., 3]))):
        background = _background(mask[..., :3], data, where)
        if background is not None:
            return 255 * (mask[..., :3] != background).any(-1).astype(np.uint8)
    return to_mask(mask)


def _from_16_bit(mask: UInt16[np.ndarray, "height width *channel"]) -> np.ndarray:
    """The mask in 8 bit, if its meaning is clear: 8 bits stored as 16, labels, or the full range."""
    if mask.max() <= 255:
        return mask.astype(np.uint8)
    if mask.ndim == 2 and len(np.unique(mask)) <= MAX_LABELS:
        return 255 * (mask > 0).astype(np.uint8)
    return (mask >> 8).astype(np.uint8) if mask.max() >= FULL_16_BIT else mask


def _background(bgr: UInt8[np.ndarray, "height width 3"], data: bytes, where: str) -> tuple[int, ...] | None:
    """The colour of the background if colours are labels, one of them black; None if they are shades of one."""
    blue, green, red = (bgr[..., channel] for channel in range(3))
    if (blue == green).all() and (green == red).all():
        return None
    if data.startswith(PNG_START) and data[PNG_COLOUR_TYPE] == PNG_PALETTE and b"PLTE" in data:
        palette = data[data.find(b"PLTE") + len(b"PLTE") :]
        return tuple(reversed(palette[:3]))

    # Each colour as one number, with blue in the upper 8 of 24 bits
    colours = np.unique(bgr.astype(np.int32) @ np.array([1 << 16, 1 << 8, 1], np.int32))
    if len(colours) > MAX_LABELS or np.linalg.matrix_rank(colours[:, None] >> [16, 8, 0] & 255) < 2:
        return None
    if colours[0]:
        found = ", ".join(
            f"{colour & 255} {colour >> 8 & 255} {colour >> 16}" for colour in colours[:3].tolist()
        )
        raise CaptureError(
            f"{where}: expected black as a mask's background, got the colours {found}; write 0 and 255"
        )
    return (0, 0, 0)


def to_mask(image: UInt8[np.ndarray, "height width *channel"]) -> UInt8[np.ndarray, "height width"]:
    """Convert an image of 1 to 4 channels to a mask: alpha if it cuts something out, else the largest channel."""
    if image.ndim == 2:
        return image
    channels = cv2.split(image)
    if len(channels) in (2, 4):
        alpha = channels[-1]
        if not is_opaque(alpha):
            return alpha
        channels = channels[:-1]
    return functools.reduce(cv2.max, channels)


def read_run_lengths(path: Path, where: str, size: tuple[int, int]) -> UInt8[np.ndarray, "height width"]:
    """Read a run-length mask of a known size (height, width) as 0 and 255; CaptureError if its runs do not fill it."""
    height, width = size
    data = _read_file(path, where)
    numbers = np.frombuffer(data[: len(data) // 4 * 4], "<i4")
    runs = np.diff(numbers[1:].astype(np.int64), prepend=0)
    malformed = len(data) % 4 or len(numbers) < 2 or numbers[0] not in (0, 1) or (runs < 0).any()
    if malformed or runs.sum() != width * height:
        end = int(numbers[-1]) if len(numbers) else 0
        raise CaptureError(
            f"{where}: expected runs of 0 and 1 that end at {width} x {height} = {width * height} pixels, got "
            f"{len(data)} bytes that end at {end}; write it for the calibration's size"
        )
    values = (np.arange(len(runs)) + numbers[0]) % 2 * 255
    return np.repeat(values.astype(np.uint8), runs).reshape(height, width)


def read_depth(path: Path, where: str) -> Float32[np.ndarray, "height width"]:
    """Read a 16-bit PNG of millimetres as z-depth in metres; 0 means no surface."""
    depth = _decode(_read_file(path, where), where, cv2.IMREAD_UNCHANGED)
    if depth.dtype != np.uint16 or depth.ndim != 2:
        got = f"{depth.dtype} of shape {depth.shape}"
        raise CaptureError(
            f"{where}: expected one channel of 16-bit millimetres, got {got}; write it as 16-bit PNG"
        )
    return depth.astype(np.float32) / DEPTH_UNITS_PER_M


def size_from_header(data: bytes) -> tuple[int, int] | None:
    """Width and height from the header of image data, without decoding; None if they are not found."""
    try:
        width, height = imagesize.get(io.BytesIO(data))
    except Exception:  # imagesize raises almost anything for malformed bytes
        return None
    return (int(width), int(height)) if width > 0 and height > 0 else None


def _read_file(path: Path, where: str) -> bytes:
    try:
        return read_bytes(path)
    except OSError as error:
        raise CaptureError(
            f"{where}: expected a readable file, got: {error.strerror}; check its permissions"
        ) from None


def _decode(data: bytes, where: str, flags: int) -> np.ndarray:
    if is_heif(data) and pillow_heif is None:
        raise CaptureError(f"{where}: {HEIF_REFUSED}")
    size = heif_size_px(data) if is_heif(data) else size_from_header(data)
    if size is not None and size[0] * size[1] > MAX_PIXELS:
        most = f"{MAX_PIXELS / 1e6:.0f} million pixels"
        got = f"{size[0]} x {size[1]}"
        raise CaptureError(f"{where}: expected an image of at most {most}, got {got}; reduce its size")
    image = _decode_heif(data, flags) if is_heif(data) else decode_image(data, flags)
    if image is None:
        got = f"{len(data)} bytes that are not an image or are truncated"
        raise CaptureError(f"{where}: expected an image, got {got}; copy or export the file again")
    return image


def is_heif(data: bytes) -> bool:
    """Whether image data is HEIC or HEIF."""
    return data[4:8] == b"ftyp" and data[8:12] in HEIF_BRANDS


def heif_size_px(data: bytes) -> tuple[int, int] | None:
    """Width and height of a whole HEIF file as it is shown; None if it is damaged, or without pillow-heif."""
    if pillow_heif is None:
        return None
    try:
        return pillow_heif.open_heif(data).size
    except (ValueError, RuntimeError, OSError, EOFError, SyntaxError):  # depending on the damage
        return None


def _decode_heif(data: bytes, flags: int) -> np.ndarray | None:
    """Decode HEIF data as OpenCV would, turned as the file says; None if it is damaged."""
    assert pillow_heif is not None, "the caller checked"
    try:
        image = pillow_heif.open_heif(data).to_pillow()
    except (ValueError, RuntimeError, OSError, EOFError, SyntaxError):
        return None
    if flags == cv2.IMREAD_UNCHANGED and image.mode == "RGBA":
        return cv2.cvtColor(np.asarray(image), cv2.COLOR_RGBA2BGRA)
    return cv2.cvtColor(np.asarray(image.convert("RGB")), cv2.COLOR_RGB2BGR)


def decode_image(data: bytes, flags: int) -> np.ndarray | None:
    """Decode untrusted image data with these OpenCV flags; None if it is not an image, truncated or too large.

    The size in the header and the lengths of PNG chunks are checked before any memory is allocated for them.
    TIFF images, which OpenCV always turns as they say, come as stored.
    """
    width, height = size_from_header(data) or (0, 0)
    if not data or width * height > MAX_PIXELS or not _is_complete(data):
        return None
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:  # the header claims more pixels than OpenCV accepts
        return None
    orientation = tiff_orientation(data)
    return image if orientation is None or image is None else orientation.undo(image)


def _is_complete(data: bytes) -> bool:
    """Whether PNG and JPEG data reach their end marker: decoders fill what is missing with grey.

    No PNG chunk may be longer than the data either, because OpenCV allocates its length first.
    """
    if data.startswith(PNG_START):
        at = len(PNG_START)
        while at + 8 <= len(data):
            length, chunk = struct.unpack_from(">I4s", data, at)
            at += PNG_CHUNK_OVERHEAD + length
            if at > len(data) or chunk == b"IEND":
                return chunk == b"IEND"
        return False
    if data.startswith(b"\xff\xd8"):
        return b"\xff\xd9" in data[len(data) // 2 :]
    return True


def write_image(path: Path | str, image: UInt8[np.ndarray, "height width *channel"]) -> None:
    """Write a grey image, RGB, or RGB with straight alpha; the suffix (.png, .jpg, ...) selects the format.

    Raises:
        ValueError: the suffix is that of no image format, or the image is not 8-bit.
        OSError: the file cannot be written.

    Examples:
        >>> import numpy as np
        >>> from pathlib import Path
        >>> from tempfile import TemporaryDirectory
        >>> from viewmend import write_image
        >>> with TemporaryDirectory() as folder:
        ...     write_image(Path(folder) / "black.png", np.zeros((4, 6, 3), np.uint8))
        ...     (Path(folder) / "black.png").is_file()
        True
    """
    path = Path(path)
    shape = getattr(image, "shape", ())
    is_image = len(shape) == 2 or (len(shape) == 3 and shape[2] in (1, 3, 4))
    if not isinstance(image, np.ndarray) or image.dtype != np.uint8 or not is_image:
        got = f"{type(image).__name__} of {getattr(image, 'dtype', 'no type')} and shape {tuple(shape)}"
        raise ValueError(
            f"expected a numpy array of uint8 and shape (height, width), with 1, 3 or 4 channels last, got {got}; "
            "convert values in [0, 1] with (255 * image).round().astype(np.uint8)"
        )
    # No chroma subsampling (4:4:4), which would blur coloured edges.
    jpeg = (cv2.IMWRITE_JPEG_QUALITY, 95, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, 0x111111)
    options = jpeg if path.suffix.lower() in (".jpg", ".jpeg") else (cv2.IMWRITE_PNG_COMPRESSION, 3)
    swapped = {3: cv2.COLOR_RGB2BGR, 4: cv2.COLOR_RGBA2BGRA}
    code = swapped.get(image.shape[-1]) if image.ndim == 3 else None
    _write(path, image if code is None else cv2.cvtColor(image, code), options)


def write_depth(path: Path, depth_m: Float32[np.ndarray, "height width"]) -> None:
    """Write z-depth in metres as a 16-bit PNG of millimetres, rounded; CaptureError beyond 0 to 65.535 m."""
    if not ((depth_m >= 0) & (depth_m <= MAX_DEPTH_M)).all():
        got = f"{np.nanmin(depth_m)} to {np.nanmax(depth_m)} m"
        raise CaptureError(
            f"{path}: expected depths of 0 to {MAX_DEPTH_M} m, got {got}; check the scene's units"
        )
    _write(path, np.rint(depth_m * DEPTH_UNITS_PER_M).astype(np.uint16), ())


def check_image_name(path: Path) -> None:
    """ValueError unless the suffix of a file to write is that of an image format."""
    if not path.suffix or not cv2.haveImageWriter(path.suffix):
        raise ValueError(f"expected the file name of an image, got {path}; use the suffix .png or .jpg")


def _write(path: Path, image: np.ndarray, options: tuple[int, ...]) -> None:
    check_image_name(path)
    done, data = cv2.imencode(path.suffix, image, options)
    if not done:
        got = f"{image.shape} {image.dtype}"
        raise ValueError(f"{path}: expected an image that the format can store, got {got}; use .png")
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, lambda temporary: temporary.write_bytes(data.tobytes()))
