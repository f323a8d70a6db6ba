"""Images a second that each format's reader gives, beside plain files: python benchmarks/readers.py [--write].

The same pictures (JPEG, masks) as every format stores them, read a time after the other through `open_capture`; plain
files are read again beside each format, in turns, so that the ratio is of one load of the machine.
"""

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

import cv2
import numpy as np
import torch
from measure import write

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from reference import foreign_studios as studios
from reference.random_rigs import named, random_rig

from viewmend.capture.plain import PlainCapture, open_capture

CAMERAS, FRAMES, SIZE = 4, 3, (512, 375)
WRITERS = {
    "dna_rendering": (studios.write_dna, "{:02d}", "{}"),
    "riftcast": (studios.write_riftcast, "{}", "{:05d}"),
    "easymocap": (studios.write_easyvolcap, "{:02d}", "{:06d}"),
    "genebody": (studios.write_genebody, "{:02d}", "{:04d}"),
    "zju_mocap": (studios.write_zju, "Camera_B{}", "{:06d}"),
    "mvhumannet": (studios.write_mvhumannet, "CC32871A0{:02d}", "{:04d}"),
    "actorshq": (studios.write_actorshq, "Cam{:03d}", "{:06d}"),
    "panoptic": (studios.write_panoptic, "00_{:02d}", "{:08d}"),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--rounds", type=int, default=5, help="how often each is read, in turns with plain files")
    parser.add_argument("--write", action="store_true", help="keep the result under benchmarks/results")
    options = parser.parse_args()
    torch.set_num_threads(1)
    pictures()
    with tempfile.TemporaryDirectory() as folder:
        found = {kind: compared(Path(folder) / kind, kind, options.rounds) for kind in WRITERS}
    config = {"cameras": CAMERAS, "frames": FRAMES, "size": SIZE, "rounds": options.rounds}
    print(write("readers", "cpu", config, found) if options.write else json.dumps(found, indent=1))


def pictures() -> None:
    """Let the writers write noise on a gradient, which costs what a photograph costs, not one colour."""
    rng, encode, save = np.random.default_rng(0), cv2.imencode, cv2.imwrite
    shade = np.linspace(0, 200, SIZE[0])[None, :, None] + rng.normal(0, 12, (SIZE[1], SIZE[0], 3))
    picture = shade.clip(0, 255).astype(np.uint8)

    def instead(image: np.ndarray) -> np.ndarray:
        return picture if image.ndim == 3 and len(np.unique(image[::50, ::50])) == 1 and image[0, 0, 0] < 255 else image

    cv2.imencode = lambda suffix, image, *told: encode(suffix, instead(image), *told)
    cv2.imwrite = lambda path, image, *told: save(path, instead(image), *told)


def compared(folder: Path, kind: str, rounds: int) -> dict[str, float]:
    """Images a second of a format and of plain files of the same pictures, medians over rounds."""
    write_kind, pattern, frame = WRITERS[kind]
    lens = {"width": SIZE[0], "height": SIZE[1], "dist": np.zeros(5)}
    rig = named([camera | lens for camera in random_rig(0, CAMERAS, 0)], pattern)
    frames = [frame.format(n) for n in range(FRAMES)]
    write_kind(folder / "it", rig, frames)
    plain_files(folder / "plain", rig, frames)
    began = time.perf_counter()
    capture = open_capture(folder / "it", kind=kind)
    opening_ms = 1e3 * (time.perf_counter() - began)
    plain = open_capture(folder / "plain")
    rates = [(images_a_second(capture), images_a_second(plain)) for _ in range(rounds + 1)][1:]
    own, beside = (median(values) for values in zip(*rates, strict=True))
    ratio = median(one / other for one, other in rates)
    return {"images_s": round(own, 1), "plain_images_s": round(beside, 1), "ratio": round(ratio, 2)} | {
        "opening_ms": round(opening_ms, 1)
    }


def plain_files(folder: Path, rig: list[dict], frames: list[str]) -> None:
    """JPEG images and PNG masks of the same pictures, with cameras.json."""
    studios.write_take(
        folder, rig, frames, (), lambda c, f: f"image/{c['name']}/{f}.jpg", lambda c, f: f"mask/{c['name']}/{f}.png"
    )
    cameras = []
    for camera in rig:
        entry = {key: np.asarray(camera[key]).tolist() for key in ("K", "R", "t")}
        entry |= {key: camera[key] for key in ("name", "width", "height")}
        streams = {"image": f"image/{camera['name']}/{{frame}}.jpg", "mask": f"mask/{camera['name']}/{{frame}}.png"}
        cameras.append(entry | streams)
    told = {"format": "plain-capture/1", "frames": frames, "cameras": cameras}
    (folder / "cameras.json").write_text(json.dumps(told))


def images_a_second(capture: PlainCapture) -> float:
    """Camera images, each with its mask, of all times."""
    began = time.perf_counter()
    count = sum(len(capture.read(time).cameras) for time in range(len(capture.frame_ids)))
    return count / (time.perf_counter() - began)


if __name__ == "__main__":
    main()
