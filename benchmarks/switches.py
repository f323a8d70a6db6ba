"""What single switches are worth: python benchmarks/switches.py [--captures DIR ...] [--scenes N] [--write].

Every n-th scene of P and views of captures, each with one switch changed: PSNR of the rendered and the mended whole
view, PSNR in the holes, and the IoU of hull and true mask. Switches of hull and renderer change what is missing, so
their figure is that of the whole view; those of the network are changed in the trained `small`, and those of its start
in a transformer that was never trained.
"""

import argparse
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch
from measure import write
from torch import nn

from viewmend.geometry.hull import HullConfig
from viewmend.inpainting.chain import Chain
from viewmend.inpainting.checkpoint import load_network
from viewmend.inpainting.config import InpainterConfig
from viewmend.inpainting.config import small as small_config
from viewmend.inpainting.patch_transformer import PatchTransformer
from viewmend.inpainting.patches import PATCH_CELLS
from viewmend.inpainting.protocol import ViewInpainter
from viewmend.leave_one_out.capture_scenes import capture_set
from viewmend.leave_one_out.scenes import LeaveOneOutScene
from viewmend.leave_one_out.studio_scenes import procedural_set
from viewmend.metrics.view_scores import mean_over_frames, score_view
from viewmend.rendering.blending import BlendConfig
from viewmend.rendering.view import RenderConfig
from viewmend.stream import Stream, StreamConfig

AS_IT_IS = StreamConfig(memory_mb=None)
STREAMS = {
    "as it is": AS_IT_IS,
    "pixels_per_voxel: no pooling": replace(AS_IT_IS, hull=HullConfig(pixels_per_voxel=1e9)),
    "min_fraction 0": replace(AS_IT_IS, hull=HullConfig(min_fraction=0.0)),
    "depth_bias 0": replace(AS_IT_IS, render=RenderConfig(blend=BlendConfig(depth_bias=0.0))),
    "depth_bias 0.02": replace(AS_IT_IS, render=RenderConfig(blend=BlendConfig(depth_bias=0.02))),
    "slope_px 0": replace(AS_IT_IS, render=RenderConfig(blend=BlendConfig(slope_px=0.0))),
}
METRICS = ("psnr_whole", "psnr_valid", "psnr_holes", "hull_iou")


def main() -> None:
    """Measure, and print or write."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--captures", nargs="*", type=Path, default=[], help="each camera is left out, seen from eight")
    parser.add_argument("--scenes", type=int, default=4, help="so many of each set, evenly")
    parser.add_argument("--frames", type=int, default=2)
    parser.add_argument("--size", type=int, default=240, help="of the views of P, pixels")
    parser.add_argument("--switches", nargs="*", default=[], help="these alone, beside `as it is`")
    parser.add_argument("--write", action="store_true", help="keep the result under benchmarks/results")
    options = parser.parse_args()
    sets: dict[str, Sequence[LeaveOneOutScene]] = {"P": procedural_set(options.frames, options.size)}
    sets |= {folder.name: capture_set(folder, "8", options.frames) for folder in options.captures}
    found = {
        name: judge(scenes[:: max(1, len(scenes) // options.scenes)][: options.scenes], options.switches)
        for name, scenes in sets.items()
    }
    config = {"scenes": options.scenes, "frames": options.frames, "size_px": options.size}
    print(write("switches", "cpu", config, found) if options.write else json.dumps(found, indent=1))


@torch.no_grad()
def judge(scenes: Sequence[LeaveOneOutScene], switches: Sequence[str] = ()) -> dict[str, dict[str, float | None]]:
    """Means over all views of each switch: of the rendered view, and as `small` mends it."""
    frames = [list(scene.frames("cpu")) for scene in scenes]
    runs = {name: (config, small) for name, config in STREAMS.items()}
    runs |= {name: (AS_IT_IS, make) for name, make in NETWORKS.items()}
    return {name: _means(frames, *run) for name, run in runs.items() if not switches or name in ("as it is", *switches)}


def small(**changes: object) -> Chain:
    """The shipped `small`, with changes of what is looked up in the config at each forward."""
    chain = load_network("small")
    assert isinstance(chain, Chain), "small reads rays, then patches"
    for part in (chain.patches, chain.patches.transformer):
        part.config = replace(part.config, **changes)
    return chain


def untrained(**changes: object) -> PatchTransformer:
    """The transformer of `small` as it begins, upon what is rendered."""
    torch.manual_seed(0)
    config = replace(small_config(), coarse_fill="none", temporal_accumulation=0.0, **changes)
    return PatchTransformer(config).eval()


def without_colour_skip() -> Chain:
    """Patches carry no colours beside their features: neither into tokens nor out of them."""
    chain = small()
    config: InpainterConfig = chain.config
    features = config.widths[-1] * PATCH_CELLS**2
    linear: nn.Linear = chain.patches.tokeniser.linear
    linear.weight[:, features:] = 0
    decode: nn.Linear = chain.patches.decoder.linear
    decode.weight[features:], decode.bias[features:] = 0, 0
    return chain


NETWORKS = {
    "min_foreground 0": partial(small, min_foreground=0.0),
    "patch_depth centre": partial(small, patch_depth="centre"),
    "rope_unit image": partial(small, rope_unit="image"),
    "rope_values off": partial(small, rope_values=False),
    "colour_skip off": without_colour_skip,
    "untrained": untrained,
    "untrained, token_norms off": partial(untrained, token_norms=False),
    "untrained, identity_init off": partial(untrained, identity_init=False),
}


def _means(
    frames: Sequence[Sequence], config: StreamConfig, make: Callable[[], ViewInpainter]
) -> dict[str, float | None]:
    network, scores = make(), []
    for scene in frames:
        stream, viewer = Stream(network, config, scene[0].bounds), None
        for frame in scene:
            stream.push(frame.inputs)
            view = stream.render(frame.truth.cameras)
            mended = stream.mend(view, viewer)
            viewer, mask = mended.viewer, frame.truth.mask[0]
            truth = frame.truth.rgb[0] / 255 * (mask / 255)
            scores.append([score_view(view, rgb, truth, mask > 127) for rgb in (view.rgb, mended.completed.rgb)])
    holes = [rendered.holes_px for rendered, _ in scores]
    found = {f"mended {name}": mean_over_frames([getattr(m, name) for _, m in scores], holes) for name in METRICS}
    return {"rendered psnr_whole": mean_over_frames([r.psnr_whole for r, _ in scores]), **found}


if __name__ == "__main__":
    main()
