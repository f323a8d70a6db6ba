"""Rigs of random cameras, for round trips through the formats of others."""

import itertools

import cv2
import numpy as np
from hypothesis import settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

RIGS = settings(max_examples=25, deadline=None, database=None, derandomize=True)
TAKES = settings(RIGS, max_examples=10)
"""Rigs whose images are read, too."""
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
        camera |= {
            "R": Rotation.random(random_state=seed + int(number)).as_matrix(),
            "t": rng.uniform(-5, 5, 3),
        }
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
            path = folder / (
                f"{stream}/{camera['name']}/{frame}.png" if frame else f"{stream}/{camera['name']}.png"
            )
            path.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(path), np.full((camera["height"], camera["width"], 3), value, np.uint8))


def assert_same(calibration, rig):
    """The calibration, or the capture's, is that of the rig."""
    cameras = getattr(calibration, "_native_cameras", calibration.cameras)
    assert [camera.name for camera in cameras] == [camera["name"] for camera in rig]
    for read, camera in zip(cameras, rig, strict=True):
        assert (read.width, read.height) == (camera["width"], camera["height"])
        for key, value in (("K", read.K), ("R", read.R), ("t", read.t_m), ("dist", read.dist)):
            np.testing.assert_allclose(value, camera[key], rtol=1e-9, atol=1e-9, err_msg=key)


def named(rig, pattern):
    """The rig with other names, of the cameras' own numbers."""
    return [camera | {"name": pattern.format(int(camera["name"][3:]))} for camera in rig]


def random_take(seed, rig, pattern):
    """Ids of some frames, not all one after the other, and gaps; at least every other frame has none."""
    rng = np.random.default_rng(seed + 1)
    count = int(rng.integers(1, 5))
    frames = [pattern.format(n) for n in sorted(int(n) for n in rng.choice(40, count, replace=False))]
    keep = set(zip(itertools.cycle(c["name"] for c in rig), frames, strict=False))
    keep |= {(camera["name"], frame) for camera in rig for frame in frames[::-2]}
    every = [(camera["name"], frame) for camera in rig for frame in frames]
    return frames, {pair for pair in every if pair not in keep and rng.random() < 0.3}


def assert_take(capture, rig, frames, gaps, ids=None):
    """Frames, gaps, pixels and masks are those that `write_take` wrote."""
    ids = list(ids or frames)
    assert list(capture.frame_ids) == ids
    assert set(capture.gaps) == {(camera, ids[frames.index(frame)]) for camera, frame in gaps}
    for time, frame in enumerate(frames):
        read = capture.read(time)
        there = [(n, c) for n, c in enumerate(rig) if (c["name"], frame) not in gaps]
        assert read.cameras.names == tuple(camera["name"] for _, camera in there)
        for view, (number, camera) in enumerate(there):
            width, height = camera["width"], camera["height"]
            assert abs(read.rgb[view, :, :height, :width].float() - 60 - 20 * number).max() <= 3
            mask = read.mask[view, :height, :width]
            assert int(mask.max()) == 255
            if not camera["dist"].any():
                assert int((mask < 128).sum()) == 4
