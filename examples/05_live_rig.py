"""Push a live rig's frames from Python: `python examples/05_live_rig.py [ws://127.0.0.1:8008] [TOKEN]`.

`viewmend serve live` in another terminal receives them, and its page follows the rig. Here a studio stands in for the
cameras.
"""

import sys
import time

from viewmend import MultiViewFrame, Publisher, Studio, StudioConfig

FPS = 5.0


def camera_images(studio: Studio, index: int) -> MultiViewFrame:
    """The rig's images at one moment: undistorted, with masks. Replace this by your cameras."""
    return studio.read(index % len(studio.frame_ids))


def main(url: str, token: str | None = None, count: int = 100, size_px: int = 256) -> int:
    """Push `count` frames in real time; the number of frames that the server has."""
    studio = Studio(StudioConfig(cameras=6, frames=10, fps=FPS, size_px=size_px))
    last = -1
    with Publisher(
        studio.cameras, url, token, fps=FPS, name=studio.name, up=studio.up, bounds=studio.bounds
    ) as rig:
        start = time.monotonic()
        for index in range(count):
            last = rig.push(camera_images(studio, index))
            time.sleep(max(0.0, start + (index + 1) / FPS - time.monotonic()))
    return last + 1


if __name__ == "__main__":
    address = sys.argv[1] if len(sys.argv) > 1 else "ws://127.0.0.1:8008"
    print(f"pushed {main(address, sys.argv[2] if len(sys.argv) > 2 else None)} frames")
