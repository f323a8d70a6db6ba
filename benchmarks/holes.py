"""PSNR in the holes on scenes that no model was trained on: ours against Telea and nearest-colour fill.

    python benchmarks/holes.py procedural                 # 20 studio scenes, seeds from 10000
    python benchmarks/holes.py performers ../shared/performers
    python benchmarks/holes.py wd2 ../shared/captures/wd2  # every camera left out, from all others and from 8

Writes benchmarks/results/holes-<set>--<device>--<date>.json and prints a Markdown table.
"""

import argparse
import statistics
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path

from measure import write

from viewmend.capture.plain import open_capture
from viewmend.capture.studio.stage import Studio, StudioConfig
from viewmend.evaluation.holes import SceneScores, leave_one_out
from viewmend.geometry.alignment import shared_offset
from viewmend.inpainting.checkpoint import load_inpainter
from viewmend.inpainting.classical import NearestColour, Telea
from viewmend.inpainting.reprojection_fill import ReprojectionFill
from viewmend.pipeline import PipelineConfig

FRAMES, CAMERAS, SIZE_PX = 10, 12, 320
WD2_EIGHT = ("cam00", "cam02", "cam05", "cam07", "cam10", "cam12", "cam15", "cam17")


def studios(which: str, folder: Path | None) -> Iterator[Studio]:
    config = StudioConfig(cameras=CAMERAS, frames=FRAMES, size_px=SIZE_PX)
    if which == "procedural":
        for seed in range(10000, 10020):
            yield Studio(replace(config, seed=seed))
        return
    assert folder is not None
    pairs = [
        (p, m) for p in sorted((folder / "test").glob("*.glb")) for m in sorted((folder / "motions/test").glob("*"))
    ]
    for seed, (performer, motion) in enumerate((p, m) for p, m in pairs if m.suffix == ".bvh"):
        yield Studio(replace(config, seed=20000 + seed, performers=performer, motions=motion))


def studio_scores(studio: Studio, inpainters: dict) -> list[SceneScores]:
    held = studio.cameras.names[studio.config.seed % CAMERAS]
    pairs = ((studio.read(t), studio.truth(studio.true_cameras.select([held]), t)) for t in range(FRAMES))
    return leave_one_out(studio.name, pairs, None, inpainters, PipelineConfig())


def capture_scores(folder: Path, inpainters: dict) -> Iterator[list[SceneScores]]:
    capture = open_capture(folder)
    frame = capture.read(0)
    for held in frame.cameras.names:
        for label, names in (("all", frame.cameras.names), ("8", (*WD2_EIGHT, held))):
            inputs = frame.select([name for name in dict.fromkeys(names) if name != held])
            offset_px = shared_offset(inputs.mask, inputs.cameras, capture.bounds).offset_px  # as `viewmend mend` does
            moved = replace(frame, cameras=frame.cameras.moved(*offset_px))
            pairs = [(moved.select(inputs.cameras.names), moved.select([held]))]
            yield leave_one_out(f"{held} from {label}", pairs, capture.bounds, inpainters, PipelineConfig())


def table(rows: list[SceneScores], methods: list[str]) -> str:
    lines = ["| scene | pixels of E | " + " | ".join(methods) + " |", "| --- | --- |" + " --- |" * len(methods)]
    for scene in dict.fromkeys(r.scene for r in rows):
        of = {r.method: r for r in rows if r.scene == scene}
        shown = ["-" if of[m].holes is None else f"{of[m].holes:.2f}" for m in methods]
        lines.append(f"| {scene} | {of[methods[0]].hole_px} | " + " | ".join(shown) + " |")
    for title, value in (("mean", "holes"), ("mean, inside the true mask", "holes_fg"), ("mean, whole image", "whole")):
        means = []
        for m in methods:
            values = [getattr(r, value) for r in rows if r.method == m and getattr(r, value) is not None]
            means.append(f"**{statistics.fmean(values):.2f}**" if values else "-")
        lines.append(f"| **{title}** | | " + " | ".join(means) + " |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("set", choices=["procedural", "performers", "wd2"])
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--model", default="small")
    options = parser.parse_args()
    inpainters = {
        "ours": load_inpainter(options.model),
        "Telea": Telea(),
        "nearest colour": NearestColour(),
        "reprojection": ReprojectionFill(),
    }
    rows: list[SceneScores] = []
    if options.set == "wd2":
        for scores in capture_scores(options.folder, inpainters):
            rows += scores
    else:
        for studio in studios(options.set, options.folder):
            rows += studio_scores(studio, inpainters)
            print(rows[-1].scene, [r.holes and round(r.holes, 2) for r in rows[-len(inpainters) :]], flush=True)
    write(f"holes-{options.set}", "cpu", {"model": options.model}, {"scores": [asdict(row) for row in rows]})
    print(table(rows, list(inpainters)))


if __name__ == "__main__":
    main()
