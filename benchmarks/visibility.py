"""Who saw what is missing: of the subject's surface in holes, how much other times and other cameras saw.

    python benchmarks/visibility.py [--scenes N] [--size PIXELS] [--write]

The last of 31 frames of scenes of P, seen by the camera that is left out. Each missing pixel of the true silhouette is
one point of the true surface; it is followed back in time, and looked for in the true depth of each camera.
"""

import argparse
import json
from collections.abc import Iterable, Sequence

import torch
from jaxtyping import Bool, Float
from measure import write
from torch import Tensor

from viewmend.baselines.classical import Unfilled
from viewmend.evaluation.temporal import VISIBLE_M
from viewmend.geometry.cameras import Cameras, project
from viewmend.geometry.mesh import Mesh
from viewmend.geometry.rasterize import Raster, interpolate, rasterize
from viewmend.leave_one_out.studio_scenes import StudioScene, procedural_set
from viewmend.stream import Stream
from viewmend.views import MultiViewFrame

NOW = 30
RECENT, FURTHER = (29, 28, 27), (20, 10, 0)
"""The paper's window: n_c = 3, n_w = 3, k_w = 10."""


def seen(points: Float[Tensor, "point 3"], frame: MultiViewFrame) -> Bool[Tensor, "point"]:
    """Whether any of the frame's cameras sees each point."""
    assert frame.depth is not None, "the studio knows its depth"
    at, z = project(points, frame.cameras)
    found = torch.zeros(len(points), dtype=torch.bool)
    for i, (width, height) in enumerate(frame.cameras.size_px.tolist()):
        column, row = at[i].floor().long().unbind(-1)
        inside = (z[i] > 0) & (column >= 0) & (row >= 0) & (column < width) & (row < height)
        there = frame.depth[i, row.clamp(0, height - 1), column.clamp(0, width - 1)]
        found |= inside & (there > 0) & ((z[i] - there).abs() < VISIBLE_M)
    return found


def then(mesh: Mesh, camera: Cameras, raster: Raster, before: Mesh, pixels: Bool[Tensor, "height width"]) -> Tensor:
    """Where the surface points in these pixels were when the mesh was `before`."""
    return interpolate(before.vertices, mesh, camera, raster)[0][pixels]


def shares(scene: StudioScene) -> dict[str, float] | None:
    """Shares of the missing surface; None where hardly anything is missing."""
    studio = scene.studio()
    frames = {time: studio.read(time) for time in (NOW, *RECENT, *FURTHER)}
    inputs, camera = frames[NOW].without([scene.held]), frames[NOW].cameras.select([scene.held])
    stream = Stream(Unfilled())
    stream.push(inputs)
    view = stream.render(camera)
    mesh = studio.scene(NOW).mesh
    raster = rasterize(mesh, camera)
    holes = view.error > 0
    missing = holes & (raster.triangle[0] >= 0)
    if int(missing.sum()) < 50:
        return None

    def by(times: Iterable[int], names: Sequence[str]) -> Bool[Tensor, "point"]:
        found = torch.zeros(int(missing.sum()), dtype=torch.bool)
        for time in times:
            points = then(mesh, camera, raster, studio.scene(time).mesh, missing)
            found |= seen(points, frames[time].select(names))
        return found

    own, near = view.source_views, view.closest_views(8)
    now, recent, further = by([NOW], own), by(RECENT, own), by(FURTHER, own)
    others, everyone = by([NOW], near), by([NOW], inputs.cameras.names)
    counted = {
        "source views, now": now,
        "source views, now or up to 3 frames ago": now | recent,
        "source views, the whole window": now | recent | further,
        "8 cameras, now": others,
        "all cameras, now": everyone,
        "all cameras, now, or chosen, the whole window": everyone | recent | further,
    }
    found = {name: float(pixels.float().mean()) for name, pixels in counted.items()}
    return found | {"background, of the holes": float((holes & ~missing).sum() / holes.sum())}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=30)
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--write", action="store_true", help="write benchmarks/results")
    options = parser.parse_args()
    rows: dict[str, list[dict[str, float]]] = {}
    for scene in procedural_set(frames=NOW + 1, size_px=options.size)[: options.scenes]:
        if (row := shares(scene)) is not None:
            for kind in ("all", scene.style, scene.rig):
                rows.setdefault(kind, []).append(row)
    results = {
        kind: {"scenes": len(own)} | {name: round(sum(r[name] for r in own) / len(own), 4) for name in own[0]}
        for kind, own in rows.items()
    }
    print(json.dumps(results, indent=2))
    if options.write:
        print("wrote", write("visibility", "cpu", vars(options), results))


if __name__ == "__main__":
    main()
