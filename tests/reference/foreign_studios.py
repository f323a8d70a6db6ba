"""Writers of published data sets' folders, from the formats' own descriptions, for round trips."""

import csv
import json
import pickle

import cv2
import numpy as np
from reference.foreign_formats import write_easymocap
from scipy.spatial.transform import Rotation


def world_from_camera(camera):
    return np.linalg.inv(np.vstack([np.c_[camera["R"], camera["t"]], [0, 0, 0, 1]]))


def write_take(folder, rig, frames, gaps, image, mask, foreground=255):
    """Every camera's images, each camera's a brightness of its own, and masks with a corner of background.

    `image` and `mask` are paths of {c}, the camera's name, and {f}, the frame; or functions of camera and frame.
    """
    for number, camera in enumerate(rig):
        size = camera["height"], camera["width"]
        for frame in frames:
            if (camera["name"], frame) in gaps:
                continue
            full = np.full(size, foreground, np.uint8)
            full[-2:, -2:] = 0
            for path, pixels in (
                (image, np.full((*size, 3), 60 + 20 * (number % 9), np.uint8)),
                (mask, full),
            ):
                own = path.format(c=camera["name"], f=frame) if isinstance(path, str) else path(camera, frame)
                file = folder / own
                file.parent.mkdir(parents=True, exist_ok=True)
                cv2.imwrite(str(file), pixels)


def write_zju(folder, rig, frames, gaps=(), stamps=False, arrays=False, protocol=2):
    """annots.npy as NeuralBody reads it; `stamps` as in sequences 313 and 315, `arrays` with one array of all K."""

    def image(camera, frame):
        if stamps:
            stem = f"CoreView_313_{camera['name']}_{frame}_2019-08-23_16-08-{int(frame[-4:]):02d}.592"
            return f"{camera['name']}/{stem}.jpg"
        return f"{camera['name']}/{frame}.jpg"

    def mask(camera, frame):
        return f"mask_cihp/{image(camera, frame).removesuffix('.jpg')}.png"

    write_take(folder, rig, frames, gaps, image, mask, foreground=7)
    cams = {"K": [c["K"] for c in rig], "D": [c["dist"][:, None] for c in rig], "R": [c["R"] for c in rig]}
    cams["T"] = [1000 * c["t"][:, None] for c in rig]
    if arrays:
        cams = {key: np.array(values) for key, values in cams.items()}
    ims = [{"ims": [image(c, f) for c in rig], "kpts2d": np.zeros((len(rig), 25, 3))} for f in frames]
    save_object(folder / "annots.npy", {"cams": cams, "ims": ims}, protocol)


def write_genebody(folder, rig, frames, gaps=(), protocol=4):
    write_take(folder, rig, frames, gaps, "image/{c}/{f}.jpg", "mask/{c}/mask{f}.png")
    cams = {}
    for camera in rig:
        c2w = world_from_camera(camera)
        cams[camera["name"]] = {"K": camera["K"], "D": camera["dist"], "c2w": c2w}
        cams[camera["name"]] |= {"c2w_R": c2w[:3, :3], "c2w_T": c2w[:3, 3:]}
    save_object(folder / "annots.npy", {"cams": cams}, protocol)


def save_object(file, value, protocol):
    """What np.save writes of an object, with that protocol and, as of old, numpy's former name of its core."""
    array = np.empty((), object)
    array[()] = value
    data = pickle.dumps(array, protocol)
    if protocol < 4:
        data = data.replace(b"numpy._core.", b"numpy.core.")
    header = b"{'descr': '|O', 'fortran_order': False, 'shape': (), }"
    header += b" " * (-(len(header) + 11) % 64) + b"\n"
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + data)


def write_mvhumannet(folder, rig, frames, gaps=(), scale=120 / 65, full=(4096, 3000)):
    """The K of the first camera, of images of the full size, is that of all; lengths become metres by the scale."""
    write_take(folder, rig, frames, gaps, "images/{c}/{f}_img.jpg", "fmask/{c}/{f}_img_fmask.png")
    K = rig[0]["K"].copy()
    K[:2] *= full[0] / rig[0]["width"]
    K[:2, 2] -= 0.5
    (folder / "camera_intrinsics.json").write_text(json.dumps({"intrinsics": K.tolist(), "dist": []}))
    poses = {}
    for camera in rig:
        t = camera["t"] * 1000 / scale
        pose = {"rotation": camera["R"].tolist(), "translation": t.tolist()}
        poses[f"1_{camera['name']}.png"] = pose | {"camera_pos": (-camera["R"].T @ t).tolist()}
    (folder / "camera_extrinsics.json").write_text(json.dumps(poses))
    (folder / "camera_scale.pkl").write_bytes(pickle.dumps(scale))


def write_actorshq(folder, rig, frames, gaps=(), scale="4x", boxes=None):
    write_take(folder / scale, rig, frames, gaps, "rgbs/{c}/{c}_rgb{f}.jpg", "masks/{c}/{c}_mask{f}.png")
    rows = [["name", "w", "h", "rx", "ry", "rz", "tx", "ty", "tz", "fx", "fy", "px", "py"]]
    for camera in rig:
        w, h, K = camera["width"], camera["height"], camera["K"]
        turn = Rotation.from_matrix(camera["R"].T).as_rotvec()
        numbers = [
            *turn,
            *world_from_camera(camera)[:3, 3],
            K[0, 0] / w,
            K[1, 1] / h,
            K[0, 2] / w,
            K[1, 2] / h,
        ]
        rows.append([camera["name"], w, h, *(repr(float(n)) for n in numbers)])
    _write_table(folder / scale / "calibration.csv", rows)
    if boxes is not None:
        head = ["frame", *(f"aabb_{end}_{axis}" for end in ("min", "max") for axis in "xyz")]
        _write_table(folder / "aabbs.csv", [head, *([time, *box] for time, box in enumerate(boxes))])


def _write_table(file, rows):
    with file.open("w", newline="") as stream:
        csv.writer(stream).writerows(rows)


def write_panoptic(folder, rig, frames, gaps=(), kind="hd"):
    write_take(folder, rig, frames, gaps, kind + "Imgs/{c}/{c}_{f}.jpg", "masks/{c}/{c}_{f}.png")
    cameras = []
    for camera in rig:
        entry = {"name": camera["name"], "type": kind, "resolution": [camera["width"], camera["height"]]}
        entry |= {
            "panel": int(camera["name"][:2]),
            "node": int(camera["name"][3:]),
            "K": camera["K"].tolist(),
        }
        entry |= {"distCoef": camera["dist"].tolist(), "R": camera["R"].tolist()}
        cameras.append(entry | {"t": (100 * camera["t"][:, None]).tolist()})
    cameras.append(cameras[0] | {"name": "50_01", "type": "kinect-color"})
    text = json.dumps({"calibDataSource": "160422_calib_norm", "cameras": cameras})
    (folder / "calibration_160422_ultimatum1.json").write_text(text)


def write_easyvolcap(folder, rig, frames, gaps=(), bounds=None, quoted=True):
    """As write_easymocap, with bounds, near and far of each camera; names without quotes are numbers to YAML."""
    write_take(folder, rig, frames, gaps, "images/{c}/{f}.jpg", "masks/{c}/{f}.png")
    write_easymocap(folder, rig)
    extra = []
    for camera in rig:
        name = camera["name"]
        extra.append(f"t_{name}: 0.\nn_{name}: 1.\nf_{name}: 9.\n")
        if bounds is not None:
            data = ", ".join(repr(float(n)) for n in np.ravel(bounds))
            extra.append(
                f"bounds_{name}: !!opencv-matrix\n   rows: 2\n   cols: 3\n   dt: d\n   data: [ {data} ]\n"
            )
    with (folder / "extri.yml").open("a") as file:
        file.write("".join(extra))
    if not quoted:
        for name in ("intri.yml", "extri.yml"):
            text = (folder / name).read_text()
            (folder / name).write_text(text.replace('- "', "- ").replace('"\n', "\n"))


def write_dna(folder, rig, frames, gaps=(), apart=False, colours=None, name="0012_11"):
    """A pair of .smc files; cameras below 48 are of 5 megapixels. `apart` puts them into two folders, as published."""
    import h5py

    places = [folder / "part1_main", folder / "part1_annotations"] if apart else [folder, folder]
    for place in places:
        place.mkdir(parents=True, exist_ok=True)
    with (
        h5py.File(places[0] / f"{name}.smc", "w") as main,
        h5py.File(places[1] / f"{name}_annots.smc", "w") as annots,
    ):
        main.attrs["actor_id"] = name[:4]
        for number, camera in enumerate(rig):
            cam = int(camera["name"])
            size = camera["height"], camera["width"]
            parameters = annots.create_group(f"Camera_Parameter/{cam:02d}")
            parameters["K"], parameters["D"] = camera["K"], camera["dist"]
            parameters["RT"] = world_from_camera(camera)
            if colours is not None:
                parameters["Color_Calibration"] = colours[number]
            full = np.full((*size, 3), 255, np.uint8)
            full[-2:, -2:] = 0
            pixels = np.full((*size, 3), 60 + 20 * (number % 9), np.uint8)
            for frame in frames:
                if (camera["name"], frame) in gaps:
                    continue
                group = "Camera_5mp" if cam < 48 else "Camera_12mp"
                main[f"{group}/{cam}/color/{frame}"] = cv2.imencode(".jpg", pixels)[1].ravel()
                annots[f"Mask/{cam}/mask/{frame}"] = cv2.imencode(".png", full)[1].ravel()
    return places[0] / f"{name}.smc"


def write_riftcast(folder, rig, frames, gaps=(), meta=None):
    """calibration.json, images, and masks as run lengths, by the plainest of loops; `meta` as meta.json."""
    write_take(folder, rig, frames, gaps, "frame_{f}/rgb/rgb_{c}.png", "frame_{f}/mask/mask_{c}.png")
    for png in folder.glob("frame_*/mask/*.png"):
        runs, before = [], None
        values = (cv2.imread(str(png), cv2.IMREAD_GRAYSCALE) > 0).ravel().tolist()
        for at, value in enumerate(values):
            if value != before:
                runs.append(at)
            before = value
        np.array([int(values[0]), *runs[1:], len(values)], "<i4").tofile(png.with_suffix(".bin"))
        png.unlink()
    for png in folder.glob("frame_*/rgb/*.png"):
        cv2.imwrite(str(png.with_suffix(".jpeg")), cv2.imread(str(png)))
        png.unlink()
    cameras = []
    for camera in rig:
        view = np.vstack([np.c_[camera["R"], camera["t"]], [0, 0, 0, 1]])
        lens = {
            "camera_matrix": camera["K"].ravel().tolist(),
            "resolution": [camera["width"], camera["height"]],
        }
        entry = {"camera_id": int(camera["name"]), "camera_model_name": "a camera", "intrinsics": lens}
        cameras.append(entry | {"extrinsics": {"view_matrix": view.ravel().tolist()}})
    (folder / "calibration.json").write_text(json.dumps({"cameras": cameras}))
    if meta is not None:
        (folder / "meta.json").write_text(meta)
