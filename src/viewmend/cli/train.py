"""`viewmend train`: run a recipe, or go on with a run."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from viewmend.cli import recipe_options
from viewmend.training.plan import FLAT, Recipe

if TYPE_CHECKING:
    from torch import nn

    from viewmend.training.logs import Progress
    from viewmend.training.loop import Run


@dataclass(frozen=True, kw_only=True)
class Options:
    """Train a model: viewmend train RECIPE --out DIR [--from MODEL] [options].

    RECIPE is small (the default), small_rays, views, base, paper, paper_small, windows, autoencoder, copies, tokens or
    finetune; or a published network's, to fine-tune it: dstt, fuseformer, e2fgvi, e2fgvi-hq. Every value of the
    recipe is an option; defaults are the recipe's. DIR gets the averaged weights, a log, pictures, and what it
    takes to go on: the same command goes on with a run that was stopped, at any moment and in any way. Under
    torchrun the same command uses many processes and machines.
    """

    recipe: Annotated[Recipe, FLAT]
    out: Path = Path("out/train")
    """Folder for all that is written."""
    start: Annotated[str | None, tyro.conf.arg(name="from")] = None
    """Name or folder of a model to begin with (small and finetune: the shipped small by default). For a published
    network its checkpoint, a run's folder, or pretrained for the file among the known weights; else, random weights."""


def parse(arguments: Sequence[str], prog: str) -> Options:
    """The options of a command line that begins with a recipe."""
    return recipe_options.parse(Options, arguments, prog)


def run(options: Options) -> int:
    """Train, with a bar on a terminal, else a line every half minute; Ctrl-C and SIGTERM end it with a checkpoint."""
    import os

    import torch

    from viewmend.cli.console import say
    from viewmend.cli.signals import stop_requests
    from viewmend.inpainting.chain import build
    from viewmend.training.loop import NETWORKS, fitting_weights, train

    recipe = options.recipe
    start, kind = _start(options)
    if isinstance(start, NETWORKS):
        with torch.device("meta"):
            wanted = build(recipe.model)
        fitting, count = len(fitting_weights(wanted, start, recipe.anew)), len(wanted.state_dict())
        if 0 < fitting < count:
            begun = recipe_options.started_from(recipe, options.start)
            say(f"{fitting} of {count} tensors begin as {begun} has them, the others at random")
    with _Reporter(recipe.steps) as reporter, stop_requests() as stopped:
        try:
            train(recipe, options.out, start, reporter.report, kind, lambda: stopped() > 0)
        except FloatingPointError as error:
            raise ValueError(str(error)) from error
    if number := stopped():
        say(f"{options.out}: stopped after step {reporter.last}, which is kept; the same command goes on from there")
        return 128 + number
    if os.environ.get("RANK", "0") == "0":  # torchrun's other processes report no steps
        say(f"wrote {options.out}" if reporter.steps else f"{options.out}: this run was finished before; nothing to do")
    return 0


def _start(options: Options) -> "tuple[nn.Module | None, type[Run]]":
    """What to begin with, and what kind of run it is."""
    from viewmend.baselines.published import NETWORKS, load_baseline
    from viewmend.inpainting.checkpoint import load_network
    from viewmend.training.baseline_run import BaselineRun
    from viewmend.training.loop import Run
    from viewmend.training.plan import WholeViewRecipe
    from viewmend.training.whole_view_run import WholeViewRun

    name = recipe_options.started_from(options.recipe, options.start)
    if options.recipe.name not in NETWORKS:
        kind = WholeViewRun if isinstance(options.recipe, WholeViewRecipe) else Run
        return load_network(name) if name is not None else None, kind
    weights = "" if name == "pretrained" else f"@{name}"
    return load_baseline(options.recipe.name, weights) if name is not None else None, BaselineRun


class _Reporter:
    """Shows a run: a bar where there is a terminal, else a line every half minute."""

    def __init__(self, total: int) -> None:
        import sys

        from viewmend.cli.console import Heartbeat

        self.steps = self.last = 0
        self._total = total
        self._live = sys.stderr.isatty()
        self._heartbeat = Heartbeat("making the first samples")

    def __enter__(self) -> "_Reporter":
        if self._live:
            from rich.console import Console
            from rich.progress import BarColumn, Progress, TextColumn

            columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[text]}"))
            self._bar = Progress(*columns, console=Console(stderr=True))
            self._bar.start()
            self._task = self._bar.add_task("training", total=1.0, text="making the first samples")
        else:
            self._heartbeat.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live:
            self._bar.stop()
        else:
            self._heartbeat.__exit__()

    def report(self, progress: "Progress") -> None:
        """One more step."""
        self.steps, self.last = self.steps + 1, progress.step
        self._heartbeat.text = _line(progress)
        if self._live:
            self._bar.update(self._task, completed=progress.progress, text=_line(progress))


def _line(progress: "Progress") -> str:
    pace = progress.pace
    left = "?" if pace.eta_s is None else f"{pace.eta_s / 60:.0f} min"
    return (
        f"step {progress.step}, {100 * progress.progress:.0f} %, {left} left: L_in {progress.losses.inside:.4f}, "
        f"L_out {progress.losses.outside:.4f}, {pace.samples_per_s:.1f} samples/s, {100 * pace.waiting:.0f} % waiting"
    )
