"""`viewmend train`: run a recipe, or go on with a run."""

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

if TYPE_CHECKING:
    from torch import nn

    from viewmend.training.logs import Progress
    from viewmend.training.loop import Run
    from viewmend.training.plan import Recipe

LINE_EVERY = 20
"""Steps between lines where there is no terminal."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """Train a model; --out gets its averaged weights, a log, pictures, and what it takes to go on.

    The same command goes on with a run that was stopped, at any moment and in any way. Under torchrun the same
    command uses many processes and machines.
    """

    recipe: Annotated[str, tyro.conf.Positional] = "small"
    """Name of the recipe: small, small_rays, base, paper, finetune; or a published network's, to fine-tune it: dstt,
    fuseformer, e2fgvi, e2fgvi-hq."""
    out: Path = Path("out/train")
    """Folder for all that is written."""
    start: Annotated[str | None, tyro.conf.arg(name="from")] = None
    """Name or folder of a model to begin with (small and finetune: the shipped small by default). For a published
    network its checkpoint, a run's folder, or pretrained for the file among the known weights; else, random weights."""
    performers: Path | None = None
    """Folder of glTF characters for a share of the scenes; never one that is kept for tests."""
    motions: Path | None = None
    """Folder of BVH motions for them."""
    capture: tuple[Path, ...] = ()
    """Folders of captures of your own to learn from."""
    cameras: tuple[int, int] | None = None
    """Fewest and most cameras of the studio's rigs, for rigs like yours; 4 to 60."""
    shards: Path | None = None
    """Folder that `viewmend samples` wrote; samples come from there alone."""
    data_device: str | None = None
    """Where samples are made, e.g. cuda; goes with --workers 0 then."""
    steps: int | None = None
    """Instead of the recipe's; so are all below."""
    minutes: float | None = None
    batch: int | None = None
    streams: int | None = None
    workers: int | None = None
    learning_rate: float | None = None
    bfloat16: bool | None = None
    """Mixed precision; the published networks' authors train in float32."""
    size_px: tuple[int, int] | None = None
    """Height and width that a published network sees in training: 240 432 by default, parts of that for short runs."""
    checkpoint_every: int | None = None
    validate_every: int | None = None
    part: Literal["rays", "patches", "all"] | None = None
    log_error: float | None = None
    """Weight of the logarithm of the squared error in the holes."""
    adversarial: float | None = None
    """Weight of L_adv; the paper's is 0.01."""
    adversarial_kind: Literal["gan", "hinge"] | None = None
    discriminator: Literal["image", "clip"] | None = None
    """What judges: single images, or clips (--clip)."""
    clip: int | None = None
    """Consecutive times in a sample."""
    temporal: float | None = None
    """Weight of the difference between consecutive outputs, warped."""
    perceptual: float | None = None
    """Weight of VGG16's features; needs --perceptual-weights."""
    perceptual_weights: Path | None = None
    """File of torchvision's vgg16."""
    varied: bool | None = None
    """Vary what small_rays looked up, anew each time it is seen: for few samples and many steps."""
    seed: int = 0
    """Of weights and scenes."""


def run(options: Options) -> int:
    """Train, with a bar on a terminal, else a line every twenty steps."""
    import os

    import torch

    from viewmend.cli.console import say
    from viewmend.inpainting.chain import build
    from viewmend.training.loop import NETWORKS, fitting_weights, train

    start, kind = _start(options)
    recipe = chosen_recipe(options, start)
    if isinstance(start, NETWORKS):
        with torch.device("meta"):
            wanted = build(recipe.model)
        fitting, count = len(fitting_weights(wanted, start)), len(wanted.state_dict())
        if 0 < fitting < count:
            say(f"{fitting} of {count} tensors begin as {options.start or 'small'} has them, the others at random")
    with _Reporter(recipe.steps) as reporter:
        try:
            train(recipe, options.out, start, reporter.report, kind)
        except FloatingPointError as error:
            raise ValueError(str(error)) from error
    if os.environ.get("RANK", "0") == "0":  # torchrun's other processes report no steps
        say(f"wrote {options.out}" if reporter.steps else f"{options.out}: this run was finished before; nothing to do")
    return 0


def _start(options: Options) -> "tuple[nn.Module | None, type[Run]]":
    """What to begin with, and what kind of run it is."""
    from viewmend.baselines.published import NETWORKS, load_baseline
    from viewmend.inpainting.checkpoint import load_network
    from viewmend.training.baseline_run import BaselineRun
    from viewmend.training.loop import Run

    name = options.start or ("small" if options.recipe in ("small", "finetune") else None)
    if options.recipe not in NETWORKS:
        return load_network(name) if name is not None else None, Run
    weights = "" if name == "pretrained" else f"@{name}"
    return load_baseline(options.recipe, weights) if name is not None else None, BaselineRun


def chosen_recipe(options: Options, start: "nn.Module | None") -> "Recipe":
    """The recipe with what the options change.

    Raises:
        ValueError: no such recipe, or options that do not go together.
    """
    from viewmend.baselines.published import NETWORKS
    from viewmend.cli.checks import check_device, check_people
    from viewmend.training.baseline_run import baseline_recipe
    from viewmend.training.loop import NETWORKS as OURS
    from viewmend.training.plan import DataPlan
    from viewmend.training.recipes import RECIPES, for_model

    networks = {name: partial(baseline_recipe, name, started=start is not None) for name in NETWORKS}
    recipes = RECIPES | networks
    if options.recipe not in recipes:
        raise ValueError(f"expected a recipe among {', '.join(recipes)}, got '{options.recipe}'; see --help")
    if options.recipe == "finetune" and not (options.capture or options.shards):
        raise ValueError("expected --capture DIR for finetune, got none; name the folder of your capture")
    if options.size_px and options.recipe not in NETWORKS:
        raise ValueError(
            f"expected --size-px with {', '.join(NETWORKS)} alone, got it with {options.recipe}; leave it out"
        )
    if options.cameras is not None and not 4 <= options.cameras[0] <= options.cameras[1] <= 60:
        raise ValueError(f"expected --cameras of 4 to 60, the fewer first, got {options.cameras}; for example 6 8")
    check_people(options.performers, options.motions)
    check_device(options.data_device or "cpu")
    data = DataPlan(
        performers=options.performers,
        motions=options.motions,
        captures=options.capture,
        shards=options.shards,
        device=options.data_device or "cpu",
        clip=1 if options.clip is None else options.clip,
    )
    recipe = recipes[options.recipe](data)
    recipe = replace(recipe, data=replace(recipe.data, cameras=options.cameras or recipe.data.cameras))
    if options.recipe == "finetune" and isinstance(start, OURS):
        recipe = replace(recipe, model=start.config, data=for_model(start.config, recipe.data))
    loss = {n: getattr(options, n) for n in recipe.loss.__dataclass_fields__ if n != "image"}
    own = ("steps", "minutes", "batch", "streams", "workers", "learning_rate", "bfloat16", "part", "checkpoint_every")
    values = {n: getattr(options, n) for n in (*own, "validate_every", "varied", "size_px")}
    return replace(
        recipe,
        seed=options.seed,
        fresh=recipe.fresh if options.batch is None else max(1, min(recipe.fresh, options.batch)),
        loss=replace(recipe.loss, **{n: v for n, v in loss.items() if v is not None}),
        **{n: v for n, v in values.items() if v is not None},
    )


class _Reporter:
    """Shows a run: a bar where there is a terminal, else a line now and then."""

    def __init__(self, total: int) -> None:
        import sys

        self.steps = 0
        self._total = total
        self._live = sys.stderr.isatty()

    def __enter__(self) -> "_Reporter":
        if self._live:
            from rich.console import Console
            from rich.progress import BarColumn, Progress, TextColumn

            columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[text]}"))
            self._bar = Progress(*columns, console=Console(stderr=True))
            self._bar.start()
            self._task = self._bar.add_task("training", total=1.0, text="making the first samples")
        return self

    def __exit__(self, *_: object) -> None:
        if self._live:
            self._bar.stop()

    def report(self, progress: "Progress") -> None:
        """One more step."""
        from viewmend.cli.console import say

        self.steps += 1
        if self._live:
            self._bar.update(self._task, completed=progress.progress, text=_line(progress))
        elif progress.step % LINE_EVERY == 0:
            say(_line(progress))


def _line(progress: "Progress") -> str:
    pace = progress.pace
    left = "?" if pace.eta_s is None else f"{pace.eta_s / 60:.0f} min"
    return (
        f"step {progress.step}, {100 * progress.progress:.0f} %, {left} left: L_in {progress.costs.inside:.4f}, "
        f"L_out {progress.costs.outside:.4f}, {pace.samples_per_s:.1f} samples/s, {100 * pace.waiting:.0f} % waiting"
    )
