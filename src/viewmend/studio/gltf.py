"""glTF 2.0 characters: reads a .glb or .gltf into skinned, textured geometry and a tree of nodes."""

import base64
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from viewmend.data.errors import CaptureError
from viewmend.data.images import decode_image, size_from_header
from viewmend.data.native_format import stays_inside
from viewmend.geometry.mesh import Mesh, vertex_normals
from viewmend.studio.performer import BoundMesh, TexturedMesh
from viewmend.utils.untrusted_input import read_json, shown

MAX_BYTES = 2 * 10**9
"""Size of the largest file that is read, in bytes."""
MAX_TEXELS = 2**26
"""Largest number of pixels of a texture."""

_COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
MISFITS = (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, RuntimeError, struct.error)
"""Errors that indices, types and shapes raise which do not fit one another."""
MAX_VERTICES = 20_000_000
"""Largest number of vertices of all parts, each counted once for every node that uses it."""
HEAVIEST = 65535.0
"""Largest accepted skinning weight. Weights are divided by their sum, so 16-bit integers are
fine."""


@dataclass(frozen=True)
class Document:
    """A parsed file: its JSON and its buffers."""

    path: Path
    json: Mapping[str, Any]
    buffers: tuple[bytes, ...] = field(repr=False)

    def fault(self, text: str) -> CaptureError:
        """Make the error for a file that has to be exported in another way."""
        return CaptureError(f"{self.path}: {text}; export it again")

    def entry(self, kind: str, index: int) -> Mapping[str, Any]:
        """`json[kind][index]`, or a CaptureError that names what is missing."""
        entries = self.json.get(kind, [])
        if type(index) is not int or not 0 <= index < len(entries):
            raise self.fault(f"expected {kind} number {index}, the file has {len(entries)}")
        return entries[index]

    def view(self, index: int) -> bytes:
        """The bytes of a buffer view."""
        entry = self.entry("bufferViews", index)
        start = _count(entry.get("byteOffset", 0))
        data = self.buffers[_count(entry["buffer"])]
        end = start + _count(entry["byteLength"])
        if end > len(data):
            raise self.fault(f"expected {end} bytes of binary data or more, got {len(data)}: it is cut short")
        return data[start:end]

    def accessor(self, index: int) -> np.ndarray:
        """The values of an accessor, (count, width); normalised integers come as floats."""
        entry = self.entry("accessors", index)
        if "sparse" in entry or "bufferView" not in entry:
            raise CaptureError(f"{self.path}: sparse accessors are not supported; export without shape keys")
        dtype = np.dtype(_COMPONENTS[entry["componentType"]])
        width = _WIDTHS[entry["type"]]
        data = self.view(entry["bufferView"])
        size = dtype.itemsize * width
        stride = _count(self.entry("bufferViews", entry["bufferView"]).get("byteStride", size))
        offset = _count(entry.get("byteOffset", 0))
        count = _count(entry["count"])
        if stride < size:
            raise self.fault(f"accessor {index}: expected a byteStride of {size} or more, got {stride}")
        if count and offset + stride * (count - 1) + size > len(data):
            raise self.fault(f"accessor {index} wants {count} elements, its view has only {len(data)} bytes")
        values = np.ndarray((count, width), dtype, data, offset, (stride, dtype.itemsize)).copy()
        if dtype.kind == "f" and not np.isfinite(values).all():
            raise self.fault(f"accessor {index} holds NaN or infinity; repair the mesh")
        if entry.get("normalized") and dtype.kind != "f":
            values = np.maximum(values.astype(np.float32) / np.iinfo(dtype).max, -1)
        return values

    def base_color(self, material: int) -> np.ndarray:
        """A material's base colour as sRGB in [0, 1], (3, height, width); one texel where it has no texture."""
        entry = self.entry("materials", material) if material >= 0 else {}
        pbr = entry.get("pbrMetallicRoughness", {})
        factor = np.array(pbr.get("baseColorFactor", [1, 1, 1, 1])[:3], dtype=np.float32)
        # glTF factors are linear light; the power 1/2.2 is within 1 % of the sRGB curve and
        # multiplies through.
        tint = factor[:, None, None] ** (1 / 2.2)
        if "baseColorTexture" not in pbr:
            return tint
        index = self.entry("textures", pbr["baseColorTexture"]["index"]).get("source", -1)
        entry = self.entry("images", index)
        data = self.view(entry["bufferView"]) if "bufferView" in entry else _resource(self.path, entry["uri"])
        size = size_from_header(data) or (0, 0)
        if size[0] * size[1] > MAX_TEXELS:
            raise CaptureError(
                f"{self.path}: expected images of at most {MAX_TEXELS} pixels, got {size[0]} x {size[1]}; shrink it"
            )
        image = decode_image(data, cv2.IMREAD_COLOR)
        if image is None:
            raise self.fault(f"image {entry.get('name', index)} is no readable JPEG or PNG")
        return np.ascontiguousarray(image[..., ::-1].transpose(2, 0, 1)).astype(np.float32) / 255 * tint


def read_document(path: Path) -> Document:
    """Parse a .glb (binary) or .gltf (JSON with separate files or data URIs); errors as of `load_character`."""
    data = _read(path)
    if data[:4] == b"glTF":
        text, binary = _chunks(path, data)
    elif path.suffix.lower() == ".gltf":
        text = data
        binary = b""
    else:
        raise CaptureError(
            f"{path}: expected a glTF binary that starts with 'glTF', got {data[:4]!r}; export a .glb"
        )
    try:
        document = read_json(text)
    except ValueError as error:
        raise CaptureError(
            f"{path}: its JSON part does not parse ({error}); export the file again"
        ) from error
    if not isinstance(document, dict):
        raise CaptureError(f"{path}: expected JSON keys, got a {type(document).__name__}; export it again")
    version = str(document.get("asset", {}).get("version", "none"))
    if not version.startswith("2"):
        raise CaptureError(f"{path}: expected glTF version 2.0, got {version[:40]}; export it as glTF 2.0")
    needed = [
        e for e in document.get("extensionsRequired", []) if not e.startswith(("KHR_materials", "KHR_mesh_q"))
    ]
    if needed:
        raise CaptureError(
            f"{path}: needs extensions {shown(needed)}, got no reader; export without compression"
        )
    buffers = tuple(_resource(path, b["uri"]) if "uri" in b else binary for b in document.get("buffers", []))
    return Document(path, document, buffers)


def _chunks(path: Path, data: bytes) -> tuple[bytes, bytes]:
    """The JSON and the binary chunk of a .glb."""
    length = struct.unpack_from("<I", data, 8)[0] if len(data) >= 12 else 0
    if length < 20 or len(data) < length:
        raise CaptureError(
            f"{path}: expected {length} bytes, the file has {len(data)}: it is cut short; copy it again"
        )
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
        raise CaptureError(
            f"{path}: expected files in its own folder, got '{uri[:200]}'; move the file there"
        )
    return _read(file)


def _count(value: object) -> int:
    if type(value) is not int or value < 0:
        raise ValueError(f"expected a whole number from 0 on, got {str(value)[:40]}")
    return value


def _read(path: Path) -> bytes:
    if path.exists() and not (path.is_file() and path.stat().st_size <= MAX_BYTES):
        raise CaptureError(
            f"{path}: expected a file of at most {MAX_BYTES // 10**6} MB, got another; check the path"
        )
    try:
        return path.read_bytes()
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read ({error.strerror}); check the path") from error


@dataclass(frozen=True)
class Node:
    """One node of the tree, its transform relative to its parent (identity, 0, 1 where the file gives none)."""

    name: str
    parent: int
    """Index of the parent among the character's nodes, -1 for a root; parents come first."""
    translation: Float[Tensor, "3"]
    rotation: Float[Tensor, "3 3"]
    scale: Float[Tensor, "3"]


@dataclass(frozen=True)
class Character(BoundMesh):
    """A character in its rest pose: all parts as one mesh, in the file's units (glTF: metres, y up)."""

    nodes: tuple[Node, ...]
    """Nodes of the tree. `joints` are indices into `node_of_joint`, whose values are indices into
    these nodes."""
    node_of_joint: Int[Tensor, "joint"]
    joint_from_bind: Float[Tensor, "joint 4 4"]
    """Inverse bind matrices."""


def load_character(path: Path) -> Character:
    """Read a character; parts without a skin follow the node that they are attached to.

    Opaque base colours only: alpha, normal maps, morph targets and animations are ignored.

    Raises:
        CaptureError: the file is missing, cut short, not glTF 2.0, needs an extension that this reader
            lacks (compressed meshes), has no triangles or no skin, or has parts that do not fit one another.
    """
    try:
        return _load(path)
    except CaptureError:
        raise
    except MISFITS as error:
        said = " ".join(f"{type(error).__name__}: {error}".split())[:160]
        raise CaptureError(
            f"{path}: expected a glTF character, got parts that do not fit one another ({said}); export the file again"
        ) from error


def _load(path: Path) -> Character:
    document = read_document(path)
    order, parent_of = _tree(document)
    position = {node: place for place, node in enumerate(order)}
    nodes = tuple(_node(document, n, position.get(parent_of[n], -1)) for n in order)
    parts = _Parts(document, position)
    for node in order:
        entry = document.json["nodes"][node]
        for primitive in document.entry("meshes", entry["mesh"])["primitives"] if "mesh" in entry else ():
            if primitive.get("mode", 4) == 4:
                parts.add(node, entry.get("skin"), primitive)
    if not parts.faces or not parts.skinned:
        raise CaptureError(
            f"{path}: expected a character with a skinned triangle mesh, found "
            f"{'no skin' if parts.faces else 'no triangles'}; export mesh and armature together"
        )
    return parts.character(nodes)


def _tree(document: Document) -> tuple[list[int], dict[int, int]]:
    """The scene's nodes, parents first, and each one's parent (absent: -1)."""
    entries = document.json.get("nodes", [])
    parent_of = dict.fromkeys(range(len(entries)), -1)
    for n, entry in enumerate(entries):
        for child in entry.get("children", ()):
            parent_of[child] = n
    scenes = document.json.get("scenes")
    roots = scenes[document.json.get("scene", 0)].get("nodes", []) if scenes else []
    waiting = list(roots or [n for n, p in parent_of.items() if p < 0])
    order: list[int] = []
    while waiting:
        n = waiting.pop(0)
        order.append(n)
        waiting.extend(entries[n].get("children", ()))
        if len(order) > len(entries):
            raise document.fault("expected a tree of nodes, got a loop")
    return order, parent_of


def _node(document: Document, index: int, parent: int) -> Node:
    entry = document.json["nodes"][index]
    name = str(entry.get("name", f"node{index}"))
    if "matrix" in entry:
        matrix = torch.tensor(entry["matrix"], dtype=torch.float32).reshape(4, 4).T
        translation = matrix[:3, 3].clone()
        scale = matrix[:3, :3].norm(dim=0)
        if not bool((scale > 0).all()):
            raise CaptureError(
                f"{document.path}: node {name} has a singular matrix; apply transforms and export again"
            )
        rotation = matrix[:3, :3] / scale
    else:
        rest = {"translation": [0, 0, 0], "scale": [1, 1, 1], "rotation": [0, 0, 0, 1]}
        given = (torch.tensor(entry.get(key, value), dtype=torch.float32) for key, value in rest.items())
        translation, scale, quaternion = given
        x, y, z, w = torch.nn.functional.normalize(quaternion, dim=-1).unbind(-1)
        rows = [
            *(1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
            *(2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
            *(2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
        ]
        rotation = torch.stack(rows, -1).unflatten(-1, (3, 3))
    if not all(bool(part.isfinite().all()) for part in (translation, rotation, scale)):
        raise document.fault(f"node {name} is no finite transform")
    return Node(name, parent, translation, rotation, scale)


class _Parts:
    """Collects the primitives of a file into one mesh."""

    def __init__(self, document: Document, position: Mapping[int, int]) -> None:
        self.document = document
        self.position = position
        self.columns: list[list[np.ndarray]] = [[], [], [], [], [], []]
        """Vertices, normals, texture coordinates, weights; joints, and of faces their textures."""
        self.faces: list[np.ndarray] = []
        self.textures: dict[int, np.ndarray] = {}
        self.joint_nodes: list[int] = []
        self.inverse_binds: list[np.ndarray] = []
        self.first_joint: dict[tuple[str, int], int] = {}
        self.skinned = False
        self.count = 0

    def add(self, node: int, skin: int | None, primitive: Mapping[str, Any]) -> None:
        """Append one primitive of the mesh at `node`."""
        attributes = primitive["attributes"]
        read = self.document.accessor
        vertices = read(attributes["POSITION"]).astype(np.float32)
        n = len(vertices)
        if self.count + n > MAX_VERTICES:
            raise CaptureError(
                f"{self.document.path}: expected at most {MAX_VERTICES} vertices, got more; simplify it"
            )
        faces = (read(primitive["indices"]).reshape(-1) if "indices" in primitive else np.arange(n)).astype(
            np.int64
        )
        if len(faces) % 3 or (len(faces) and faces.max() >= n):
            got = f"an index list of {len(faces)} up to {faces.max(initial=0)}"
            raise self.document.fault(f"expected triangles whose corners are below {n}, got {got}")
        faces = faces.reshape(-1, 3)
        shape = Mesh(torch.from_numpy(vertices), torch.from_numpy(faces))
        normals = read(attributes["NORMAL"]) if "NORMAL" in attributes else vertex_normals(shape).numpy()
        uv = read(attributes["TEXCOORD_0"]) if "TEXCOORD_0" in attributes else np.zeros((n, 2))
        joints, weights = self._binding(node, skin, attributes, n)
        # Tiled textures: whole turns are dropped once for the primitive, the rest is clamped by the sampler.
        uv = uv - np.floor(uv.min(0)) if n and (uv.min() < 0 or uv.max() > 1) else uv
        material = primitive.get("material", -1)
        if material not in self.textures:
            self.textures[material] = self.document.base_color(material)
        texture = np.full(len(faces), list(self.textures).index(material))
        for column, values in zip(
            self.columns, (vertices, normals, uv, weights, joints, texture), strict=True
        ):
            column.append(values)
        self.faces.append(faces + self.count)
        self.count += n

    def _binding(
        self, node: int, skin: int | None, attributes: Mapping[str, int], n: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Joint positions and weights of n vertices; the weights sum to one."""
        if skin is None or "JOINTS_0" not in attributes:
            joints = np.full((n, 4), self._first_joint(("node", node), [node], None))
            return joints, np.tile(np.array([1, 0, 0, 0], dtype=np.float32), (n, 1))
        self.skinned = True
        entry = self.document.entry("skins", skin)
        first = self._first_joint(("skin", skin), entry["joints"], entry.get("inverseBindMatrices"))
        joints = self.document.accessor(attributes["JOINTS_0"]).astype(np.int64)
        weights = self.document.accessor(attributes["WEIGHTS_0"]).astype(np.float32)
        if len(joints) != n or len(weights) != n or joints.max(initial=0) >= len(entry["joints"]):
            expected = f"joints and weights for {n} vertices with joints below {len(entry['joints'])}"
            got = f"{len(joints)} and {len(weights)} up to joint {joints.max(initial=0)}"
            raise self.document.fault(f"expected {expected}, got {got}")
        if not bool(((weights >= 0) & (weights <= HEAVIEST)).all()):
            raise self.document.fault("expected weights of joints in [0, 1], got others")
        return joints + first, weights / np.maximum(weights.sum(1, keepdims=True), 1e-8)

    def _first_joint(self, key: tuple[str, int], nodes: list[int], binds: int | None) -> int:
        """Position of a skin's or a node's first joint; `binds` is the accessor of their inverse bind matrices."""
        if key not in self.first_joint:
            identity = np.tile(np.eye(4, dtype=np.float32), (len(nodes), 1, 1))
            given = (
                identity
                if binds is None
                else self.document.accessor(binds).reshape(-1, 4, 4).transpose(0, 2, 1)
            )
            missing = [n for n in nodes if n not in self.position]
            if missing:
                raise self.document.fault(f"joints {missing} are not in the scene")
            self.first_joint[key] = len(self.joint_nodes)
            self.joint_nodes += [self.position[n] for n in nodes]
            self.inverse_binds.append(given.astype(np.float32))
        return self.first_joint[key]

    def character(self, nodes: tuple[Node, ...]) -> Character:
        """Combine all that was added, as tensors."""

        def floats(values: np.ndarray) -> Tensor:
            return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32))

        vertices, normals, uv, weights = (floats(np.concatenate(column)) for column in self.columns[:4])
        joints, texture = (
            torch.from_numpy(np.concatenate(column).astype(np.int64)) for column in self.columns[4:]
        )
        mesh = Mesh(vertices, torch.from_numpy(np.concatenate(self.faces)))
        textures = tuple(floats(t) for t in self.textures.values())
        rest = TexturedMesh(mesh, torch.nn.functional.normalize(normals, dim=-1), uv, texture, textures)
        binds = floats(np.concatenate(self.inverse_binds))
        return Character(rest, joints, weights, nodes, torch.tensor(self.joint_nodes), binds)
