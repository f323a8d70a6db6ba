"""IoU of masks from `viewmend masks` with a capture's own: python benchmarks/masks.py CAPTURE MASKED."""

import argparse
import json
from pathlib import Path

import numpy as np

from viewmend.data.capture_folder import open_capture


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
        assert found.mask is not None and right.mask is not None
        for view, name in enumerate(found.cameras.names):
            width, height = found.cameras.size_px[view].tolist()
            a = found.mask[view, :height, :width].numpy() > 127
            b = right.mask[right.cameras.names.index(name), :height, :width].numpy() > 127
            scores.setdefault(name, []).append(float((a & b).sum() / max((a | b).sum(), 1)))
    means = {name: round(float(np.mean(own)), 3) for name, own in scores.items()}
    lowest = round(min(min(own) for own in scores.values()), 3)
    print(
        json.dumps(
            {"mean": round(float(np.mean(list(means.values()))), 3), "lowest": lowest, "cameras": means}
        )
    )


if __name__ == "__main__":
    main()
