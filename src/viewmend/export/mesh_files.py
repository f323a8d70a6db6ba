"""Meshes and points as files: binary glTF 2.0 and PLY."""

import json
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from torch import Tensor

from viewmend.utils.atomic_writes import write_atomically
from viewmend.utils.srgb import linear_from_srgb

FLOAT = 5126
"""glTF's component type of 32-bit floats (glTF 2.0, section 3.6)."""
UINT16 = 5123
"""glTF's component type of unsigned 16-bit integers."""
UINT32 = 5125
"""glTF's component type of unsigned 32-bit integers."""
ARRAY_BUFFER = 34962
"""glTF's buffer target of vertex attributes."""
ELEMENT_ARRAY_BUFFER = 34963
"""glTF's buffer target of vertex indices."""


def write_glb(
    path: Path,
    vertices: Float[Tensor, "vertex 3"],
    faces: Int[Tensor, "face 3"],
    colours: Float[Tensor, "vertex 3"],
    normals: Float[Tensor, "vertex 3"],
) -> None:
    """Write a mesh as binary glTF 2.0; without vertices, a scene without a mesh.

    Args:
        path: the file.
        vertices: metres, y up.
        faces: counter-clockwise from outside.
        colours: sRGB in [0, 1]. They are written as linear 16-bit vertex colours, on an unlit
            material: they include the captured light.
        normals: unit, outward.

    Raises:
        OSError: the file cannot be written.
    """
    linear = np.rint(65535 * linear_from_srgb(colours.clamp(0, 1)).cpu().numpy()).astype("<u2")
    rgba = np.concatenate([linear, np.full((len(linear), 1), 65535, "<u2")], 1)
    position = vertices.cpu().numpy().astype("<f4")
    parts = {
        "POSITION": (position, "VEC3", FLOAT),
        "NORMAL": (normals.cpu().numpy().astype("<f4"), "VEC3", FLOAT),
        "COLOR_0": (rgba, "VEC4", UINT16),
        "indices": (faces.cpu().numpy().astype("<u4").reshape(-1), "SCALAR", UINT32),
    }
    data = b"".join(array.tobytes() for array, _, _ in parts.values()) if len(position) else b""
    _write_chunks(path, json.dumps(_gltf(parts), separators=(",", ":")).encode(), data)


def _gltf(parts: Mapping[str, tuple[np.ndarray, str, int]]) -> dict[str, object]:
    """The JSON of a mesh whose attributes and indices follow each other in the binary data, in the order of `parts`."""
    document: dict[str, object] = {"asset": {"version": "2.0", "generator": "viewmend"}, "scene": 0}
    document["scenes"] = [{"nodes": [0]}]
    position = parts["POSITION"][0]
    if not len(position):
        return document | {"nodes": [{"name": "hull"}]}
    views: list[dict[str, int]] = []
    accessors: list[dict[str, Any]] = []
    offset = 0
    for name, (array, kind, component) in parts.items():
        target = ELEMENT_ARRAY_BUFFER if name == "indices" else ARRAY_BUFFER
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": array.nbytes, "target": target})
        accessor = {
            "bufferView": len(views) - 1,
            "componentType": component,
            "count": len(array),
            "type": kind,
        }
        if name == "COLOR_0":
            accessor["normalized"] = True
        accessors.append(accessor)
        offset += array.nbytes
    accessors[0] |= {"min": position.min(0).tolist(), "max": position.max(0).tolist()}
    attributes = {name: n for n, name in enumerate(parts) if name != "indices"}
    return document | {
        "nodes": [{"name": "hull", "mesh": 0}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": len(attributes), "material": 0}]}],
        "materials": [{"name": "captured", "extensions": {"KHR_materials_unlit": {}}}],
        "extensionsUsed": ["KHR_materials_unlit"],
        "buffers": [{"byteLength": offset}],
        "bufferViews": views,
        "accessors": accessors,
    }


def _write_chunks(path: Path, text: bytes, data: bytes) -> None:
    """Write header, JSON padded with blanks, and binary data, whose parts are multiples of 4 bytes."""
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(data), b"BIN\0") + data if data else b""
    whole = struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, lambda draft: draft.write_bytes(whole))


def write_ply(
    path: Path,
    vertices: Float[Tensor, "vertex 3"],
    colours: Float[Tensor, "vertex 3"],
    faces: Int[Tensor, "face 3"] | None = None,
) -> None:
    """Write points, or a mesh of counter-clockwise faces, as binary PLY: metres, and sRGB in [0, 1] as 8 bit.

    Raises:
        OSError: the file cannot be written.
    """
    points = np.zeros(len(vertices), [("position", "<f4", 3), ("colour", "u1", 3)])
    points["position"] = vertices.cpu().numpy()
    points["colour"] = np.rint(255 * colours.clamp(0, 1).cpu().numpy())
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    lines += [f"property float {axis}" for axis in "xyz"] + [
        f"property uchar {c}" for c in ("red", "green", "blue")
    ]
    triangles = np.zeros(0 if faces is None else len(faces), [("corners", "u1"), ("vertex", "<i4", 3)])
    if faces is not None:
        triangles["corners"] = 3
        triangles["vertex"] = faces.cpu().numpy()
        lines += [f"element face {len(triangles)}", "property list uchar int vertex_indices"]
    head = "\n".join([*lines, "end_header", ""]).encode()
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, lambda draft: draft.write_bytes(head + points.tobytes() + triangles.tobytes()))
