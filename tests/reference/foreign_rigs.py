"""Writers of the calibrations that come with videos, from the formats' own descriptions, for round trips."""

import numpy as np
from scipy.spatial.transform import Rotation


def write_toml(file, cameras, style="pose2sim"):
    """A calibration of Pose2Sim, of aniposelib or of Caliscope (its own, or of before)."""
    lines = []
    for index, camera in enumerate(cameras):
        rotation = Rotation.from_matrix(camera["R"]).as_rotvec()
        number = int(camera["name"].removeprefix("cam"))
        head = {"caliscope": f"cameras.{number}", "pyxy3d": f"cam_{number}"}.get(style, f"cam_{index}")
        lines += [f"[{head}]"]
        lines += [f"port = {number}"] if style in ("caliscope", "pyxy3d") else [f'name = "{camera["name"]}"']
        if style == "pyxy3d":
            rotation = camera["R"]
            lines += ["ignore = false"]
        size = (
            [float(camera["width"]), float(camera["height"])]
            if style == "pose2sim"
            else [camera["width"], camera["height"]]
        )
        dist = camera["dist"][:4] if style == "pose2sim" else camera["dist"]
        lines += [f"size = {size}", f"matrix = {camera['K'].tolist()}", f"distortions = {dist.tolist()}"]
        lines += [f"rotation = {np.asarray(rotation).tolist()}", f"translation = {camera['t'].tolist()}"]
        lines += ["fisheye = false"] if style == "pose2sim" else []
    lines += ["[metadata]", "adjusted = false", "error = 0.0"]
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text("\n".join(lines) + "\n")


def write_qualisys(file, cameras):
    """A `.qca.txt`: lengths on the sensor in 64ths of pixels, positions in millimetres, camera axes of OpenGL."""
    entries = []
    for camera in cameras:
        K, r = camera["K"] * 64, np.diag([1, -1, -1]) @ camera["R"]
        k1, k2, p1, p2, k3 = camera["dist"] * 64
        x, y, z = -1000 * camera["R"].T @ camera["t"]
        turn = " ".join(f'r{i + 1}{j + 1}="{float(r[i, j])!r}"' for i in range(3) for j in range(3))
        entries += [
            f'<camera active="1" serial="{camera["name"]}" viewrotation="0">'
            f'<fov_video bottom="{camera["height"] - 1}" left="0" right="{camera["width"] - 1}" top="0"/>'
            f'<transform {turn} x="{x!r}" y="{y!r}" z="{z!r}"/>'
            f'<intrinsic centerPointU="{K[0, 2]!r}" centerPointV="{K[1, 2]!r}" focalLengthU="{K[0, 0]!r}"'
            f' focalLengthV="{K[1, 1]!r}" skew="{K[0, 1]!r}" radialDistortion1="{k1!r}" radialDistortion2="{k2!r}"'
            f' radialDistortion3="{k3!r}" tangentalDistortion1="{p1!r}" tangentalDistortion2="{p2!r}"/></camera>'
        ]
    text = "\n".join(entries).replace("np.float64(", "").replace(')"', '"')
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(f"<?xml version='1.0'?>\n<calibration><cameras>{text}</cameras></calibration>\n")


def write_opencv(folder, cameras, style="folders"):
    """Files as OpenCV writes them: `CAMERA/config.xml` with short keys, or `calib/CAMERA.yml` with long ones."""
    import cv2

    long = style == "files"
    for camera in cameras:
        file = folder / (f"calib/{camera['name']}.yml" if long else f"{camera['name']}/config.xml")
        file.parent.mkdir(parents=True, exist_ok=True)
        rotation = camera["R"] if long else Rotation.from_matrix(camera["R"]).as_rotvec()[:, None]
        storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_WRITE)
        storage.write("camera_matrix" if long else "CameraMatrix", camera["K"])
        storage.write("distortion_coefficients" if long else "DistortionCoeffs", camera["dist"][:, None])
        storage.write("rotation_matrix" if long else "Rotation", rotation)
        storage.write("translation_vector" if long else "Translation", camera["t"][:, None])
        if long:
            storage.write("image_width", camera["width"])
            storage.write("image_height", camera["height"])
        storage.release()
