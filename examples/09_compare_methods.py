"""Score methods on a camera that they do not see: `python examples/09_compare_methods.py [METHOD ...]`.

`viewmend evaluate` does this for whole test sets with all metrics. A method is a registered name, a folder with
weights, or `FILE.py:NAME`.
"""

import math
import sys

import torch

from viewmend import MultiViewFrame, Stream, Studio, StudioConfig, make_method


def psnr_db(image: torch.Tensor, truth: MultiViewFrame) -> float:
    """PSNR of an image (3, height, width) on black over the pixels of the subject."""
    mask = truth.mask[0] / 255
    error = (image - truth.rgb[0] / 255 * mask).square().mean(0)[mask > 0]
    return -10 * math.log10(float(error.mean()))


def main(methods: list[str], frames: int = 2, size_px: int = 256) -> dict[str, float]:
    """Mean PSNR of each method over the frames of one scene, whose second camera is left out."""
    studio = Studio(StudioConfig(seed=10004, cameras=6, frames=frames, size_px=size_px))
    held = studio.cameras.names[1]
    target = studio.cameras.select([held])
    scores = {}
    for method in methods:
        stream = Stream(make_method(method), bounds=studio.bounds)
        viewer = None
        found = []
        for time in range(frames):
            stream.add_frame(studio.read(time).without([held]))
            seen = stream.view(target, viewer)
            viewer = seen.viewer
            found.append(psnr_db(seen.completed.rgb, studio.truth(target, time)))
        scores[method] = sum(found) / len(found)
    return scores


if __name__ == "__main__":
    for name, score in main(sys.argv[1:] or ["telea", "views"]).items():
        print(f"{name}: {score:.2f} dB")
