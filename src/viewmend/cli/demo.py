"""`viewmend demo`: a procedural scene that moves, seen by a camera that moves, rendered and mended."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from viewmend.leave_one_out.splits import PROCEDURAL_SEEDS

if TYPE_CHECKING:
    from viewmend.evaluation.mending import Fill, MendStep, MendSummary, Metric
    from viewmend.geometry.cameras import Cameras


@dataclass(frozen=True, kw_only=True)
class Options:
    """Render and mend a moving procedural scene, seen by six cameras, from a camera that moves; needs nothing.

    OUT gets demo.mp4 (rendered, mended, truth, side by side) and contact_sheet.png; the table compares
    the holes left black, OpenCV's Telea and the shipped model with the truth.
    """

    out: Path = Path("out/demo")
    """Folder for the results; it is made if it is not there."""
    seed: int = PROCEDURAL_SEEDS["test"][1]
    """Which scene; the same seed gives the same one. Seeds from 10000 on were used for no training."""
    frames: int = 24
    """Length, at 15 a second."""
    size: int = 320
    """Width and height of all images."""
    cameras: int = 6
    """Cameras of the ring."""
    error_rule: str | None = None
    """What is mended: 'unseen', the pixels that no camera colours; 'all' of the subject; 'wrong', what a model takes
    for wrong; or FILE.py:NAME. By default what the model is made for."""
    wrong_fraction: float = 0.15
    """Error rule 'wrong': at most this part of the subject is mended, beside what no camera colours."""
    model: str | None = None
    """A shipped model's name or a model's folder; 'telea' and 'nearest' are the classical fills."""
    json: bool = False
    """Write the table as one JSON object to standard output and nothing else there."""


FPS = 15.0
SWEEP_RAD = 1.6
"""How far the novel camera goes around the subject."""
ELEVATION_RAD = 0.25


def run(options: Options) -> int:
    """Run the command; the exit code."""
    wrong = [name for name in ("frames", "size", "cameras") if getattr(options, name) < 1]
    if wrong:
        raise ValueError(f"expected a positive --{wrong[0]}, got {getattr(options, wrong[0])}; see --help")
    from viewmend.capture.prefetch import prefetch
    from viewmend.cli.checks import load_named
    from viewmend.cli.console import print_json, say, show, track
    from viewmend.cli.demo_output import RESULTS, write_demo
    from viewmend.evaluation.mending import Mender, MendSummary
    from viewmend.output_folder import OutputFolder
    from viewmend.rendering.view import RenderConfig
    from viewmend.studio.stage import Studio, StudioConfig

    render = RenderConfig(error_rule=options.error_rule, wrong_fraction=options.wrong_fraction)
    inpainter = load_named(options.model, "cpu")
    config = StudioConfig(
        seed=options.seed, cameras=options.cameras, frames=options.frames, size_px=options.size, fps=FPS
    )
    studio = Studio(config)
    say(f"on stage: {studio.performer.description}")
    path = _path(options)
    mender = Mender(inpainter, render, studio.bounds)
    summary, steps = MendSummary(), []
    with OutputFolder(options.out) as folder:
        folder.demand_own(*RESULTS)
        for frame in track(prefetch(studio), "mending", options.frames):
            target = path[frame.time]
            steps.append(mender.mend(frame, target, studio.truth(target, frame.time)))
            summary.add(steps[-1])
        files = write_demo(folder.draft, steps, FPS)
        folder.publish(*RESULTS)
    for file in files:
        say(f"wrote {options.out / file.name}")
    if options.json:
        print_json(_report(summary))
    else:
        show(*_table(summary, steps))
    return 0


def _path(options: Options) -> "Cameras":
    """The camera that moves: around the subject and back, a little above the ring."""
    from viewmend.studio.rigs import orbit

    phases = [n / max(1, options.frames) for n in range(options.frames)]
    azimuths = [SWEEP_RAD * (0.5 - 0.5 * math.cos(2 * math.pi * phase)) for phase in phases]
    return orbit(azimuths, (options.size, options.size), elevation_rad=ELEVATION_RAD)


def _report(summary: "MendSummary") -> dict[str, object]:
    fills: tuple[Fill, ...] = ("unfilled", "telea", "unseen", "ours")
    metrics: tuple[Metric, ...] = ("psnr_whole", "psnr_subject", "psnr_holes", "psnr_holes_fg")
    scores = {fill: {metric: summary.mean(fill, metric) for metric in metrics} for fill in fills}
    rest = summary.as_json()
    kept = ("frames", "background", "hole_fraction", "mended_fraction", "ssim_whole", "alpha_iou", "stage_ms")
    return scores | {key: rest[key] for key in kept}


def _table(summary: "MendSummary", steps: "list[MendStep]") -> list[str]:
    from viewmend.cli.console import in_db

    holes = sum(int(s.completed.view.holes.sum()) for s in steps)
    lines = [f"{len(steps)} frames, {holes} missing pixels; PSNR upon {summary.background} in dB against the truth:"]
    lines.append("              whole image   holes   holes on the subject")
    rows: list[tuple[str, Fill]] = [("left black", "unfilled"), ("Telea", "telea"), ("viewmend", "ours")]
    for label, fill in rows:
        whole, inside = summary.mean(fill, "psnr_whole"), summary.mean(fill, "psnr_holes")
        subject = summary.mean(fill, "psnr_holes_fg")
        lines.append(f"  {label:<12}      {in_db(whole)}   {in_db(inside)}                  {in_db(subject)}")
    stages = ", ".join(f"{name} {ms:.1f} ms" for name, ms in summary.stage_ms().items())
    return [*lines, f"a frame takes {stages}"]
