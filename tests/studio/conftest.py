"""Files of a tiny performer."""

from pathlib import Path

import pytest
from studio.tiny_performer import write_character, write_motion


@pytest.fixture
def character_file(tmp_path) -> Path:
    return write_character(tmp_path / "sticks.glb")


@pytest.fixture
def motion_file(tmp_path) -> Path:
    return write_motion(
        tmp_path / "wave.bvh",
        {
            "Hips": (10, 20, 40),
            "lowerback": (5, -15, 20),
            "LeftShoulder": (80, 10, -30),
            "LeftElbow": (20, 0, 50),
            "RightHip": (0, -50, 10),
            "RightKnee": (3, 60, 0),
        },
    )
