"""Rigs of random cameras, for round trips through the formats of others."""

import cv2
import numpy as np
from hypothesis import settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

RIGS = settings(max_examples=25, deadline=None, database=None, derandomize=True)
SEEDS, COUNTS = st.integers(0, 2**20), st.integers(2, 6)


def random_rig(seed, count, distorted=5):
    """Cameras as plain dicts; K in the convention of this project (first pixel's centre at 0.5)."""
    rng = np.random.default_rng(seed)
    rig = []
    for number in np.sort(rng.choice(90, count, replace=False)):
        width, height = (int(n) for n in rng.integers(8, 40, 2))
        fx, fy = rng.uniform(10, 5000, 2)
        dist = np.zeros(5)
        dist[:distorted] = rng.uniform(-0.3, 0.3, distorted)
        camera = {"name": f"cam{number:02d}", "width": width, "height": height, "dist": dist}
        camera["K"] = np.array([[fx, 0, rng.uniform(1, 30)], [0, fy, rng.uniform(1, 30)], [0, 0, 1]])
        camera |= {"R": Rotation.random(random_state=seed + int(number)).as_matrix(), "t": rng.uniform(-5, 5, 3)}
        rig.append(camera | {"image": f"images/{camera['name']}.png", "mask": f"masks/{camera['name']}.png"})
    return rig


def opencv(rig):
    """The rig in OpenCV's convention: the first pixel has its centre at 0."""
    return [camera | {"K": camera["K"] - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])} for camera in rig]


def write_videos(folder, rig, frames=3, name="{}"):
    """A video of each camera, which gets brighter with time."""
    folder.mkdir(parents=True, exist_ok=True)
    for camera in rig:
        size = camera["width"], camera["height"]
        path = str(folder / f"{name.format(camera['name'])}.avi")
        video = cv2.VideoWriter(path, cv2.VideoWriter.fourcc(*"MJPG"), 25.0, size)
        for time in range(frames):
            video.write(np.full((*size[::-1], 3), 40 * time, np.uint8))
        video.release()


def write_images(folder, rig, frame=None):
    for camera in rig:
        for stream, value in (("images", 90), ("masks", 255)):
            path = folder / (f"{stream}/{camera['name']}/{frame}.png" if frame else f"{stream}/{camera['name']}.png")
            path.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(path), np.full((camera["height"], camera["width"], 3), value, np.uint8))


def assert_same(calibration, rig):
    assert [camera.name for camera in calibration.cameras] == [camera["name"] for camera in rig]
    for read, camera in zip(calibration.cameras, rig, strict=True):
        assert (read.width, read.height) == (camera["width"], camera["height"])
        for key, value in (("K", read.K), ("R", read.R), ("t", read.t_m), ("dist", read.dist)):
            np.testing.assert_allclose(value, camera[key], rtol=1e-9, atol=1e-9, err_msg=key)
