"""`viewmend demo`: render and complete a moving procedural scene from a moving camera."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from viewmend.cli.checks import ViewOptions, check_least
from viewmend.utils.options import FLAT

if TYPE_CHECKING:
    from viewmend.geometry.cameras import Cameras
    from viewmend.mending import MendStep

FPS = 15.0
SWEEP_RAD = 1.6
"""How far the novel camera moves around the subject."""
ELEVATION_RAD = 0.25
RESULTS = ("demo.mp4", "contact_sheet.png")
MIN_GAP = 4
"""Least number of frames between the rows of the contact sheet."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """Render and complete a procedural scene, captured by six cameras, from a moving camera. It needs no data.

    OUT gets demo.mp4 (rendered, completed and true views side by side) and contact_sheet.png. The
    table compares the rendered view, OpenCV's Telea and the model with the truth.
    """

    out: Path = Path("out/demo")
    """Folder for the results; created if needed."""
    seed: int = 10001
    """Seed of the scene. Seeds from 10000 on are never used for training."""
    frames: int = 24
    """Number of frames, at 15 per second."""
    size: int = 320
    """Width and height of all images, in pixels."""
    cameras: int = 6
    """Number of cameras in the ring."""
    view: Annotated[ViewOptions, FLAT] = field(default_factory=ViewOptions)
    model: str | None = None
    """Name of a shipped model, or a model's folder; 'telea' and 'nearest' are classical fills."""
    json: bool = False
    """Write the table to standard output as one JSON object, and nothing else."""


def run(options: Options) -> int:
    """Run the command; the exit code."""
    check_least(options, frames=1, size=1, cameras=1)
    from viewmend.cli.checks import load_named
    from viewmend.cli.console import print_json, say, show, track
    from viewmend.cli.mend_output import as_text
    from viewmend.data.source import prefetch
    from viewmend.mending import Mender, MendSummary, default_protocol
    from viewmend.models.registry import error_model_for
    from viewmend.stream import StreamConfig
    from viewmend.studio.stage import Studio, StudioConfig
    from viewmend.utils.output_folder import OutputFolder

    render = options.view.config()
    inpainter = load_named(options.model, "cpu")
    config = StudioConfig(
        seed=options.seed, cameras=options.cameras, frames=options.frames, size_px=options.size, fps=FPS
    )
    studio = Studio(config)
    say(f"scene: {studio.performer.description}")
    path = _path(options)
    protocol = default_protocol(inpainter)
    needs_model = render.error_rule == "predicted" or protocol == "predicted-mask"
    error_model = error_model_for(inpainter) if needs_model else None
    mender = Mender(
        inpainter,
        StreamConfig(render=render, memory_mb=None),
        studio.bounds,
        error_model=error_model,
        protocol=protocol,
    )
    summary = MendSummary(protocol)
    steps = []
    with OutputFolder(options.out) as folder:
        folder.check_own_files(*RESULTS)
        for frame in track(prefetch(studio), "completing", options.frames):
            target = path[frame.time]
            steps.append(mender.mend(frame, target, studio.truth(target, frame.time)))
            summary.add(steps[-1])
        _write(folder.draft, steps)
        folder.publish(*RESULTS)
    for name in RESULTS:
        say(f"wrote {options.out / name}")
    if options.json:
        print_json(summary.as_json())
    else:
        show(*as_text(summary))
    return 0


def _path(options: Options) -> "Cameras":
    """The moving camera: around the subject and back, a little above the ring."""
    from viewmend.studio.rigs import orbit

    phases = [n / max(1, options.frames) for n in range(options.frames)]
    azimuths = [SWEEP_RAD * (0.5 - 0.5 * math.cos(2 * math.pi * phase)) for phase in phases]
    return orbit(azimuths, (options.size, options.size), elevation_rad=ELEVATION_RAD)


def _write(out: Path, steps: "Sequence[MendStep]") -> None:
    """Write demo.mp4 and contact_sheet.png; the sheet has the frames with the most holes, in order of time."""
    from viewmend.cli.mend_output import SHEET_ROWS, sheet_row, side_by_side
    from viewmend.data.images import write_image
    from viewmend.data.videos import write_mp4
    from viewmend.utils.contact_sheet import contact_sheet, picture

    panels = []
    for step in steps:
        assert step.truth is not None, "synthetic scenes have a truth"
        images = {"rendered": step.rendered, "completed": step.completed_rgb, "true": step.truth}
        panels.append(side_by_side({name: picture(image) for name, image in images.items()}))
    write_mp4(out / "demo.mp4", panels, FPS)
    chosen: list[int] = []
    for n in sorted(range(len(steps)), key=lambda n: -int(steps[n].completed.view.holes.sum())):
        if len(chosen) < SHEET_ROWS and all(abs(n - other) >= MIN_GAP for other in chosen):
            chosen.append(n)
    write_image(
        out / "contact_sheet.png", contact_sheet([sheet_row(steps[n]) for n in sorted(chosen)], 260, 340)
    )
