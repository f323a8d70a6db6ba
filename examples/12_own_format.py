"""Read a capture format of your own: `python examples/12_own_format.py FOLDER` makes a format's folder readable.

The format here has a text file per camera, `rig/CAMERA.txt`, with a line `width height focal` and the 3 x 4 pose
world_from_camera in centimetres; images are `shots/CAMERA/*.png`, masks `mattes/CAMERA/*.png`. A reader is two
functions: `find` recognises a folder, `content` returns what a `cameras.json` would contain (docs/capture-format.md).
"""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from viewmend import open_capture


def find(folder: Path) -> Path | None:
    """The file that identifies the format: the first camera's; None if this is another format."""
    return next(iter(sorted(folder.glob("rig/*.txt"))), None)


def content(folder: Path, file: Path) -> dict[str, Any]:
    """The cameras and frames; a ValueError says what is expected and what was found."""
    cameras = [_camera(path) for path in sorted(file.parent.glob("*.txt"))]
    first = cameras[0]["name"]
    frames = sorted(path.stem for path in folder.glob(f"shots/{first}/*.png"))
    return {"first_pixel_center": [0.5, 0.5], "metres_per_unit": 0.01, "frames": frames, "cameras": cameras}


def _camera(path: Path) -> dict[str, Any]:
    numbers = [float(word) for word in path.read_text(encoding="utf-8").split()]
    if len(numbers) != 15:
        raise ValueError(f"expected 15 numbers in {path.name}, got {len(numbers)}; write the file again")
    width, height, focal = numbers[:3]
    world_from_camera = np.array(numbers[3:]).reshape(3, 4)
    R = world_from_camera[:, :3].T
    return {
        "name": path.stem,
        "width": int(width),
        "height": int(height),
        "K": [[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]],
        "R": R.tolist(),
        "t": (-R @ world_from_camera[:, 3]).tolist(),
        "image": f"shots/{path.stem}/{{frame}}.png",
        "mask": f"mattes/{path.stem}/{{frame}}.png",
    }


def main(folder: Path) -> None:
    """Write the folder's `cameras.json`, with which every command reads it."""
    file = find(folder)
    if file is None:
        raise SystemExit(f"{folder}: expected rig/CAMERA.txt, found none")
    text = json.dumps({"format": "plain-capture/1", **content(folder, file)})
    (folder / "cameras.json").write_text(text, encoding="utf-8")
    print(", ".join(open_capture(folder).cameras.names))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
