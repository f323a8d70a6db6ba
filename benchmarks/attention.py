"""Where a model's attention goes, and what the past changes: python benchmarks/attention.py [--model NAME] [--write].

The last of 31 frames of scenes of P, seen by the camera that is left out, mended once with all of the paper's window
and once with the present alone. Attention is a mean over the missing patches, heads and blocks.
"""

import argparse
import json
from collections.abc import Sequence
from typing import Any
from unittest.mock import patch

import torch
from measure import write
from torch import Tensor
from visibility import FURTHER, NOW, RECENT

from viewmend.inpainting import patch_transformer as steps
from viewmend.inpainting import transformer
from viewmend.inpainting.chain import Chain
from viewmend.inpainting.checkpoint import load_network
from viewmend.inpainting.patch_transformer import PatchTransformer
from viewmend.inpainting.protocol import RenderQuality
from viewmend.leave_one_out.studio_scenes import StudioScene, procedural_set
from viewmend.metrics.image_quality import psnr
from viewmend.stream import Stream


class Watched:
    """A model whose attention is written down while it completes one view."""

    def __init__(self, model: Chain | PatchTransformer) -> None:
        self.model = model
        self.received: list[Tensor] = []
        self.kinds: dict[str, Tensor] = {}

    def __enter__(self) -> "Watched":
        attend, assemble = transformer.attend, steps.assemble

        def watch(Q: Tensor, K: Tensor, V: Tensor, keep: Tensor, scale: float) -> Tensor:
            weights = ((Q @ K.mT) * scale).masked_fill(~keep[:, None, None], -torch.inf).softmax(-1)
            self.received.append(weights.mean((0, 1, 2)))
            return attend(Q, K, V, keep, scale)

        def sort(targets: Sequence[Any], *others: Any) -> Any:
            batch = assemble(targets, *others)
            frames_ago = batch.context_at.uvs[0, :, 2] * self.model.config.window
            own = torch.zeros(len(frames_ago), dtype=torch.bool)
            own[len(own) - int((~targets[0].incomplete).sum()) :] = True
            present = ~own & (frames_ago < 0.5)
            recent = (frames_ago > 0.5) & (frames_ago < self.model.config.n_c + 0.5)
            further = frames_ago > self.model.config.n_c + 0.5
            self.kinds = {"the view's own": own, "now": present, "recent": recent, "further": further}
            return batch

        self._patches = [patch.object(transformer, "attend", watch), patch.object(steps, "assemble", sort)]
        for one in self._patches:
            one.start()
        return self

    def __exit__(self, *exception: object) -> None:
        for one in self._patches:
            one.stop()

    def shares(self) -> dict[str, float]:
        """Share of the attention, and of the context's patches, by kind."""
        mean = torch.stack(self.received).mean(0)
        count = len(mean)
        attention = {f"attention, {kind}": float(mean[keys].sum()) for kind, keys in self.kinds.items()}
        return attention | {f"patches, {kind}": float(keys.sum()) / count for kind, keys in self.kinds.items()}


@torch.no_grad()
def looked_at(scene: StudioScene, model: Chain | PatchTransformer) -> dict[str, float] | None:
    """Shares and scores of one scene; None where hardly anything is missing."""
    studio, stream = scene.studio(), Stream(model)
    frames = {time: studio.read(time) for time in (NOW, *RECENT, *FURTHER)}
    for frame in frames.values():
        stream.push(frame.without([scene.held]))
    truth = frames[NOW].select([scene.held])
    view = stream.render(truth.cameras)
    holes = view.error > 0
    if int(holes.sum()) < 50:
        return None

    with Watched(model) as watched:
        whole = stream.mend(view).completed
        shares = watched.shares()
    alone = stream.mend(view, quality=RenderQuality(context_times=1)).completed
    assert truth.mask is not None, "the studio knows its masks"
    right = truth.rgb[0].float() / 255 * (truth.mask[0].float() / 255)
    scores = {"with the past, dB": psnr(whole.rgb, right, holes), "without, dB": psnr(alone.rgb, right, holes)}
    change = float((whole.rgb - alone.rgb).abs()[:, holes].mean() * 255)
    return shares | {k: v for k, v in scores.items() if v is not None} | {"change by the past, 255ths": change}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", default="small", help="name or folder; one that prunes is not watched whole")
    parser.add_argument("--scenes", type=int, default=12)
    parser.add_argument("--size", type=int, default=320)
    parser.add_argument("--write", action="store_true", help="write the file in benchmarks/results")
    options = parser.parse_args()
    model = load_network(options.model)
    scenes = procedural_set(frames=NOW + 1, size_px=options.size)[: options.scenes]
    rows = [row for scene in scenes if (row := looked_at(scene, model)) is not None]
    if not rows:
        parser.error("expected a scene that misses 50 pixels or more, got none; take more --scenes or a larger --size")
    results = {name: round(sum(row[name] for row in rows) / len(rows), 4) for name in rows[0]} | {"scenes": len(rows)}
    print(json.dumps(results, indent=2))
    if options.write:
        print("wrote", write("attention", "cpu", vars(options), results))


if __name__ == "__main__":
    main()
