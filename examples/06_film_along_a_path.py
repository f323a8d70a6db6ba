"""Film a capture along a path of your own: `python examples/06_film_along_a_path.py [OUT.mp4]`.

`viewmend mend CAPTURE --path orbit` films an orbit. A path is any sequence of cameras: here one that rises while the
subject moves.
"""

import math
import sys
from pathlib import Path

import av
import torch

from viewmend import Cameras, Stream, Studio, StudioConfig, load_inpainter, look_at, pinhole

CENTER_M = torch.tensor([0.0, 0.95, 0.0])
UP = torch.tensor([0.0, 1.0, 0.0])


def camera_at(share: float, size_px: int) -> Cameras:
    """The camera after this share of the path, from 0 to 1."""
    azimuth = 0.2 + 0.8 * share
    eye = torch.tensor([3.0 * math.sin(azimuth), 1.0 + share, 3.0 * math.cos(azimuth)])
    return pinhole(0.8, size_px, size_px, look_at(eye, CENTER_M, UP))


def main(out: Path, frames: int = 30, size_px: int = 256) -> None:
    """Complete one view per frame and encode them as H.264."""
    studio = Studio(StudioConfig(seed=10001, cameras=8, frames=frames, size_px=size_px))
    stream = Stream(load_inpainter("views"), bounds=studio.bounds)
    viewer = None
    out.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(out), "w") as film:
        video = film.add_stream("libx264", rate=30, options={"crf": "16"})
        video.width = video.height = size_px
        video.pix_fmt = "yuv420p"
        for time in range(frames):
            stream.add_frame(studio.read(time))
            seen = stream.view(camera_at(time / max(frames - 1, 1), size_px), viewer)
            viewer = seen.viewer
            rgb = (seen.completed.rgb.clamp(0, 1) * 255).byte().movedim(0, -1).contiguous().numpy()
            film.mux(video.encode(av.VideoFrame.from_ndarray(rgb, format="rgb24")))
        film.mux(video.encode())


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "out/film.mp4"))
