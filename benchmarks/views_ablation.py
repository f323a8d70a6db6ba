"""What each part of the reader of whole views is worth: python benchmarks/views_ablation.py SHARDS OUT [--write].

Each variant learns from nothing by as many steps on the same stored scenes, less one thing, and is judged on whole
views that a camera saw (`whole_views.py`). A variant that OUT holds is not trained again; one that was stopped goes on.
"""

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

from jaxtyping import Bool, Float
from measure import write
from torch import Tensor, nn
from torch.nn import functional as F
from whole_views import judge, some

from viewmend.inpainting.sweep.sweep_net import SweepNet
from viewmend.inpainting.sweep.unet import UNet
from viewmend.training import whole_view_objective
from viewmend.training.loop import train
from viewmend.training.plan import DataPlan, ViewLossWeights, WholeViewRecipe
from viewmend.training.recipes import views
from viewmend.training.sample_files import shards_of
from viewmend.training.whole_view_run import WholeViewRun
from viewmend.training.whole_views import WholeView

BASE = ViewLossWeights(log_error=0.4, gradient=0.3, errors=0.0)
COLOURS_ALONE = replace(BASE, place=0.0, visible=0.0)
VARIANTS = (
    "as it is",
    "colours and alpha alone",
    "pixels each by itself",
    "holes alone",
    "1 shard",
    "10 shards",
)
"""What the loss knows, the convolutions over the view, the pixels that are learned from, and the scenes."""


def main() -> None:
    """Train what is missing, and judge all."""
    parser = argparse.ArgumentParser(description="What each part of the reader of whole views is worth.")
    parser.add_argument("shards", type=Path, help="as `viewmend samples views` wrote them")
    parser.add_argument("out", type=Path, help="folder of a run for each variant")
    parser.add_argument("--variants", nargs="+", default=VARIANTS, choices=VARIANTS)
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--sets", nargs="+", default=["P"], help="as of whole_views.py")
    parser.add_argument("--views", type=int, default=8, help="so many of each set")
    parser.add_argument("--write", action="store_true", help="keep the result under benchmarks/results")
    options = parser.parse_args()
    found: dict[str, dict[str, dict[str, float | None]]] = {name: {} for name in options.sets}
    for variant in options.variants:
        folder = options.out / variant.replace(" ", "-")
        with changed(variant):
            learn(variant, options.shards, folder, options.steps)
            for name, scores in found.items():
                own = judge(some(name, 320, options.views), [f"{folder}!"], None)
                scores[variant] = own[f"{folder}!"]
    if options.write:
        print(write("views_ablation", "cpu", {"steps": options.steps, "views": options.views}, found))


def learn(variant: str, shards: Path, folder: Path, steps: int) -> None:
    """Train a variant, if `folder` has not got it."""
    weights = COLOURS_ALONE if variant == "colours and alpha alone" else BASE
    count = int(variant.split()[0]) if variant.endswith(("shard", "shards")) else None
    recipe = views(DataPlan(shards=_few(shards, folder.parent, count)))
    assert isinstance(recipe, WholeViewRecipe)
    recipe = replace(
        recipe, model=replace(recipe.model, error_features=0), view_loss=weights, steps=steps, minutes=None, workers=0
    )
    train(replace(recipe, validate_every=0, warmup=50, ema=0.98), folder, None, _told(variant), WholeViewRun)


def _told(variant: str) -> Callable[[object], None]:
    return lambda progress: print(variant, progress, flush=True) if getattr(progress, "step", 1) % 50 == 0 else None


def _few(shards: Path, out: Path, count: int | None) -> Path:
    """A folder with the first of the shards; all of them without a count."""
    if count is None:
        return shards
    folder = out / f"{count}-of-the-shards"
    folder.mkdir(parents=True, exist_ok=True)
    for path in shards_of(shards)[:count]:
        if not (folder / path.name).exists():
            (folder / path.name).symlink_to(path.resolve())
    return folder


@contextmanager
def changed(variant: str) -> Iterator[None]:
    """While it lasts, models are made and taught as the variant says."""
    if variant == "pixels each by itself":
        with patch.object(SweepNet, "__init__", one_by_one(SweepNet.__init__)):
            yield
    elif variant == "holes alone":
        with patch.object(whole_view_objective, "random_part", holes):
            yield
    else:
        yield


def holes(window: WholeView) -> Bool[Tensor, "height width"] | None:
    """The pixels that are missing; None, for all, where there are none."""
    return window.view.holes if bool(window.view.holes.any()) else None


class OneByOne(UNet):
    """Looks at one cell alone."""

    def __init__(self, channels: int, width: int) -> None:
        super().__init__(channels, width)
        self.first = _layers(width, width, width)
        self.down = self.up = self.join = nn.ModuleList()

    def across(self, x: Float[Tensor, "1 feature height width"]) -> Float[Tensor, "1 feature height width"]:
        return F.relu(self.first(x))


def one_by_one(make: Callable[..., None]) -> Callable[..., None]:
    """`SweepNet.__init__` whose convolutions look at one cell, or one pixel, alone."""

    def init(self: SweepNet, *arguments: object) -> None:
        make(self, *arguments)
        first, *_, last = self.finish
        assert isinstance(first, nn.Conv2d) and isinstance(last, nn.Conv2d), "convolutions from one end to the other"
        self.decide = OneByOne(self.decide.enter.in_channels, self.config.features)
        self.finish = _layers(first.in_channels, self.config.fine_features, last.out_channels)

    return init


def _layers(told: int, hidden: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(told, 2 * hidden, 1), nn.ReLU(), nn.Conv2d(2 * hidden, outputs, 1))


if __name__ == "__main__":
    main()
