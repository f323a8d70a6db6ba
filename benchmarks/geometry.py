"""Time hull, surface and depth: python benchmarks/geometry.py [--device cuda] [--runs 30] [--write].

The subject is a figure of ellipsoids, 1.75 m tall; cameras of 512 x 612 form a ring.
"""

import argparse
import json
import math
from dataclasses import asdict

import torch
from measure import timed, write

from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras, concatenate_cameras, pinhole, pixel_centers, unproject
from viewmend.geometry.hull import HullConfig, occupied_bounds, visual_hull
from viewmend.geometry.mesh import vertex_normals
from viewmend.geometry.proxy import reconstruct
from viewmend.geometry.rigid import look_at
from viewmend.geometry.surface import extract_surface

WIDTH, HEIGHT = 512, 612
# Centre and half axes of head, trunk, hips, two arms, two legs; metres, y up, feet at y = 0.
FIGURE = torch.tensor(
    [
        [0.0, 1.62, 0.0, 0.09, 0.13, 0.11],
        [0.0, 1.22, 0.0, 0.20, 0.30, 0.13],
        [0.0, 0.90, 0.0, 0.18, 0.16, 0.14],
        [-0.30, 1.12, 0.05, 0.06, 0.34, 0.06],
        [0.30, 1.12, -0.05, 0.06, 0.34, 0.06],
        [-0.11, 0.45, 0.05, 0.09, 0.46, 0.09],
        [0.11, 0.45, -0.05, 0.09, 0.46, 0.09],
    ]
)


def ring(count: int) -> Cameras:
    cameras = []
    for i in range(count):
        angle = 2 * math.pi * i / count
        eye = torch.tensor([2.8 * math.cos(angle), 1.0 + 0.3 * (i % 2), 2.8 * math.sin(angle)])
        pose = look_at(eye, torch.tensor([0.0, 0.9, 0.0]), torch.tensor([0.0, 1.0, 0.0]))
        cameras.append(pinhole(0.72, WIDTH, HEIGHT, pose, f"c{i}"))
    return concatenate_cameras(cameras)


def silhouettes(cameras: Cameras) -> torch.Tensor:
    """255 where a pixel's ray hits one of the figure's ellipsoids."""
    pixels = pixel_centers(WIDTH, HEIGHT).reshape(1, -1, 2)
    masks = []
    for view in range(len(cameras)):
        camera = cameras[view]
        rays = unproject(pixels, torch.ones(1, pixels.shape[1]), camera)[0] - camera.centers
        hit = torch.zeros(len(rays), dtype=torch.bool)
        for ellipsoid in FIGURE:
            start, along = (camera.centers[0] - ellipsoid[:3]) / ellipsoid[3:], rays / ellipsoid[3:]
            a, b, c = along.square().sum(-1), along @ start, start.square().sum() - 1
            hit |= b.square() - a * c > 0
        masks.append((hit * 255).to(torch.uint8).view(HEIGHT, WIDTH))
    return torch.stack(masks)


def hull_figures(views: int, config: HullConfig, device: str, runs: int) -> dict[str, object]:
    cameras = ring(views).to(device)
    masks = silhouettes(ring(views)).to(device)
    middle = torch.tensor([0.0, 0.9, 0.0], device=device)
    stage = Bounds(middle - 1.0, middle + 1.0)
    box = occupied_bounds(masks, cameras, stage, config)
    assert box is not None
    return {
        "voxels": list(visual_hull(masks, cameras, box, config).values.shape),
        "search": timed(lambda: occupied_bounds(masks, cameras, stage, config), runs, device=device),
        "hull_in_its_box": timed(lambda: visual_hull(masks, cameras, box, config), runs, device=device),
        "hull_of_the_whole_cube": timed(
            lambda: visual_hull(masks, cameras, stage, config), runs, device=device
        ),
        "reconstruct": timed(lambda: reconstruct(masks, cameras, stage, config), runs, device=device),
    }


def frame_figures(config: HullConfig, device: str, runs: int) -> dict[str, object]:
    """A frame of eight cameras: hull, surface, normals, and depth in the eight cameras and a novel view."""
    cameras, nine = ring(8).to(device), ring(9).to(device)
    masks = silhouettes(ring(8)).to(device)
    middle = torch.tensor([0.0, 0.9, 0.0], device=device)
    stage = Bounds(middle - 1.0, middle + 1.0)
    box = occupied_bounds(masks, cameras, stage, config)
    assert box is not None
    grid = visual_hull(masks, cameras, box, config)
    proxy = reconstruct(masks, cameras, stage, config)
    return {
        "triangles": len(proxy.mesh.faces),
        "surface": timed(lambda: extract_surface(grid), runs, device=device),
        "normals": timed(lambda: vertex_normals(proxy.mesh), runs, device=device),
        "depth_of_9_views": timed(lambda: proxy.depth(nine), runs, device=device),
        "whole_frame": timed(
            lambda: reconstruct(masks, cameras, stage, config).depth(nine), runs, device=device
        ),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--runs", type=int, default=30)
    parser.add_argument("--write", action="store_true", help="write the result to benchmarks/results")
    parser.add_argument("--resolution", type=int, default=HullConfig().resolution)
    options = parser.parse_args()
    config = HullConfig(resolution=options.resolution)
    figures = {
        "frame of 8 cameras": frame_figures(config, options.device, options.runs),
        "hull of 8 cameras": hull_figures(8, config, options.device, options.runs),
        "hull of 48 cameras": hull_figures(48, config, options.device, options.runs),
    }
    print(json.dumps(figures, indent=2))
    if options.write:
        print(write("geometry", options.device, {**asdict(config), "size_px": [WIDTH, HEIGHT]}, figures))


if __name__ == "__main__":
    main()
