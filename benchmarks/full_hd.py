"""Complete a film at full HD: python benchmarks/full_hd.py CAPTURE [--frames 6] [--write].

CAPTURE, a synthetic capture of eight cameras of 1080 x 1920 pixels, is made if the folder does not
exist. `viewmend mend` completes a view between two of its cameras in each frame. Printed are its
processor time, wall time and peak memory, and what it said while it ran. On a machine that others
use, only processor time and memory mean something.
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from measure import write

from viewmend import Studio, StudioConfig, orbit, write_capture

SIZE_PX = (1080, 1920)
"""Width and height of images and views, pixels."""
CAMERAS = 8
SEED = 10003
"""Seed of the performer, one of the test scenes."""
ANGLE_RAD = 0.4
"""Where the view stands on the ring of cameras."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("capture", type=Path, help="folder of the capture, made if it does not exist")
    parser.add_argument("--frames", type=int, default=6, help="number of frames of the film")
    parser.add_argument("--model", default="views", help="model that completes the film")
    parser.add_argument("--write", action="store_true", help="write the result to benchmarks/results")
    options = parser.parse_args()
    if not options.capture.exists():
        config = StudioConfig(seed=SEED, cameras=CAMERAS, frames=options.frames, size_px=SIZE_PX)
        write_capture(Studio(config), options.capture)
    found = mend(options.capture, options.frames, options.model)
    config = {"model": options.model, "cameras": CAMERAS, "size_px": SIZE_PX, "frames": options.frames}
    print(write("full_hd", "cpu", config, found) if options.write else json.dumps(found, indent=1))


def mend(capture: Path, frames: int, model: str) -> dict[str, object]:
    """Run `viewmend mend`, and measure the process."""
    camera = orbit([ANGLE_RAD], SIZE_PX, elevation_rad=0.2)
    path = {
        "world_from_camera": camera.world_from_camera.tolist(),
        "K": camera.K[0].tolist(),
        "width": SIZE_PX[0],
        "height": SIZE_PX[1],
    }
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "path.json"
        file.write_text(json.dumps(path))
        command = [sys.executable, "-m", "viewmend", "mend", str(capture), "--path", str(file)]
        command += ["--frames", f"0:{frames}", "--model", model, "--out", str(Path(folder) / "film")]
        start_s = time.monotonic()
        done = subprocess.run(command, check=True, capture_output=True, text=True)
        wall_s = time.monotonic() - start_s
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return {
        "processor_s": round(used.ru_utime + used.ru_stime, 1),
        "wall_s": round(wall_s, 1),
        "peak_memory_gb": round(used.ru_maxrss * 1024 / 1e9, 2),
        "printed": (done.stderr + done.stdout).strip().splitlines(),
    }


if __name__ == "__main__":
    main()
