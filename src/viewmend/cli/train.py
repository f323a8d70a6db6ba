"""`viewmend train`: run a recipe, or resume a run."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from viewmend.training.config import SceneConfig, TrainConfig
from viewmend.utils.options import FLAT

if TYPE_CHECKING:
    from collections.abc import Mapping

    from viewmend.training.run_files import Progress

OVERFIT_DB = 0.2
"""A run that gains this much more, in dB, on its training views than on new views memorises its samples."""
DEFAULT = "views"
"""The recipe if none is named."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """Train a model: viewmend train RECIPE --out DIR [options].

    RECIPE is one of: views (the default model), rays (its ray fill), paper and paper-small (the
    paper's model), finetune CAPTURE (adapts a trained model to your own capture), or a published
    baseline: dstt, fuseformer, e2fgvi, e2fgvi-hq. Each recipe has its own defaults. DIR gets the
    averaged weights, a log, validation images and checkpoints; the same command resumes an
    interrupted run, and torchrun distributes it over processes and machines.
    """

    config: Annotated[TrainConfig, FLAT]
    out: Path = Path("out/train")
    """Folder for all files of the run."""


def parse(arguments: Sequence[str], prog: str) -> Options:
    """The options of a command line that begins with a recipe, `views` by default.

    Raises:
        ValueError: there is no such recipe, or an option has an impossible value.
    """
    import tyro

    from viewmend.training.recipes import make_recipe

    name, rest = split_recipe(arguments)
    if name == "finetune" and rest and not rest[0].startswith("-"):
        rest = ["--captures", *rest]
    words = [part for word in rest for part in (word.split("=", 1) if word.startswith("--from=") else [word])]
    start = next((after for word, after in pairwise(words) if word == "--from"), None)
    flags = (tyro.conf.FlagCreatePairsOff, tyro.conf.AvoidSubcommands)
    default = Options(config=make_recipe(name, start))
    usage = f"{prog} {name} CAPTURE" if name == "finetune" else f"{prog} {name}"
    options = tyro.cli(Options, args=list(rest), default=default, prog=usage, config=flags)
    config = options.config
    if name == "finetune" and not (config.scenes.captures or config.shards):
        raise ValueError("expected viewmend train finetune CAPTURE, got no capture; give its folder")
    check_scenes(config.scenes)
    return options


def split_recipe(arguments: Sequence[str]) -> tuple[str, Sequence[str]]:
    """The recipe that a command line begins with, and the rest."""
    if arguments and not arguments[0].startswith("-"):
        return arguments[0], arguments[1:]
    return DEFAULT, arguments


def check_scenes(scenes: SceneConfig) -> None:
    """Raise ValueError if such scenes cannot be made on this machine."""
    from viewmend.cli.checks import check_people

    if not 4 <= scenes.cameras[0] <= scenes.cameras[1] <= 60:
        raise ValueError(f"expected --cameras MIN MAX of 4 to 60, got {scenes.cameras}; for example 6 8")
    check_people(scenes.performers, scenes.motions)


def run(options: Options) -> int:
    """Train, with a line of progress every half minute; Ctrl-C and SIGTERM end the run with a checkpoint."""
    import os
    from contextlib import nullcontext

    from viewmend.cli.console import Heartbeat, say, stop_requests
    from viewmend.training.loop import train

    steps: list[Progress] = []

    def report(step: "Progress") -> None:
        steps[:] = [step]

    first = os.environ.get("RANK", "0") == "0"  # torchrun's other processes report no steps
    if first:
        _announce_held_out(options.config)
    began_s = time.monotonic()
    heartbeat = Heartbeat(lambda: _line(steps[0]) if steps else "making the first samples")
    with heartbeat if first else nullcontext(), stop_requests() as stopped:
        try:
            train(options.config, options.out, report=report, stopped=lambda: stopped() > 0)
        except FloatingPointError as error:
            raise ValueError(str(error)) from error
    trained_s = time.monotonic() - began_s
    if number := stopped():
        if first:
            done = f" after step {steps[0].step}" if steps else ""
            say(f"{options.out}: stopped{done}; run the same command to resume")
        return 128 + number
    if first:
        say(f"wrote {options.out}" if steps else f"{options.out}: this run is complete; nothing to do")
        _show_gain(options, trained_s)
    return 0


def _announce_held_out(config: TrainConfig) -> None:
    """Print which camera and frames are held out, and what the time limit includes."""
    from viewmend.cli.console import say
    from viewmend.training.held_back import open_training_captures

    hold_out = config.scenes.hold_out
    if hold_out is None or not config.scenes.captures:
        return
    for place in config.scenes.captures:
        for opened in open_training_captures(place, hold_out):
            assert opened.held_back is not None, "something is held out"
            say(opened.held_back.describe(opened.source))
    if config.minutes is not None:
        say(f"training takes up to {config.minutes:g} minutes; scoring views of each camera comes after them")


def _show_gain(options: Options, trained_s: float) -> None:
    """Print what fine-tuning kept and why, and the scores before and after by camera; write a contact sheet."""
    scenes = options.config.scenes
    start = options.config.start
    if scenes.hold_out is None or start is None or not scenes.captures:
        return
    from viewmend.cli.console import say
    from viewmend.models.checkpoint import load_inpainter
    from viewmend.training.held_back import KeptWeights, compare
    from viewmend.training.run_files import read_validations

    kept = KeptWeights.of(read_validations(options.out))
    for text in [] if kept is None else kept.describe(start, options.config.validate_every):
        print(text)
    sheet = options.out / "comparison.png"
    say("scoring views of each camera")
    began_s = time.monotonic()
    models = {"before": load_inpainter(start), "after": load_inpainter(options.out)}
    if kept is not None and kept.step == 0:  # both are the same
        models = {"completed": models["before"]}
    print(compare(scenes.captures[0], scenes.hold_out, models, sheet))
    print(f"PSNR of whole views in dB, LPIPS around the subject; the views: {sheet}")
    compared_s = time.monotonic() - began_s
    print(f"took {trained_s / 60:.1f} minutes of training and {compared_s / 60:.1f} of scoring views")


def _line(progress: "Progress") -> str:
    return (
        f"step {progress.step}, {100 * progress.progress:.0f} %, {progress.eta_s / 60:.0f} min left: "
        f"L_in {progress.losses['inside']:.4f}, L_out {progress.losses['outside']:.4f}, "
        f"{progress.samples_per_s:.1f} samples/s, {100 * progress.waiting:.0f} % waiting"
        f"{validation_text(progress.validation)}"
    )


def validation_text(scores: "Mapping[str, float | None]") -> str:
    """The latest scores, with a warning if the run overfits; "" without a validation."""
    from viewmend.training.objective import NEW_VIEWS_SCORE, TRAINED_SCORE

    unseen = scores.get("holes")
    seen = scores.get(TRAINED_SCORE)
    alike = scores.get(NEW_VIEWS_SCORE)
    overfit = scores.get("overfit")
    if unseen is None:
        return ""
    if seen is None or alike is None:
        return f"; validation {unseen:.2f} dB"
    text = (
        f"; validation {unseen:.2f} dB on new people, {alike:.2f} on new views of the training's people, "
        f"{seen:.2f} on the training's views"
    )
    if overfit is not None and overfit > OVERFIT_DB:
        text += f" (these gained {overfit:.2f} dB more than new views: the run memorises its samples)"
    return text
