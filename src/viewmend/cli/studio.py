"""`viewmend studio`: generates synthetic multi-camera captures with ground truth."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import tyro

from viewmend.cli.checks import check_least


@dataclass(frozen=True, kw_only=True)
class Options:
    """Generate synthetic captures with ground truth, as capture folders OUT/scene_SEED."""

    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """Output folder; it is created if it does not exist."""
    scenes: int = 1
    """Number of captures. Their seeds are --seed and the numbers after it."""
    cameras: int = 12
    """Number of cameras, at least 4."""
    frames: int = 30
    """Number of frames, at 30 per second."""
    size: int = 512
    """Width and height of the images, in pixels."""
    seed: int = 0
    """Seed of the first capture. The same seed generates the same capture."""
    rig: Literal["ring", "dome"] = "ring"
    """Arrangement of the cameras."""
    performers: Path | None = None
    """A glTF character (.glb, .gltf) or a folder of them, instead of procedural people; needs --motions."""
    motions: Path | None = None
    """A BVH motion or a folder of them, for the characters."""
    background: Literal["black", "stage"] = "black"
    """What is behind the subject: nothing, or a plain wall and floor."""
    imperfect: bool = False
    """Add the imperfections of real stages: noise, colour, compression, mask and calibration errors."""
    images: Literal["jpeg", "png"] = "png"
    """Image files: lossless PNG, or smaller JPEG."""
    json: bool = False
    """Write one JSON object to standard output: the folders and their performers."""


def run(options: Options) -> int:
    """Run the command and return the exit code."""
    check_least(options, scenes=1, cameras=4, frames=1, size=1, seed=0)
    from viewmend.cli.console import print_json, say, track
    from viewmend.data.errors import CaptureError
    from viewmend.data.native_writer import remove_unfinished, write_capture
    from viewmend.studio.imperfections import Imperfections
    from viewmend.studio.stage import Studio, StudioConfig

    seeds = range(options.seed, options.seed + options.scenes)
    folders = [options.out / f"scene_{seed:05d}" for seed in seeds]
    for folder in folders:
        remove_unfinished(folder)
    if any(existing := [folder.exists() for folder in folders]):
        first = folders[existing.index(True)]
        raise CaptureError(
            f"{first}: expected a new folder, got an existing one; {_advice(options, existing)}"
        )
    same = ("cameras", "rig", "frames", "performers", "motions", "background")
    config = StudioConfig(
        **{name: getattr(options, name) for name in same},
        size_px=options.size,
        imperfections=Imperfections.typical() if options.imperfect else Imperfections(),
    )
    report = []
    for seed, folder in zip(seeds, folders, strict=True):
        studio = Studio(replace(config, seed=seed))
        write_capture(
            studio, folder, images=options.images, progress=lambda times, f=folder: track(times, f.name)
        )
        say(f"{folder}: {studio.performer.description}")
        report.append({"folder": str(folder), "seed": seed, "performer": studio.performer.description})
    if options.json:
        print_json({"captures": report})
    return 0


def _advice(options: Options, existing: list[bool]) -> str:
    """How to proceed if captures exist; an interrupted run continues with the first missing one."""
    done = existing.index(False) if False in existing else len(existing)
    if done in (0, len(existing)) or any(existing[done:]):
        return "choose another --seed or folder"
    return f"continue with --seed {options.seed + done} --scenes {len(existing) - done}, or choose another folder"
