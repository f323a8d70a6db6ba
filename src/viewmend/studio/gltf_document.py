"""The container of glTF 2.0: JSON, binary buffers, typed accessors and images."""

import base64
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from viewmend.capture.errors import CaptureError
from viewmend.capture.images import decoded, told_size
from viewmend.capture.plain_format import stays_inside
from viewmend.json_input import read_json, shown

MAX_BYTES = 2 * 10**9
"""The largest file that is read."""
MAX_TEXELS = 2**26
"""The most pixels of a texture."""

_COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}


@dataclass(frozen=True)
class Document:
    """A parsed file: its JSON and its buffers."""

    path: Path
    json: Mapping[str, Any]
    buffers: tuple[bytes, ...] = field(repr=False)

    def entry(self, kind: str, index: int) -> Mapping[str, Any]:
        """`json[kind][index]`, or a CaptureError that says what is missing."""
        entries = self.json.get(kind, [])
        if type(index) is not int or not 0 <= index < len(entries):
            raise CaptureError(
                f"{self.path}: expected {kind} number {index}, the file has {len(entries)}; export it again"
            )
        return entries[index]

    def view(self, index: int) -> bytes:
        """The bytes of a buffer view."""
        entry = self.entry("bufferViews", index)
        start, length = _count(entry.get("byteOffset", 0)), _count(entry["byteLength"])
        data = self.buffers[_count(entry["buffer"])]
        if start + length > len(data):
            raise CaptureError(
                f"{self.path}: expected at least {start + length} bytes of binary data, found {len(data)}: "
                "the file is cut short; copy or export it again"
            )
        return data[start : start + length]

    def accessor(self, index: int) -> np.ndarray:
        """The values of an accessor, (count, width); normalised integers come as floats."""
        entry = self.entry("accessors", index)
        if "sparse" in entry or "bufferView" not in entry:
            raise CaptureError(f"{self.path}: sparse accessors are not supported; export without shape keys")
        dtype, width = np.dtype(_COMPONENTS[entry["componentType"]]), _WIDTHS[entry["type"]]
        data = self.view(entry["bufferView"])
        stride = _count(self.entry("bufferViews", entry["bufferView"]).get("byteStride", dtype.itemsize * width))
        offset, count = _count(entry.get("byteOffset", 0)), _count(entry["count"])
        if stride < dtype.itemsize * width:
            raise CaptureError(
                f"{self.path}: expected a byteStride of at least {dtype.itemsize * width} for accessor {index}, got "
                f"{stride}; export it again"
            )
        if count and offset + stride * (count - 1) + dtype.itemsize * width > len(data):
            raise CaptureError(
                f"{self.path}: accessor {index} wants {count} elements, its view has only {len(data)} bytes: "
                "the file is damaged; export it again"
            )
        values = np.ndarray((count, width), dtype, data, offset, (stride, dtype.itemsize)).copy()
        if dtype.kind == "f" and not np.isfinite(values).all():
            raise CaptureError(
                f"{self.path}: accessor {index} holds NaN or infinity; repair the mesh and export it again"
            )
        if entry.get("normalized") and dtype.kind != "f":
            values = np.maximum(values.astype(np.float32) / np.iinfo(dtype).max, -1)
        return values

    def base_color(self, material: int) -> np.ndarray:
        """A material's base colour as sRGB in [0, 1], (3, height, width); one texel where it has no texture."""
        entry = self.entry("materials", material) if material >= 0 else {}
        pbr = entry.get("pbrMetallicRoughness", {})
        factor = np.array(pbr.get("baseColorFactor", [1, 1, 1, 1])[:3], dtype=np.float32)
        # glTF factors are linear light; the power 1/2.2 is within 1 % of the sRGB curve and multiplies through.
        tint = factor[:, None, None] ** (1 / 2.2)
        if "baseColorTexture" not in pbr:
            return np.ascontiguousarray(tint)
        texture = self.entry("textures", pbr["baseColorTexture"]["index"])
        return self._image(texture.get("source", -1)) * tint

    def _image(self, index: int) -> np.ndarray:
        import cv2

        entry = self.entry("images", index)
        data = self.view(entry["bufferView"]) if "bufferView" in entry else _resource(self.path, entry["uri"])
        size = told_size(data) or (0, 0)
        if size[0] * size[1] > MAX_TEXELS:
            raise CaptureError(
                f"{self.path}: expected images of at most {MAX_TEXELS} pixels, got {size[0]} x {size[1]}; shrink it"
            )
        image = decoded(data, cv2.IMREAD_COLOR)
        if image is None:
            raise CaptureError(
                f"{self.path}: image {entry.get('name', index)} is no readable JPEG or PNG; export it again"
            )
        return np.ascontiguousarray(image[..., ::-1].transpose(2, 0, 1)).astype(np.float32) / 255


def read_document(path: Path) -> Document:
    """Parse a .glb (binary) or .gltf (JSON with files beside it or data URIs).

    Raises:
        CaptureError: missing, cut short, not glTF 2.0, or an extension is required.
    """
    data = _read(path)
    if data[:4] == b"glTF":
        text, binary = _chunks(path, data)
    elif path.suffix.lower() == ".gltf":
        text, binary = data, b""
    else:
        raise CaptureError(f"{path}: expected a glTF binary that starts with 'glTF', got {data[:4]!r}; export a .glb")
    try:
        document = read_json(text)
    except ValueError as error:
        raise CaptureError(f"{path}: its JSON part does not parse ({error}); export the file again") from error
    if not isinstance(document, dict):
        raise CaptureError(f"{path}: expected JSON keys, got a {type(document).__name__}; export it again")
    version = str(document.get("asset", {}).get("version", "none"))
    if not version.startswith("2"):
        raise CaptureError(f"{path}: expected glTF version 2.0, got {version[:40]}; export it as glTF 2.0")
    needed = [e for e in document.get("extensionsRequired", []) if not e.startswith(("KHR_materials", "KHR_mesh_q"))]
    if needed:
        raise CaptureError(f"{path}: needs extensions {shown(needed)}, got no reader; export without compression")
    buffers = tuple(_resource(path, b["uri"]) if "uri" in b else binary for b in document.get("buffers", []))
    return Document(path, document, buffers)


def _chunks(path: Path, data: bytes) -> tuple[bytes, bytes]:
    """The JSON and the binary chunk of a .glb."""
    length = struct.unpack_from("<I", data, 8)[0] if len(data) >= 12 else 0
    if length < 20 or len(data) < length:
        raise CaptureError(f"{path}: expected {length} bytes, the file has {len(data)}: it is cut short; copy it again")
    chunks: dict[bytes, bytes] = {}
    offset = 12
    while offset + 8 <= length:
        size, kind = struct.unpack_from("<I4s", data, offset)
        chunks.setdefault(kind, data[offset + 8 : offset + 8 + size])
        offset += 8 + size
    if b"JSON" not in chunks:
        raise CaptureError(f"{path}: expected a JSON chunk, found {sorted(chunks)}; export the file again")
    return chunks[b"JSON"], chunks.get(b"BIN\0", b"")


def _resource(path: Path, uri: str) -> bytes:
    if uri.startswith("data:"):
        return base64.b64decode(uri.partition(",")[2])
    file = path.parent / unquote(uri)
    if not stays_inside(unquote(uri)) or not file.resolve().is_relative_to(path.parent.resolve()):
        raise CaptureError(f"{path}: expected files in its own folder, got '{uri[:200]}'; move the file there")
    return _read(file)


def _count(value: object) -> int:
    """A number of bytes or things.

    Raises:
        ValueError: it is none.
    """
    if type(value) is not int or value < 0:
        raise ValueError(f"expected a whole number from 0 on, got {str(value)[:40]}")
    return value


def _read(path: Path) -> bytes:
    if path.exists() and not (path.is_file() and path.stat().st_size <= MAX_BYTES):
        raise CaptureError(f"{path}: expected a file of at most {MAX_BYTES // 10**6} MB, got another; check the path")
    try:
        return path.read_bytes()
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read ({error.strerror}); check the path") from error
