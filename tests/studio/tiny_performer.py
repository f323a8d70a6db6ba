"""A tiny character and motion, written by the tests themselves."""

import itertools
import json
import struct
from pathlib import Path

import cv2
import numpy as np


def both_sides(*parts: tuple[str, str, float, float, float]) -> dict:
    """Joints of the left and the right side, from name, parent and place of the left ones."""
    return {
        f"{side}{part}": (
            parent if parent in ("Hips", "Spine", "lowerback") else side + parent,
            (sign * x, y, z),
        )
        for side, sign in (("Left", 1), ("Right", -1))
        for part, parent, x, y, z in parts
    }


JOINTS = {
    # name: (parent, rest position in metres): a T-pose of sticks, the left hand at +x.
    "Hips": (None, (0, 1.0, 0)),
    "Spine": ("Hips", (0, 1.1, 0)),
    "Head": ("Spine", (0, 1.6, 0)),
    **both_sides(
        ("Arm", "Spine", 0.2, 1.45, 0.0),
        ("ForeArm", "Arm", 0.45, 1.45, -0.02),
        ("Hand", "ForeArm", 0.7, 1.44, 0.0),
        ("UpLeg", "Hips", 0.1, 0.95, 0.0),
        ("Leg", "UpLeg", 0.12, 0.5, 0.02),
        ("Foot", "Leg", 0.12, 0.06, 0.0),
    ),
}


def skeleton_nodes(prefix: str) -> list[dict]:
    """Nodes of a glTF file; the hips carry a scale, so that everything below them is in centimetres."""
    nodes = []
    for name, (parent, position) in JOINTS.items():
        above = np.array(JOINTS[parent][1]) if parent else 0.0
        offset = (np.array(position) - above) * (100 if parent else 1)
        nodes.append({"name": prefix + name, "translation": offset.tolist()})
        children = [n for n, (p, _) in enumerate(JOINTS.values()) if p == name]
        nodes[-1] |= ({"children": children} if children else {}) | ({} if parent else {"scale": [0.01] * 3})
    return nodes


def write_character(path: Path, prefix: str = "") -> Path:
    """A .glb: one small box about every joint, the boxes of the left side red, the others green."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float32)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))], np.uint16)
    names = list(JOINTS)
    places = np.array([position for _, position in JOINTS.values()], np.float32)
    n = len(names)
    vertices = (places[:, None] + 0.06 * corners[None]).reshape(-1, 3).astype(np.float32)
    normals = np.tile(corners / np.sqrt(3, dtype=np.float32), (n, 1)).astype(np.float32)
    uv = np.repeat([[0.25, 0.5] if name.startswith("Left") else [0.75, 0.5] for name in names], 8, 0).astype(
        np.float32
    )
    joints = np.zeros((8 * n, 4), np.uint8)
    joints[:, 0] = np.repeat(np.arange(n), 8)
    weights = np.tile(np.array([1, 0, 0, 0], np.float32), (8 * n, 1))
    indices = (triangles[None] + 8 * np.arange(n)[:, None, None]).astype(np.uint16).reshape(-1)
    binds = np.tile(np.eye(4, dtype=np.float32), (n, 1, 1))
    binds[:, :3, :3] *= 100
    binds[:, :3, 3] = -100 * places
    image = np.zeros((8, 16, 3), np.uint8)
    image[:, :8, 2] = 255
    image[:, 8:, 1] = 255
    png = cv2.imencode(".png", image)[1].tobytes()
    arrays = [vertices, normals, uv, joints, weights, indices, binds.transpose(0, 2, 1).copy()]
    kinds = [("VEC3", 5126), ("VEC3", 5126), ("VEC2", 5126), ("VEC4", 5121), ("VEC4", 5126), ("SCALAR", 5123)]
    blobs = [a.tobytes() for a in arrays] + [png]
    starts = itertools.accumulate(map(len, blobs), initial=0)
    views = [
        {"buffer": 0, "byteOffset": n, "byteLength": len(b)} for n, b in zip(starts, blobs, strict=False)
    ]
    data = b"".join(blobs)
    data += b"\0" * (-len(data) % 4)
    accessors = [
        {"bufferView": k, "componentType": c, "type": t, "count": len(a)}
        for k, ((t, c), a) in enumerate(zip([*kinds, ("MAT4", 5126)], arrays, strict=True))
    ]
    attributes = {"POSITION": 0, "NORMAL": 1, "TEXCOORD_0": 2, "JOINTS_0": 3, "WEIGHTS_0": 4}
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0, n]}],
        "nodes": [*skeleton_nodes(prefix), {"name": "mesh", "mesh": 0, "skin": 0, "scale": [0.01] * 3}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": 5, "material": 0}]}],
        "skins": [{"joints": list(range(n)), "inverseBindMatrices": 6}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "textures": [{"source": 0}],
        "images": [{"bufferView": 7, "mimeType": "image/png"}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(data)}],
    }
    return write_glb(path, document, struct.pack("<I4s", len(data), b"BIN\0") + data)


def write_glb(path: Path, document: dict, binary: bytes) -> Path:
    """A .glb of a document and its binary chunk."""
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    header = struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text) + len(binary), len(text), b"JSON")
    path.write_bytes(header + text + binary)
    return path


BVH_JOINTS = {
    # Arms hang down and legs are spread, unlike the character; another size, in centimetres.
    "Hips": (None, (0, 0, 0)),
    "lowerback": ("Hips", (0, 12, 0)),
    "Head": ("lowerback", (0, 60, 0)),
    **both_sides(
        ("Shoulder", "lowerback", 22, 40, 0),
        ("Elbow", "Shoulder", 1, -30, 0),
        ("Wrist", "Elbow", 0, -28, 2),
        ("Hip", "Hips", 11, -5, 0),
        ("Knee", "Hip", 15, -45, 0),
        ("Ankle", "Knee", 15, -45, 0),
    ),
}


def write_motion(
    path: Path,
    angles: dict[str, tuple[float, float, float]] | None = None,
    frames: int = 4,
    travel_cm: float = 20.0,
) -> Path:
    """A cgspeed-like BVH; `angles` (z, x, y in degrees) grow linearly from the first frame to the last."""
    angles = angles or {}
    order: list[str] = []

    def block(name: str, depth: int) -> str:
        order.append(name)
        parent, offset = BVH_JOINTS[name]
        pad = "  " * depth
        channels = "6 Xposition Yposition Zposition " if parent is None else "3 "
        children = [n for n, (p, _) in BVH_JOINTS.items() if p == name]
        inner = "".join(block(c, depth + 1) for c in children)
        inner = inner or f"{pad}  End Site\n{pad}  {{\n{pad}    OFFSET 0 1 0\n{pad}  }}\n"
        return (
            f"{pad}{'ROOT' if parent is None else 'JOINT'} {name}\n{pad}{{\n"
            f"{pad}  OFFSET {' '.join(map(str, offset))}\n{pad}  CHANNELS {channels}Zrotation Xrotation Yrotation\n"
            f"{inner}{pad}}}\n"
        )

    text = "HIERARCHY\n" + block("Hips", 0)
    lines = []
    for share in np.linspace(0, 1, frames):
        turns = [a * share for name in order for a in angles.get(name, (0, 0, 0))]
        row = [50.0 + 10.0 * share, 95.0, -travel_cm * share, *turns]
        lines.append(" ".join(f"{v:.6f}" for v in row))
    path.write_text(f"{text}MOTION\nFrames: {frames}\nFrame Time: 0.0333333\n" + "\n".join(lines) + "\n")
    return path
