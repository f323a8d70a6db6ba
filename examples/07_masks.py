"""Make masks for footage and see how good they are: `python examples/07_masks.py [FOLDER]`.

`viewmend masks` writes a copy of a capture with masks. Here the footage is a studio's, whose true masks are known.
Films of people seldom come with an image of the empty scene, so the example computes one for each camera.
"""

import subprocess
import sys
from pathlib import Path

import numpy as np

from viewmend import Studio, StudioConfig, open_capture, write_capture, write_image


def write_plates(studio: Studio, folder: Path) -> None:
    """An image of the empty scene for each camera: the median over the frames, without the subject."""
    frames = [studio.read(time) for time in range(len(studio.frame_ids))]
    for view, name in enumerate(studio.cameras.names):
        images = np.stack([frame.rgb[view].movedim(0, -1).numpy() for frame in frames]).astype(float)
        covered = np.stack([frame.mask[view].numpy() > 0 for frame in frames])
        images[covered] = np.nan
        empty = np.nan_to_num(np.nanmedian(np.where(covered.all(0)[None, ..., None], 0.0, images), axis=0))
        write_image(folder / f"{name}.png", empty.astype(np.uint8))


def main(folder: Path, size_px: int = 256, frames: int = 3) -> float:
    """Mean intersection over union of the masks with the true ones."""
    studio = Studio(StudioConfig(seed=10002, cameras=4, frames=frames, size_px=size_px, background="stage"))
    write_capture(studio, folder / "footage", images="png")
    write_plates(studio, folder / "plates")
    command = [sys.executable, "-m", "viewmend", "masks", str(folder / "footage"), str(folder / "masked")]
    subprocess.run([*command, "--method", "plate", "--plate", str(folder / "plates")], check=True)
    found = open_capture(folder / "masked").read(0).mask > 127
    true = studio.read(0).mask > 127
    return float((found & true).sum() / (found | true).sum())


if __name__ == "__main__":
    print(f"IoU {main(Path(sys.argv[1] if len(sys.argv) > 1 else 'out/masks')):.3f}")
