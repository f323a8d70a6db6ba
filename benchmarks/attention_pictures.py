"""What a missing patch looks at: python benchmarks/attention_pictures.py SHARDS OUT.png MODEL ... [--windows N].

SHARDS is a folder of `viewmend samples windows --matches`. One row a window and model: the window, what is missing in
black and one missing patch framed; then each camera at the window's own time, brighter where the guided block of the
model looks from that patch, the patches that truly show its surface framed.
"""

import argparse
from pathlib import Path
from unittest.mock import patch

import cv2
import numpy as np
import torch
from torch import Tensor

from viewmend.capture.images import write_image
from viewmend.contact_sheet import Tile, contact_sheet, picture
from viewmend.inpainting import patch_transformer as steps
from viewmend.inpainting.checkpoint import load_network
from viewmend.inpainting.correspondences import AttentionGuide
from viewmend.inpainting.images import target_images
from viewmend.inpainting.patch_transformer import PatchTransformer
from viewmend.inpainting.patches import PATCH_PX, STEP_PX, any_in_patch
from viewmend.training.sample_files import read_shard, shards_of
from viewmend.training.samples import Sample

FRAME = {"query": (255, 0, 0), "true": (0, 255, 0)}
DIM = 0.35
"""How bright a camera's image is where nothing looks."""


class Recorded(AttentionGuide):
    """A guide that keeps the attention itself."""

    kept: Tensor
    last: "Recorded"

    def look(self, Q: Tensor, K: Tensor, present: Tensor, scale: float) -> None:
        """See a block's attention, the mean of its heads."""
        scores = ((Q @ K.mT) * scale).masked_fill(~present[:, None, None], -torch.inf)
        self.kept, Recorded.last = scores.softmax(-1).mean(1)[0], self


def framed(image: np.ndarray, row: int, column: int, colour: tuple[int, int, int]) -> None:
    """Draws the frame of a patch."""
    x, y = column * STEP_PX, row * STEP_PX
    cv2.rectangle(image, (x, y), (x + PATCH_PX - 1, y + PATCH_PX - 1), colour, 1)


def row_of(net: PatchTransformer, sample: Sample, name: str) -> list[Tile]:
    """The pictures of one window and model, for the missing patch that most cameras truly see."""
    context = [frame for times in net.encode_contexts(list(sample.context)) for frame in times]
    with patch.object(steps, "AttentionGuide", Recorded):
        net([sample.view], [context], matches=[sample.matches])
    stack = target_images(sample.view, sample.view.rgb, net.config)
    queries = stack.places[any_in_patch(sample.view.error[None] > 0)[stack.kept]]
    sought = Recorded.last.sought[0]
    chosen = int(sought.sum(1).argmax())
    shares, true = Recorded.last.kept[chosen], sought[chosen]
    window = picture(sample.view.rgb + (1 - sample.view.mask) * (1 - sample.view.error))
    _, row, column = queries[chosen].tolist()
    framed(window, row, column, FRAME["query"])
    tiles, first = [Tile(f"{name}: {float(shares[true].sum()):.2f} on it", window)], 0
    for frame in context:
        own = slice(first, first + len(frame.places))
        first = own.stop
        if frame.time != sample.view.time:
            continue
        frames = sample.context[0].frame
        image = picture(frames.rgb[frames.cameras.names.index(frame.name)])
        looked = np.zeros(image.shape[:2], np.float32)
        for (row, column), share in zip(frame.places.tolist(), shares[own].tolist(), strict=True):
            part = looked[row * STEP_PX : row * STEP_PX + PATCH_PX, column * STEP_PX : column * STEP_PX + PATCH_PX]
            np.maximum(part, share, out=part)
        bright = DIM + (1 - DIM) * looked[..., None] / max(float(shares.max()), 1e-6)
        image = (image * bright).astype(np.uint8)
        for (row, column), is_true in zip(frame.places.tolist(), true[own].tolist(), strict=True):
            if is_true:
                framed(image, row, column, FRAME["true"])
        tiles.append(Tile(f"{frame.name}: {float(shares[own].sum()):.2f}", image))
    return tiles


@torch.no_grad()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("shards", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("models", nargs="+")
    parser.add_argument("--windows", type=int, default=4)
    options = parser.parse_args()
    samples = [s for path in shards_of(options.shards) for s in read_shard(path) if isinstance(s, Sample)]
    seen = [s for s in samples if s.matches is not None and bool((s.matches.time == s.view.time).any())]
    nets = {Path(name).name: load_network(name).eval() for name in options.models}
    rows = []
    for sample in seen[:: max(1, len(seen) // options.windows)][: options.windows]:
        for name, net in nets.items():
            assert isinstance(net, PatchTransformer), "no rays before its patches"
            rows.append(row_of(net, sample, name))
    write_image(options.out, contact_sheet(rows))


if __name__ == "__main__":
    main()
