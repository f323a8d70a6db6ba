"""A capture folder small enough to break in every way: four cameras round a ball, two frames."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from reference.ball import photograph
from reference.computed_once import carve_once

from viewmend.geometry.cameras import Cameras, concatenate_cameras, pinhole
from viewmend.geometry.rigid import look_at

WIDTH, HEIGHT, NAMES, FRAMES = 40, 32, ("a", "b", "c", "d"), ("000", "001")


def ring() -> Cameras:
    """Four cameras, two metres from a ball of 0.5 m, not quite at the same height."""
    poses = []
    for view in range(4):
        angle = torch.tensor(view * 1.6)
        eye = torch.stack([2 * angle.cos(), torch.tensor(0.3 * view), 2 * angle.sin()])
        poses.append(
            pinhole(
                0.7, WIDTH, HEIGHT, look_at(eye, torch.zeros(3), torch.tensor([0.0, 1.0, 0.0])), NAMES[view]
            )
        )
    return concatenate_cameras(poses)


class PlainFolder:
    """A valid capture on disk and the means to spoil it."""

    def __init__(self, path: Path):
        self.path = path
        cameras = ring()
        masks = photograph(cameras).mask.numpy()
        rng = np.random.default_rng(0)
        self.description = {
            "format": "plain-capture/1",
            "first_pixel_center": [0.5, 0.5],
            "up": [0, 2, 0],
            "fps": 25,
            "bounds": [[-1, -1, -1], [1, 1, 1]],
            "frames": list(FRAMES),
            "cameras": [
                {
                    "name": name,
                    "width": WIDTH,
                    "height": HEIGHT,
                    "K": cameras.K[view].double().tolist(),
                    "R": cameras.camera_from_world[view, :3, :3].double().tolist(),
                    "t": cameras.camera_from_world[view, :3, 3].double().tolist(),
                    "image": f"images/{name}_{{frame}}.png",
                    "mask": f"masks/{name}_{{frame}}.png",
                }
                for view, name in enumerate(NAMES)
            ],
        }
        for view, name in enumerate(NAMES):
            for frame in FRAMES:
                self.put(
                    f"images/{name}_{frame}.png", rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
                )
                self.put(f"masks/{name}_{frame}.png", masks[view])
        self.save()

    def put(self, file: str, image: np.ndarray) -> None:
        (self.path / file).parent.mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(self.path / file), image)

    def get(self, file: str) -> np.ndarray:
        return cv2.imread(str(self.path / file), cv2.IMREAD_UNCHANGED)

    def edit(self, change: Callable[[dict], object]) -> "PlainFolder":
        change(self.description)
        self.save()
        return self

    def save(self) -> None:
        (self.path / "cameras.json").write_text(json.dumps(self.description))

    def put_video(self, file: str, frames: list[np.ndarray]) -> None:
        (self.path / file).parent.mkdir(parents=True, exist_ok=True)
        size = frames[0].shape[1::-1]
        writer = cv2.VideoWriter(str(self.path / file), cv2.VideoWriter_fourcc(*"MJPG"), 25, size)
        for frame in frames:
            writer.write(frame)
        writer.release()


@pytest.fixture(autouse=True)
def _carved_once(monkeypatch):
    """Hulls of equal masks are carved once, not in each test: many tests change images alone."""
    carve_once(monkeypatch, coarsely=True)


@pytest.fixture
def plain(tmp_path: Path) -> PlainFolder:
    return PlainFolder(tmp_path / "ball")
