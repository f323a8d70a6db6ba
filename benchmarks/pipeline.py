"""How long each stage of a mended view takes: python benchmarks/pipeline.py [--device cuda] [--write]."""

import argparse
import json
from dataclasses import asdict

import torch
from measure import summarise, write

from viewmend.inpainting.chain import Chain
from viewmend.inpainting.config import small
from viewmend.inpainting.protocol import RenderQuality
from viewmend.stream import Stream, StreamConfig
from viewmend.studio.rigs import orbit
from viewmend.studio.stage import Studio, StudioConfig

SEED, WARM_UP = 10008, 3
SIZES = ((320, 320), (512, 612))


def stage_times(size: tuple[int, int], cameras: int, frames: int, device: str) -> dict[str, object]:
    """Stage times over a stream of a procedural scene, `small` with random weights, a camera that stands still."""
    studio = Studio(StudioConfig(seed=SEED, cameras=cameras, frames=frames, size_px=size))
    target = orbit([0.4], size, elevation_rad=0.25).to(device)
    torch.manual_seed(0)
    stream = Stream(Chain(small()).to(device).eval(), bounds=studio.bounds)
    viewer, taken, second, holes = None, [], [], []
    for time in range(frames):
        stream.push(studio.read(time).to(device))
        mended = stream.view(target, viewer)
        viewer = mended.viewer
        if time >= WARM_UP:
            taken.append(asdict(mended.times))
            second.append(stream.view(target, quality=RenderQuality(mend=False)).times.rendering)
            holes.append(int((mended.completed.view.error > 0).sum()))
    stages = {stage: summarise([t[stage] for t in taken]) for stage in taken[0]}
    return {
        "size_px": list(size),
        "cameras": cameras,
        "frames": len(taken),
        "hole_px_mean": sum(holes) / len(holes),
        **stages,
        "all": summarise([sum(t.values()) for t in taken]),
        "rendering_second_viewer": summarise(second),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--cameras", type=int, default=8)
    parser.add_argument("--frames", type=int, default=15)
    parser.add_argument("--write", action="store_true", help="write the file in benchmarks/results")
    options = parser.parse_args()
    figures = {}
    for size in SIZES:
        figures[f"{size[0]}x{size[1]}"] = stage_times(size, options.cameras, options.frames, options.device)
        print(json.dumps(figures), flush=True)
    if options.write:
        config = {"seed": SEED, "model": "small, random weights", "pipeline": asdict(StreamConfig())}
        print(write("pipeline", options.device, config, figures))


if __name__ == "__main__":
    main()
