"""A rig of six cameras around the ball, as videos that are played as if they were live."""

from pathlib import Path

import numpy as np
from reference.ball import BallCapture, ring
from reference.films import write_film_capture

from viewmend.data.images import write_image

CAMERAS = ring(6)


def rig_text(names=CAMERAS.names, **changes: str | None) -> str:
    """A rig's TOML; values are TOML, None leaves a key out."""
    keys = {"calibration": '"take"', "fps": "10"} | changes
    lines = [f"{key} = {value}" for key, value in keys.items() if value is not None]
    lines += ["[mask]", 'method = "plate"']
    for name in names:
        lines += ["[[cameras]]", f'name = "{name}"', f'url = "take/video/{name}.mp4"']
    return "\n".join(lines) + "\n"


def make_rig(folder: Path) -> Path:
    """The rig's file, beside it calibration, videos of eight frames, and clean plates."""
    write_film_capture(BallCapture(CAMERAS, 8), folder / "take")
    for name in CAMERAS.names:
        write_image(folder / f"plates/{name}.png", np.zeros((48, 48, 3), np.uint8))
    (folder / "rig.toml").write_text(rig_text())
    return folder / "rig.toml"
