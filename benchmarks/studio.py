"""How fast the studio draws: python benchmarks/studio.py [--performers DIR --motions DIR] [--json FILE]."""

import argparse
import json
import os
import platform
import statistics
import subprocess
import time
from pathlib import Path

import torch

from viewmend.studio.imperfections import Imperfections
from viewmend.studio.render import light, render
from viewmend.studio.shading import stage_lights
from viewmend.studio.stage import Studio, StudioConfig
from viewmend.studio.textures import texture_pyramid


def timed(work, runs: int, device: str) -> dict[str, float]:
    """Median and p95 of `work(run)` in milliseconds after one warm-up, and the median of its CPU time."""
    work(0)
    spent, cpu = [], []
    for run in range(1, runs + 1):
        if device.startswith("cuda"):
            torch.cuda.synchronize()
        start, cpu_start = time.perf_counter(), time.process_time()
        work(run)
        if device.startswith("cuda"):
            torch.cuda.synchronize()
        spent.append(1e3 * (time.perf_counter() - start))
        cpu.append(1e3 * (time.process_time() - cpu_start))
    spent.sort()
    return {
        "median_ms": round(statistics.median(spent), 2),
        "p95_ms": round(spent[int(0.95 * (len(spent) - 1))], 2),
        "cpu_ms": round(statistics.median(cpu), 2),
    }


def measure(config: StudioConfig, runs: int) -> dict[str, object]:
    studio = Studio(config)
    cameras, device = studio.true_cameras, config.device
    lights, scene = stage_lights(0).to(device), studio.scene(0)
    pyramid = texture_pyramid(scene.textures).to(device)
    surface = light(scene, lights, pyramid)
    frame = timed(studio.read, runs, device)
    return {
        "performer": studio.performer.description,
        "triangles": len(scene.mesh.faces),
        "imperfections": config.imperfections != Imperfections(),
        "pose": timed(studio.scene, runs, device),
        "light": timed(lambda _: light(scene, lights, pyramid), runs, device),
        "render_all_views": timed(lambda _: render(surface, cameras), runs, device),
        "read_frame": frame,
        "images_per_second": round(1e3 * len(cameras) / frame["median_ms"], 1),
        "images_per_cpu_second": round(1e3 * len(cameras) / max(frame["cpu_ms"], 1e-3), 1),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--performers", type=Path)
    parser.add_argument("--motions", type=Path)
    parser.add_argument("--cameras", type=int, default=8)
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--runs", type=int, default=8)
    parser.add_argument("--threads", type=int, help="of torch; 1 where others use the machine too")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    if options.threads is not None:
        torch.set_num_threads(options.threads)
    base = {"seed": 0, "cameras": options.cameras, "size_px": options.size, "frames": options.runs + 1}
    files = {"performers": options.performers, "motions": options.motions}
    cases = {
        "procedural": {},
        "procedural, imperfect": {"imperfections": Imperfections.typical(), "background": "stage"},
    }
    if options.performers is not None:
        cases["glTF"] = files
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False)
    cpu = next((n.split(":")[1].strip() for n in _cpu_info() if n.startswith("model name")), platform.processor())
    result = {
        "what": "studio",
        "device": torch.cuda.get_device_name() if options.device.startswith("cuda") else cpu,
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
        "commit": commit.stdout.strip(),
        "load_average": os.getloadavg()[0],
        "config": base,
        "cases": {
            name: measure(StudioConfig(**base, **case, device=options.device), options.runs)
            for name, case in cases.items()
        },
    }
    text = json.dumps(result, indent=1)
    print(text)
    if options.json is not None:
        options.json.write_text(text + "\n")


def _cpu_info() -> list[str]:
    path = Path("/proc/cpuinfo")
    return path.read_text().splitlines() if path.is_file() else []


if __name__ == "__main__":
    main()
