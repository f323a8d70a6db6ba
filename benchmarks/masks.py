"""IoU of masks from `viewmend masks` with a capture's own: python benchmarks/masks.py CAPTURE MASKED.

Images whose camera is absent from CAPTURE, and those without a subject in either mask, are left out.
"""

import argparse
import json
from pathlib import Path

import numpy as np

from viewmend.data.capture_folder import open_capture
from viewmend.metrics.image_quality import mask_iou
from viewmend.types import MultiViewFrame


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("capture", type=Path, help="a capture with its own masks")
    parser.add_argument("masked", type=Path, help="the capture written by viewmend masks")
    options = parser.parse_args()
    truth = open_capture(options.capture)
    made = open_capture(options.masked)
    scores: dict[str, list[float]] = {}
    for time, frame_id in enumerate(made.frame_ids):
        found, right = made.read(time), truth.read(truth.frame_ids.index(frame_id))
        for name, score in overlaps(found, right).items():
            scores.setdefault(name, []).append(score)
    means = {name: round(float(np.mean(own)), 3) for name, own in scores.items()}
    lowest = round(min(min(own) for own in scores.values()), 3)
    print(
        json.dumps(
            {"mean": round(float(np.mean(list(means.values()))), 3), "lowest": lowest, "cameras": means}
        )
    )


def overlaps(found: MultiViewFrame, right: MultiViewFrame) -> dict[str, float]:
    """IoU of the masks of each camera that both frames have; none where both masks are empty."""
    scores = {}
    for name in found.cameras.names:
        if name in right.cameras.names:
            a, b = found.select([name]), right.select([name])
            assert a.mask is not None and b.mask is not None
            width, height = a.cameras.max_size_px
            score = mask_iou(*(own.mask[0, :height, :width] > 127 for own in (a, b)))
            if score is not None:
                scores[name] = score
    return scores


if __name__ == "__main__":
    main()
