"""How image files ask viewers to turn their image: by EXIF, by TIFF's own tag, or by properties of AVIF."""

import struct
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from viewmend.data.containers import read_bytes

EXIF_ORIENTATIONS = (
    (False, False, True),
    (False, True, True),
    (False, True, False),
    (True, False, False),
    (True, False, True),
    (True, True, True),
    (True, True, False),
)
"""The fields of `Orientation` for the values 2 to 8 of EXIF's orientation tag; 1 is upright."""
TIFF_ORDERS = {b"II*\0": "<", b"MM\0*": ">"}
"""The byte order of a TIFF file, as `struct` names it, by its first four bytes."""
TIFF_ENTRY_BYTES = 12
"""Length of an entry of a TIFF directory."""
ORIENTATION_TAG = 274
"""The tag of the orientation in EXIF and TIFF."""
BOX_HEADER_BYTES = 8
"""A box of an AVIF file begins with its length and its kind, together of this many bytes."""
VERSION_BYTES = 4
"""The content of an AVIF file's `meta` box begins with this many bytes of version and flags."""


@dataclass(frozen=True)
class Orientation:
    """How a file asks viewers to turn its image."""

    transposed: bool
    """Whether rows become columns, before the flips."""
    flip_rows: bool
    flip_columns: bool

    def __str__(self) -> str:
        if self.transposed:
            return "turned by 90 degrees"
        return "turned by 180 degrees" if self.flip_rows and self.flip_columns else "mirrored"

    def apply(self, image: np.ndarray) -> np.ndarray:
        """The image as viewers show it."""
        turned = image.swapaxes(0, 1) if self.transposed else image
        return np.ascontiguousarray(turned[:: -1 if self.flip_rows else 1, :: -1 if self.flip_columns else 1])

    def undo(self, image: np.ndarray) -> np.ndarray:
        """The image as it is stored, from the image that viewers show."""
        stored = image[:: -1 if self.flip_rows else 1, :: -1 if self.flip_columns else 1]
        return np.ascontiguousarray(stored.swapaxes(0, 1) if self.transposed else stored)


def orientation_of(value: int) -> Orientation | None:
    """The orientation that a value of EXIF's tag means; None for 1, upright, and for invalid values."""
    if not 2 <= value < 2 + len(EXIF_ORIENTATIONS):
        return None
    transposed, flip_rows, flip_columns = EXIF_ORIENTATIONS[value - 2]
    return Orientation(transposed, flip_rows, flip_columns)


def tiff_orientation(data: bytes) -> Orientation | None:
    """How a TIFF file's first directory asks viewers to turn the image; None if it does not, or is none."""
    order = TIFF_ORDERS.get(data[:4])
    if order is None:
        return None
    try:
        (at,) = struct.unpack_from(f"{order}I", data, 4)
        (count,) = struct.unpack_from(f"{order}H", data, at)
        for entry in range(count):
            tag, _, _, value = struct.unpack_from(f"{order}HHIH", data, at + 2 + TIFF_ENTRY_BYTES * entry)
            if tag == ORIENTATION_TAG:
                return orientation_of(value)
    except struct.error:  # truncated
        return None
    return None


def avif_orientation(data: bytes) -> Orientation | None:
    """How an AVIF file's properties ask viewers to turn the image; None if they do not, or for other data.

    They are `irot`, quarter turns counter-clockwise, then `imir`, a flip of rows (0) or of columns (1):
    ISO/IEC 23008-12, sections 6.5.10 and 6.5.12. Writers convert EXIF's orientation to them.
    """
    boxes = _boxes(data)
    if not boxes.get(b"ftyp", b"").startswith((b"avif", b"avis")):
        return None
    item_properties = _boxes(boxes.get(b"meta", b"")[VERSION_BYTES:]).get(b"iprp", b"")
    properties = _boxes(_boxes(item_properties).get(b"ipco", b""))
    turns = properties.get(b"irot", b"")[:1]
    mirror = properties.get(b"imir", b"")[:1]
    quarter_turns = turns[0] % 4 if turns else 0
    orientation = Orientation(
        transposed=quarter_turns in (1, 3),
        flip_rows=(quarter_turns in (1, 2)) != (mirror == b"\0"),
        flip_columns=(quarter_turns in (2, 3)) != (mirror == b"\1"),
    )
    return None if orientation == Orientation(False, False, False) else orientation


def _boxes(data: bytes) -> dict[bytes, bytes]:
    """The content of the first box of each kind in a part of an AVIF file, up to a damaged one."""
    contents: dict[bytes, bytes] = {}
    at = 0
    while at + BOX_HEADER_BYTES <= len(data):
        length, kind = struct.unpack_from(">I4s", data, at)
        if length < BOX_HEADER_BYTES or at + length > len(data):
            break
        contents.setdefault(kind, data[at + BOX_HEADER_BYTES : at + length])
        at += length
    return contents


def exif_orientation(path: Path) -> Orientation | None:
    """How EXIF, TIFF or AVIF asks viewers to turn the image; None if it does not, or if it is not an image."""
    content = read_bytes(path)
    if content[:4] in TIFF_ORDERS:
        return tiff_orientation(content)
    by_property = avif_orientation(content)
    if by_property is not None:
        return by_property
    small = cv2.IMREAD_REDUCED_COLOR_4
    data = np.frombuffer(content, np.uint8)
    stored = cv2.imdecode(data, small | cv2.IMREAD_IGNORE_ORIENTATION)
    turned = cv2.imdecode(data, small)
    if stored is None or turned is None or (stored.shape == turned.shape and (stored == turned).all()):
        return None
    for transposed, flip_rows, flip_columns in EXIF_ORIENTATIONS:
        orientation = Orientation(transposed, flip_rows, flip_columns)
        shown = orientation.apply(stored)
        if shown.shape == turned.shape and (shown == turned).all():
            return orientation
    return None
