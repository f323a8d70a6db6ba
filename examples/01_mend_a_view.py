"""A first lesson: open a capture in Python, and mend a view. `python examples/01_mend_a_view.py [FOLDER]`."""

# %% What you need: a capture, and an inpainter.
import sys
from pathlib import Path

import torch

from viewmend import Stream, load_inpainter, open_capture, prepare
from viewmend.capture.images import write_image
from viewmend.capture.plain_writer import write_capture
from viewmend.studio.stage import Studio, StudioConfig


def main(folder: Path, frames: int = 3, size_px: int = 256) -> Path:
    """Mend the view of the first camera, left out, and write rendered, mended and true images beside one another."""
    # %% A capture is a folder with a cameras.json. Without one of your own, the studio makes one, with people.
    if not (folder / "cameras.json").exists():
        write_capture(Studio(StudioConfig(seed=10001, cameras=8, frames=frames, size_px=size_px)), folder)
    capture = open_capture(folder)
    print(f"{capture.name}: cameras {', '.join(capture.cameras.names)}, {len(capture.frame_ids)} frames")

    # %% Leave a camera out: its view is what we want to see, and its image is the truth to compare with.
    held, *inputs = capture.cameras.names
    capture = prepare(capture, inputs)  # a shift of all images against the calibration is undone

    # %% A stream takes what the cameras see, time by time, and shows it from anywhere.
    stream = Stream(load_inpainter("small"), bounds=capture.bounds)
    target = capture.cameras.select([held])
    viewer, seen = None, None
    for time in range(frames):
        stream.push(capture.read(time).without([held]))
        seen = stream.view(target, viewer)
        viewer = seen.viewer  # what this viewer carries to its next view
    assert seen is not None

    # %% What came out: the rendered view, what is missing in it, and the completed view.
    view, completed = seen.completed.view, seen.completed.rgb
    print(f"coloured by {', '.join(view.source_views)}; {int((view.error > 0).sum())} pixels were missing")
    print(", ".join(f"{stage} {ms:.0f} ms" for stage, ms in vars(seen.times).items()))
    frame = capture.read(frames - 1).select([held])
    assert frame.mask is not None
    truth = frame.rgb[0] / 255 * (frame.mask[0] / 255)

    # %% Look at it.
    picture = folder / "mended.png"
    row = torch.cat([view.rgb, completed, truth], 2).clamp(0, 1)
    write_image(picture, (row * 255).byte().movedim(0, -1).contiguous().numpy())
    print(f"wrote {picture}: rendered, mended, truth")
    return picture


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "out/lesson"))
