"""Writers of others' calibrations, from the formats' own descriptions, for round trips."""

import json
import struct

import numpy as np
from scipy.spatial.transform import Rotation

COLMAP = {"PINHOLE": (1, 0), "RADIAL": (3, 2), "OPENCV": (4, 4), "FULL_OPENCV": (6, 5)}


def write_transforms(folder, cameras, shared=False):
    """Write nerfstudio's transforms.json; `shared` puts the first camera's lens at the top level."""
    frames, top = [], {}
    for camera in cameras:
        K, dist = camera["K"], camera["dist"]
        lens = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "w": camera["width"]}
        lens |= {"h": camera["height"], "camera_model": "OPENCV"}
        lens |= dict(zip(("k1", "k2", "p1", "p2", "k3"), dist.tolist(), strict=True))
        world_from_camera = np.linalg.inv(np.vstack([np.c_[camera["R"], camera["t"]], [0, 0, 0, 1]]))
        matrix = (world_from_camera @ np.diag([1, -1, -1, 1])).tolist()
        top = top or (lens if shared else {})
        frame = {"file_path": f"./{camera['image']}", "mask_path": camera["mask"], "transform_matrix": matrix}
        frames.append(frame | ({} if shared else lens))
    (folder / "transforms.json").write_text(json.dumps({**top, "frames": frames}))


def write_colmap(folder, cameras, model="OPENCV", binary=True):
    """A sparse model, of which every image has three points when binary, and none as text."""
    number, kept = COLMAP[model]
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True)
    lenses, images = [], []
    for index, camera in enumerate(cameras, 3):
        K, dist = camera["K"], camera["dist"]
        values = [K[0, 0], K[1, 1], K[0, 2], K[1, 2], *dist[:kept]]
        if model == "RADIAL":
            values = [K[0, 0], K[0, 2], K[1, 2], *dist[:2]]
        values += [0.0] * 3 * (model == "FULL_OPENCV")
        x, y, z, w = Rotation.from_matrix(camera["R"]).as_quat()
        pose = [float(n) for n in (w, x, y, z, *camera["t"])]
        lenses.append((index, number, camera["width"], camera["height"], [float(n) for n in values]))
        images.append((index + 10, pose, index, camera["image"].removeprefix("images/")))
    if binary:
        data = b"".join(struct.pack(f"<iiQQ{len(v)}d", *head, *v) for *head, v in lenses)
        (sparse / "cameras.bin").write_bytes(struct.pack("<Q", len(lenses)) + data)
        points = struct.pack("<Q", 3) + struct.pack("<ddq", 1, 2, -1) * 3
        data = b"".join(struct.pack("<i7di", i, *p, c) + n.encode() + b"\0" + points for i, p, c, n in images)
        (sparse / "images.bin").write_bytes(struct.pack("<Q", len(images)) + data)
        return
    rows = [f"{i} {model} {w} {h} {' '.join(map(repr, v))}" for i, _, w, h, v in lenses]
    (sparse / "cameras.txt").write_text("# Camera list\n" + "\n".join(rows) + "\n")
    rows = [f"{i} {' '.join(map(repr, p))} {c} {n}\n" for i, p, c, n in images]
    (sparse / "images.txt").write_text("# Image list\n" + "\n".join(rows) + "\n")


def write_easymocap(folder, cameras, rodrigues=False):
    """intri.yml and extri.yml as OpenCV writes them."""
    names = "names:\n" + "".join(f'   - "{camera["name"]}"\n' for camera in cameras)
    intrinsics, extrinsics = [names], [names]
    for camera in cameras:
        name = camera["name"]
        intrinsics += [_matrix(f"K_{name}", camera["K"]), _matrix(f"dist_{name}", camera["dist"][None])]
        intrinsics += [f"H_{name}: {camera['height']}\nW_{name}: {camera['width']}\n"]
        vector = Rotation.from_matrix(camera["R"]).as_rotvec()[:, None]
        extrinsics += [_matrix(f"R_{name}", vector) if rodrigues else _matrix(f"Rot_{name}", camera["R"])]
        extrinsics += [_matrix(f"T_{name}", camera["t"][:, None])]
    (folder / "intri.yml").write_text("%YAML:1.0\n---\n" + "".join(intrinsics))
    (folder / "extri.yml").write_text("%YAML:1.0\n---\n" + "".join(extrinsics))


def _matrix(name, value):
    rows, columns = value.shape
    data = ", ".join(repr(float(number)) for number in value.ravel())
    return f"{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: [ {data} ]\n"
