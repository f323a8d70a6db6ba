"""Open a capture and complete a view of it: `python examples/01_mend_a_view.py [FOLDER]`."""

# %% Imports.
import sys
from pathlib import Path

import torch

from viewmend import (
    Stream,
    Studio,
    StudioConfig,
    load_inpainter,
    open_capture,
    prepare,
    write_capture,
    write_image,
)


def main(folder: Path, frames: int = 3, size_px: int = 256) -> Path:
    """Complete the first camera's view from the others; write rendered, completed and true images side by side."""
    # %% A capture is a folder in any supported format, with masks. If there is none, the studio makes a synthetic one.
    if not folder.exists():
        write_capture(Studio(StudioConfig(seed=10001, cameras=8, frames=frames, size_px=size_px)), folder)
    capture = open_capture(folder)
    print(f"{capture.name}: cameras {', '.join(capture.cameras.names)}, {len(capture.frame_ids)} frames")

    # %% Leave a camera out: its view is to be completed, and its image is the truth to compare with.
    times = range(min(frames, len(capture.frame_ids)))
    held = capture.read(times[-1]).cameras.names[0]
    inputs = [name for name in capture.cameras.names if name != held]
    capture = prepare(capture, inputs)  # aligned, resized, colours matched

    # %% A stream takes camera frames one by one and completes views from any camera.
    stream = Stream(load_inpainter("views"), bounds=capture.bounds)
    target = capture.cameras.select([held])
    viewer, seen = None, None
    for time in times:
        stream.add_frame(capture.read(time).without([held]))
        seen = stream.view(target, viewer)
        viewer = seen.viewer  # the state for this viewer's next view
    assert seen is not None

    # %% The result: the rendered view, its holes, and the completed view.
    view, completed = seen.completed.view, seen.completed.rgb
    print(f"coloured by {', '.join(view.source_views)}; {int(view.holes.sum())} pixels were missing")
    print(", ".join(f"{stage} {ms:.0f} ms" for stage, ms in vars(seen.times).items()))
    frame = capture.read(times[-1]).select([held])
    assert frame.mask is not None
    truth = frame.rgb[0] / 255 * (frame.mask[0] / 255)

    # %% Write a picture.
    picture = folder / "completed.png"
    row = torch.cat([view.rgb, completed, truth], 2).clamp(0, 1)
    write_image(picture, (row * 255).byte().movedim(0, -1).contiguous().numpy())
    print(f"wrote {picture}: rendered, completed, truth")
    return picture


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "out/lesson"))
