"""glTF 2.0 characters: reads a .glb or .gltf into skinned, textured geometry and a tree of nodes."""

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from viewmend.capture.errors import CaptureError
from viewmend.geometry.mesh import Mesh, vertex_normals
from viewmend.studio.gltf_document import Document, read_document

MISFITS = (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, RuntimeError, struct.error)
"""What indices, types and shapes raise that do not fit one another."""
MAX_VERTICES = 20_000_000
"""Vertices of all parts, each counted where it stands."""
HEAVIEST = 65535.0
"""Weights are divided by their sum, so that whole numbers of 16 bit will do; what is heavier is none."""


@dataclass(frozen=True)
class Node:
    """One node of the tree, its transform relative to its parent (identity, 0, 1 where the file gives none)."""

    name: str
    parent: int
    """Position of the parent among the character's nodes, -1 for a root; parents come first."""
    translation: Float[Tensor, "3"]
    rotation: Float[Tensor, "3 3"]
    scale: Float[Tensor, "3"]


@dataclass(frozen=True)
class Character:
    """A character in its rest pose: all parts as one mesh. Lengths are the file's (glTF: metres, y up)."""

    nodes: tuple[Node, ...]
    vertices: Float[Tensor, "vertex 3"]
    normals: Float[Tensor, "vertex 3"]
    uv: Float[Tensor, "vertex 2"]
    faces: Int[Tensor, "face 3"]
    texture_of_face: Int[Tensor, "face"]
    textures: tuple[Float[Tensor, "3 _ _"], ...]
    joints: Int[Tensor, "vertex 4"]
    """Per vertex, positions in `node_of_joint`."""
    weights: Float[Tensor, "vertex 4"]
    node_of_joint: Int[Tensor, "joint"]
    joint_from_bind: Float[Tensor, "joint 4 4"]
    """Inverse bind matrices."""


def load_character(path: Path) -> Character:
    """Read a character; parts without a skin follow the node that they hang on.

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
    nodes = tuple(_node(document.json["nodes"][n], n, position.get(parent_of[n], -1), path) for n in order)
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
            raise CaptureError(f"{document.path}: expected a tree of nodes, found a loop; export the file again")
    return order, parent_of


def _node(entry: Mapping[str, Any], index: int, parent: int, path: Path) -> Node:
    name = str(entry.get("name", f"node{index}"))
    if "matrix" in entry:
        matrix = torch.tensor(entry["matrix"], dtype=torch.float32).reshape(4, 4).T
        scale = matrix[:3, :3].norm(dim=0)
        if not bool((scale > 0).all()):
            raise CaptureError(f"{path}: node {name} has a singular matrix; apply transforms and export again")
        return Node(name, parent, matrix[:3, 3].clone(), matrix[:3, :3] / scale, scale)
    rotation = _rotation_from_quaternion(torch.tensor(entry.get("rotation", [0, 0, 0, 1]), dtype=torch.float32))
    translation = torch.tensor(entry.get("translation", [0, 0, 0]), dtype=torch.float32)
    return Node(name, parent, translation, rotation, torch.tensor(entry.get("scale", [1, 1, 1]), dtype=torch.float32))


def _rotation_from_quaternion(quaternion: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """The rotation of a quaternion (x, y, z, w) of any length but zero."""
    x, y, z, w = torch.nn.functional.normalize(quaternion, dim=-1).unbind(-1)
    rows = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        *(2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        *(2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    ]
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


class _Parts:
    """Collects the primitives of a file into one mesh."""

    def __init__(self, document: Document, position: Mapping[int, int]) -> None:
        self.document = document
        self.position = position
        self.columns: dict[str, list[np.ndarray]] = {
            name: [] for name in ("vertices", "normals", "uv", "joints", "weights")
        }
        self.faces: list[np.ndarray] = []
        self.texture_of_face: list[np.ndarray] = []
        self.textures: list[np.ndarray] = []
        self.texture_index: dict[int, int] = {}
        self.joint_nodes: list[int] = []
        self.inverse_binds: list[np.ndarray] = []
        self.first_joint: dict[tuple[str, int], int] = {}
        self.skinned = False
        self.count = 0

    def add(self, node: int, skin: int | None, primitive: Mapping[str, Any]) -> None:
        """Append one primitive of the mesh at `node`."""
        attributes, read = primitive["attributes"], self.document.accessor
        vertices = read(attributes["POSITION"]).astype(np.float32)
        n = len(vertices)
        if self.count + n > MAX_VERTICES:
            raise CaptureError(f"{self.document.path}: expected at most {MAX_VERTICES} vertices, got more; simplify it")
        faces = (read(primitive["indices"]).reshape(-1) if "indices" in primitive else np.arange(n)).astype(np.int64)
        if len(faces) % 3 or (len(faces) and faces.max() >= n):
            raise CaptureError(
                f"{self.document.path}: expected triangles whose corners are below {n}, found an index list "
                f"of {len(faces)} up to {faces.max(initial=0)}; export the file again"
            )
        faces = faces.reshape(-1, 3)
        shape = Mesh(torch.from_numpy(vertices), torch.from_numpy(faces))
        normals = read(attributes["NORMAL"]) if "NORMAL" in attributes else vertex_normals(shape).numpy()
        uv = read(attributes["TEXCOORD_0"]) if "TEXCOORD_0" in attributes else np.zeros((n, 2))
        joints, weights = self._binding(node, skin, attributes, n)
        # Tiled textures: whole turns are dropped once for the primitive, the rest is clamped by the sampler.
        uv = uv - np.floor(uv.min(0)) if n and (uv.min() < 0 or uv.max() > 1) else uv
        columns = (vertices, normals, uv, joints, weights)
        for column, values in zip(self.columns.values(), columns, strict=True):
            column.append(values)
        texture = self._texture(primitive.get("material", -1))
        self.faces.append(faces + self.count)
        self.texture_of_face.append(np.full(len(faces), texture))
        self.count += n

    def _binding(
        self, node: int, skin: int | None, attributes: Mapping[str, int], n: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Joint positions and weights of n vertices; the weights sum to one."""
        if skin is None or "JOINTS_0" not in attributes:
            key = ("node", node)
            if key not in self.first_joint:
                self._add_joints(key, [node], np.eye(4, dtype=np.float32)[None])
            joints = np.full((n, 4), self.first_joint[key], dtype=np.int64)
            return joints, np.tile(np.array([1, 0, 0, 0], dtype=np.float32), (n, 1))
        self.skinned = True
        entry = self.document.entry("skins", skin)
        key = ("skin", skin)
        if key not in self.first_joint:
            identity = np.tile(np.eye(4, dtype=np.float32), (len(entry["joints"]), 1, 1))
            given = entry.get("inverseBindMatrices")
            binds = identity if given is None else self.document.accessor(given).reshape(-1, 4, 4).transpose(0, 2, 1)
            self._add_joints(key, entry["joints"], binds)
        joints = self.document.accessor(attributes["JOINTS_0"]).astype(np.int64)
        weights = self.document.accessor(attributes["WEIGHTS_0"]).astype(np.float32)
        if len(joints) != n or len(weights) != n or joints.max(initial=0) >= len(entry["joints"]):
            raise CaptureError(
                f"{self.document.path}: expected joints and weights for {n} vertices with joints below "
                f"{len(entry['joints'])}, found {len(joints)} and {len(weights)} up to joint "
                f"{joints.max(initial=0)}; export the file again"
            )
        if not bool(((weights >= 0) & (weights <= HEAVIEST)).all()):
            raise CaptureError(f"{self.document.path}: expected weights of joints in [0, 1]; export the file again")
        return joints + self.first_joint[key], weights / np.maximum(weights.sum(1, keepdims=True), 1e-8)

    def _add_joints(self, key: tuple[str, int], nodes: list[int], binds: np.ndarray) -> None:
        missing = [n for n in nodes if n not in self.position]
        if missing:
            raise CaptureError(f"{self.document.path}: joints {missing} are not in the scene; export the file again")
        self.first_joint[key] = len(self.joint_nodes)
        self.joint_nodes += [self.position[n] for n in nodes]
        self.inverse_binds.append(binds.astype(np.float32))

    def _texture(self, material: int) -> int:
        """Position of this material's base colour among the textures."""
        if material not in self.texture_index:
            self.texture_index[material] = len(self.textures)
            self.textures.append(self.document.base_color(material))
        return self.texture_index[material]

    def character(self, nodes: tuple[Node, ...]) -> Character:
        """All that was added, as tensors."""
        joined = {name: np.concatenate(parts) for name, parts in self.columns.items()}

        def floats(values: np.ndarray) -> Tensor:
            return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32))

        for node in nodes:
            if not all(bool(part.isfinite().all()) for part in (node.translation, node.rotation, node.scale)):
                raise CaptureError(f"{self.document.path}: node {node.name} is no finite transform; export it again")
        return Character(
            nodes=nodes,
            vertices=floats(joined["vertices"]),
            normals=torch.nn.functional.normalize(floats(joined["normals"]), dim=-1),
            uv=floats(joined["uv"]),
            faces=torch.from_numpy(np.concatenate(self.faces)),
            texture_of_face=torch.from_numpy(np.concatenate(self.texture_of_face).astype(np.int64)),
            textures=tuple(floats(t) for t in self.textures),
            joints=torch.from_numpy(joined["joints"].astype(np.int64)),
            weights=floats(joined["weights"]),
            node_of_joint=torch.tensor(self.joint_nodes),
            joint_from_bind=floats(np.concatenate(self.inverse_binds)),
        )
