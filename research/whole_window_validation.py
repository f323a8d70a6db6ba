"""Compares weights of the paper's model, and numbers of context tokens, on validation views with whole windows.

    python research/whole_window_validation.py --data DATA
    python research/whole_window_validation.py --data DATA --weights paper-small RUN
    python research/whole_window_validation.py --data DATA --top-k 512 256 1024 0

The views are unseen by every training: rigs of 48 cameras in three layers at 512 x 512, a quarter of them held out
together, and procedural people reserved for validation. The true masks M_t are known, as in R48, whose
scenes are for tests. DATA keeps the views once they are made, which takes about half a minute of one core for a scene,
and `plan.txt`, what they were made of.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from statistics import fmean, median, stdev

import torch
import tyro

from viewmend.metrics.image_quality import psnr
from viewmend.models.base import ContextProvider
from viewmend.models.checkpoint import load_network
from viewmend.models.classical import Telea
from viewmend.models.compositing import composite
from viewmend.models.paper.patch_transformer import PatchTransformer
from viewmend.training.paper import PaperObjectiveConfig
from viewmend.training.recipes import make_recipe
from viewmend.training.samples import Sample, true_image
from viewmend.training.shards import read_shard, shards_of, write_shards
from viewmend.training.shared_rigs import SharedRigScenes
from viewmend.utils.atomic_writes import write_text

CAMERAS = 48
"""Cameras of each rig, as in R48."""
MIN_HOLE_PX = 200
"""Views have at least this many hole pixels inside the true mask, as those of R48."""
ALL_TOKENS = 2**31
"""More context tokens than any window has."""
PLAN = "plan.txt"
"""File with everything that determines the views of a folder."""
SEED = "whole-windows"
"""Determines the rigs and the choice of people; their own seeds are those reserved for validation."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """Score the paper's model on validation views with whole windows."""

    data: Path
    """Folder of the views; missing scenes are made and written there."""
    weights: tuple[str, ...] = ("paper-small",)
    """Names or folders of models. Differences are from the first, with the first --top-k."""
    top_k: tuple[int, ...] = ()
    """Numbers of context tokens to keep; 0 keeps all. Without it, each model's own number."""
    present: bool = False
    """Also score each model with the cameras of the present frame alone, and the first --top-k."""
    scenes: int = 12
    """Scenes to score."""
    holdout_views: int = 3
    """Views of a scene at most."""


@dataclass(frozen=True)
class Variant:
    """A model with a number of tokens and a context."""

    weights: str
    top_k: int | None
    """Context tokens kept; 0 for all, None for the model's own number."""
    present: bool
    """Whether the context is the present frame alone."""

    @property
    def title(self) -> str:
        """A name for the table."""
        tokens = {None: "own k", 0: "all tokens"}.get(self.top_k, f"k = {self.top_k}")
        return f"{self.weights}, {tokens}, {'present frame' if self.present else 'whole window'}"


@dataclass(frozen=True)
class Scored:
    """Scores of a variant."""

    by_scene: tuple[float, ...]
    """PSNR in the holes inside M_t, dB: the mean over each scene's views."""
    seconds: float
    """Median processor time of a view whose camera images were encoded before."""


def make_views(options: Options) -> list[Path]:
    """A file with the views of each scene, numbered as its rig; those that are not in the folder yet are made.

    Raises:
        ValueError: the folder has views that were made with other options, or without a plan.
    """
    shards = shards_of(options.data) if options.data.exists() else []
    source = validation_scenes(options.holdout_views)
    plan = f"{source.seed}, {MIN_HOLE_PX} hole pixels, {source.config}, {source.sampling}\n"
    file = options.data / PLAN
    if not shards:
        options.data.mkdir(parents=True, exist_ok=True)
        write_text(file, plan)
    elif not file.is_file() or file.read_text("utf-8", "replace") != plan:
        raise ValueError(
            f"{options.data}: expected views made with the same options (--holdout-views), got others; choose another "
            "--data"
        )
    first = 1 + int(shards[-1].stem.split("-")[1]) if shards else 0
    for number in count(first):
        if len(shards) >= options.scenes:
            break
        samples = with_true_masks(source.scene(number))
        if samples:
            shards += write_shards(samples, options.data, len(samples), first=number)
            print(f"rig {number}: {len(samples)} views", flush=True)
    return shards[: options.scenes]


def validation_scenes(holdout_views: int) -> SharedRigScenes:
    """Scenes of the recipe `paper-small` with whole windows, from rigs like those of R48."""
    recipe = make_recipe("paper-small")
    assert isinstance(recipe.objective, PaperObjectiveConfig)
    scenes = replace(
        recipe.scenes,
        cameras=(CAMERAS, CAMERAS),
        rigs=("layers",),
        few_cameras_fraction=0.0,
        protocols=("target-mask",),
        num_holdout_views=holdout_views,
    )
    sampling = replace(recipe.objective.sampling, window_fraction=1.0, min_hole_px=MIN_HOLE_PX)
    return SharedRigScenes(scenes, sampling, SEED, "validation")


def with_true_masks(samples: Sequence[Sample]) -> list[Sample]:
    """The samples with the true mask as M_t, if it leaves enough holes; some masks of the recipe are wrong."""
    found = []
    for sample in samples:
        assert sample.alpha is not None, "the studio draws masks"
        view = replace(sample.view, target_mask=sample.alpha.float() / 255)
        if int((view.missing > 0).sum()) >= MIN_HOLE_PX:
            found.append(replace(sample, view=view))
    return found


@torch.no_grad()
def score(model: PatchTransformer, variants: Sequence[Variant], scenes: Sequence[Path]) -> list[Scored]:
    """Scores of variants that share a model's weights; each camera image is encoded once."""
    decibels: list[list[float]] = [[] for _ in variants]
    seconds: list[list[float]] = [[] for _ in variants]
    for scene in scenes:
        of_views: list[list[float]] = [[] for _ in variants]
        for sample in read_shard(scene):
            truth = true_image(sample, model.config.background)
            window = model.encode_windows([sample.view], [sample.context])[0]
            for variant, own_db, own_s in zip(variants, of_views, seconds, strict=True):
                frames = [f for f in window if f.time == sample.view.time] if variant.present else window
                top_k = ALL_TOKENS if variant.top_k == 0 else variant.top_k
                began = time.process_time()
                completed = model([sample.view], [frames], top_k)[0].composited
                own_s.append(time.process_time() - began)
                own_db.append(hole_psnr(completed.clamp(0, 1), sample, truth))
        for own, own_db in zip(decibels, of_views, strict=True):
            own.append(fmean(own_db))
    return [Scored(tuple(own), median(own_s)) for own, own_s in zip(decibels, seconds, strict=True)]


def score_telea(scenes: Sequence[Path]) -> tuple[float, ...]:
    """The same figure of OpenCV's Telea by scene, on white."""
    telea = Telea()
    found = []
    for scene in scenes:
        of_views = []
        for sample in read_shard(scene):
            none = ContextProvider(lambda *_: None)
            filled, _ = telea.step_on("white", sample.view, none, telea.initial_state())
            image = composite("white", filled.rgb, filled.opacity)
            of_views.append(hole_psnr(image, sample, true_image(sample, "white")))
        found.append(fmean(of_views))
    return tuple(found)


def hole_psnr(image: torch.Tensor, sample: Sample, truth: torch.Tensor) -> float:
    """PSNR in the holes inside M_t, dB."""
    decibels = psnr(image, truth, sample.view.missing > 0)
    assert decibels is not None, "the views have holes"
    return decibels


def mean_and_error(values: Sequence[float]) -> tuple[float, float]:
    """Mean and its standard error, which is NaN for a single value."""
    error = stdev(values) / len(values) ** 0.5 if len(values) > 1 else float("nan")
    return fmean(values), error


def main(options: Options) -> None:
    """Print one row for each variant, and one for Telea."""
    scenes = make_views(options)
    hole_px = [int((sample.view.missing > 0).sum()) for scene in scenes for sample in read_shard(scene)]
    print(f"{len(scenes)} scenes, {len(hole_px)} views with {median(hole_px):.0f} hole pixels (median)")
    print("PSNR in the holes in dB, means over scenes with standard errors\n")
    print("| variant | holes | difference from the first | better in | processor s of a view |")
    print("| --- | --- | --- | --- | --- |")
    reference: tuple[float, ...] | None = None
    tokens = options.top_k or (None,)
    for name in options.weights:
        model = load_network(name)
        if not isinstance(model, PatchTransformer):
            raise ValueError(
                f"expected a model of the paper, got {name}; name paper-small or the folder of a run"
            )
        variants = [Variant(name, k, present=False) for k in tokens]
        variants += [Variant(name, tokens[0], present=True)] if options.present else []
        scored = score(model, variants, scenes)
        for variant, own in zip(variants, scored, strict=True):
            reference = reference or own.by_scene
            print_row(variant.title, own.by_scene, reference, f"{own.seconds:.2f}")
    assert reference is not None, "there is a model"
    print_row("Telea", score_telea(scenes), reference, "")


def print_row(title: str, by_scene: Sequence[float], reference: Sequence[float], seconds: str) -> None:
    """Print a row of the table."""
    mean, error = mean_and_error(by_scene)
    gains = [own - first for own, first in zip(by_scene, reference, strict=True)]
    gain, gain_error = mean_and_error(gains)
    better = sum(own > 0 for own in gains)
    cells = [title, f"{mean:.2f} ± {error:.2f}", f"{gain:+.2f} ± {gain_error:.2f}"]
    cells += [f"{better} of {len(gains)}", seconds]
    print(f"| {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    torch.set_num_threads(1)
    main(tyro.cli(Options))
