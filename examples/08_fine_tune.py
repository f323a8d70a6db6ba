"""Fine-tune the default model on a capture and compare: `python examples/08_fine_tune.py CAPTURE [OUT]`.

`viewmend train finetune` holds back one camera and the last frames, by which it chooses the best weights. This program
scores both models on the last image of that camera, which training has not seen.
"""

import math
import subprocess
import sys
from pathlib import Path

from viewmend import Inpainter, Stream, load_inpainter, open_capture, prepare


def psnr_db(inpainter: Inpainter, capture: Path, held: str) -> float:
    """PSNR of a camera's last image, on black, completed from the other cameras."""
    opened = open_capture(capture)
    prepared = prepare(opened, [name for name in opened.cameras.names if name != held])
    backwards = (prepared.read(time) for time in reversed(range(len(prepared.frame_ids))))
    frame = next(frame for frame in backwards if held in frame.cameras.names)
    stream = Stream(inpainter, bounds=prepared.bounds)
    stream.add_frame(frame.without([held]))
    completed = stream.view(prepared.cameras.select([held])).completed.rgb
    true = frame.select([held])
    image = true.rgb[0] / 255 * (true.mask[0] / 255)
    return -10 * math.log10(float((completed - image).square().mean()))


def main(capture: Path, out: Path, *options: str) -> tuple[float, float]:
    """Train for `--minutes` (30 by default) and return PSNR before and after."""
    held = open_capture(capture).cameras.names[0]
    command = [sys.executable, "-m", "viewmend", "train", "finetune", str(capture), "--from", "views"]
    command += ["--hold-out", held, "--out", str(out)]
    subprocess.run([*command, *(options or ("--minutes", "30"))], check=True)
    return psnr_db(load_inpainter("views"), capture, held), psnr_db(load_inpainter(out), capture, held)


if __name__ == "__main__":
    before, after = main(Path(sys.argv[1]), Path(sys.argv[2] if len(sys.argv) > 2 else "out/finetuned"))
    print(f"PSNR {before:.2f} dB before, {after:.2f} dB after")
