"""`viewmend studio`: synthetic multi-camera captures with exact truth."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro


@dataclass(frozen=True, kw_only=True)
class Options:
    """Write synthetic captures with exact truth: OUT/scene_SEED for each scene, as plain capture folders."""

    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """Folder for the captures; it is made if it is not there."""
    scenes: int = 1
    """How many captures; their seeds are --seed and the numbers after it."""
    cameras: int = 12
    """Cameras of each rig, 4 to 60."""
    frames: int = 30
    """Frames of each capture, 30 a second."""
    size: int = 512
    """Width and height of the images."""
    seed: int = 0
    """The first capture's; the same seed gives the same capture."""
    rig: Literal["ring", "dome"] = "ring"
    """How the cameras stand."""
    performers: Path | None = None
    """A glTF character (.glb, .gltf) or a folder of them, instead of the procedural people; needs --motions."""
    motions: Path | None = None
    """A BVH motion or a folder of them, for the characters."""
    background: Literal["black", "stage"] = "black"
    """What the cameras see behind the subject: nothing, or a plain wall and floor."""
    imperfect: bool = False
    """Add what real stages get wrong: noise, colour, compression, mask and calibration errors."""
    images: Literal["jpeg", "png"] = "png"
    """Image files: exact, or smaller."""
    json: bool = False
    """Write one JSON object to standard output: the folders and who performs in them."""


def run(options: Options) -> int:
    """Run the command; the exit code."""
    least = {"scenes": 1, "cameras": 4, "frames": 1, "size": 1, "seed": 0}
    wrong = [name for name, low in least.items() if getattr(options, name) < low]
    if wrong:
        name = wrong[0]
        raise ValueError(f"expected --{name} of at least {least[name]}, got {getattr(options, name)}; see --help")
    from viewmend.capture.errors import CaptureError
    from viewmend.capture.plain_writer import remove_unfinished, write_capture
    from viewmend.cli.console import print_json, say, track
    from viewmend.studio.imperfections import Imperfections
    from viewmend.studio.stage import Studio, StudioConfig

    seeds = range(options.seed, options.seed + options.scenes)
    folders = [options.out / f"scene_{seed:05d}" for seed in seeds]
    for folder in folders:
        remove_unfinished(folder)
    if any(taken := [folder.exists() for folder in folders]):
        first = folders[taken.index(True)]
        raise CaptureError(f"{first}: expected no such folder, it exists; {_advice(options, taken)}")
    report = []
    for seed, folder in zip(seeds, folders, strict=True):
        config = StudioConfig(
            seed=seed,
            cameras=options.cameras,
            rig=options.rig,
            frames=options.frames,
            size_px=options.size,
            performers=options.performers,
            motions=options.motions,
            background=options.background,
            imperfections=Imperfections.typical() if options.imperfect else Imperfections(),
        )
        studio = Studio(config)
        write_capture(studio, folder, images=options.images, progress=lambda times, f=folder: track(times, f.name))
        say(f"{folder}: {studio.performer.description}")
        report.append({"folder": str(folder), "seed": seed, "performer": studio.performer.description})
    if options.json:
        print_json({"captures": report})
    return 0


def _advice(options: Options, taken: list[bool]) -> str:
    """What to do where captures exist: whoever was stopped goes on with the first that is not there."""
    done = taken.index(False) if False in taken else len(taken)
    if done in (0, len(taken)) or any(taken[done:]):
        return "choose another --seed or folder"
    return f"go on with --seed {options.seed + done} --scenes {len(taken) - done}, or choose another folder"
