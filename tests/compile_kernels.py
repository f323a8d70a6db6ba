"""Compile all of numba's kernels, so that no test and no second process has to: `python tests/compile_kernels.py`."""

import torch

from viewmend.models.checkpoint import load_inpainter
from viewmend.rendering.view import RenderConfig
from viewmend.stream import Stream, StreamConfig
from viewmend.studio.stage import Studio, StudioConfig


def main() -> None:
    """Complete one small view of the studio's with the default model."""
    torch.set_num_threads(1)
    studio = Studio(StudioConfig(cameras=5, frames=1, size_px=96, background="stage"))
    frame = studio.read(0)
    held = frame.cameras.names[0]
    stream = Stream(
        load_inpainter("views"), StreamConfig(render=RenderConfig(error_rule="all")), studio.bounds
    )
    stream.add_frame(frame.without([held]))
    stream.view(frame.cameras.select([held]))


if __name__ == "__main__":
    main()
