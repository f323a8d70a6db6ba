"""The recipes. Each is a function of a few lines: what differs from the defaults is all that it states."""

from collections.abc import Callable
from dataclasses import replace

from viewmend.inpainting.config import InpainterConfig
from viewmend.inpainting.config import base as base_model
from viewmend.inpainting.config import paper as paper_model
from viewmend.inpainting.config import paper_small as paper_small_model
from viewmend.inpainting.config import small as small_model
from viewmend.inpainting.sweep.config import SweepConfig
from viewmend.training.plan import DataPlan, LossWeights, Recipe, WholeViewRecipe


def small(data: DataPlan) -> Recipe:
    """The small model's patches, for two CPU cores and less than an hour, upon what `small_rays` made."""
    return Recipe(
        name="small",
        model=small_model(),
        data=for_model(small_model(), data),
        loss=LossWeights(log_error=0.5),
        steps=1500,
        minutes=40.0,
        part="patches",
    )


def small_rays(data: DataPlan) -> Recipe:
    """The small model's ray reader, alone, on looked-up pixels. Thin holes of dense rigs count, too.

    A moment of each scene: many scenes teach more than many views of few.
    """
    dense = replace(data, context=False, cameras=(6, 20), min_hole_px=15, imperfect_fraction=0.8)
    dense = replace(dense, rough_fraction=0.5, dropped_fraction=0.1, widened_fraction=0.15)
    dense = replace(dense, times=(0,), held_cameras=5, targets_per_camera=1)
    return replace(
        small(data),
        name="small_rays",
        data=for_model(small_model(), dense, sizes_px=(224, 320, 416, 576)),
        part="rays",
        loss=LossWeights(log_error=2.0),
        steps=10_000,
        minutes=60.0,
        batch=16,
        new_per_batch=4,
        replay_size=600,
        pixels_per_view=64,
        learning_rate=1e-3,
        ema=0.998,
    )


def views(data: DataPlan) -> WholeViewRecipe:
    """The reader of whole views, on stored scenes: every pixel of the subject, with alpha and depth."""
    plan = replace(data, cameras=(5, 20), times=(0,), held_cameras=5, ray_views=8, sizes_px=(224, 320, 416, 576))
    return WholeViewRecipe(
        name="views",
        model=SweepConfig(coarse_fill="rays", error_features=24),
        data=replace(plan, hull_resolution=128, imperfect_fraction=0.8, rough_fraction=0.5, min_hole_px=0),
        steps=20_000,
        minutes=60.0,
        batch=4,
        new_per_batch=1,
        replay_size=48,
        learning_rate=1e-3,
        warmup=100,
        ema=0.998,
    )


WINDOW_TIMES = (0, 10, 20, 27, 28, 29, 30)
"""The paper's window of time 30: t, t - 1, t - 2, t - 3, t - 10, t - 20 and t - 30."""


def as_the_paper(data: DataPlan) -> DataPlan:
    """Samples with exactly three cameras and the whole window."""
    data = replace(data, times=WINDOW_TIMES, past=(len(WINDOW_TIMES) - 1,), least_past=len(WINDOW_TIMES) - 1)
    return replace(data, context_cameras=(3,), context_weights=(1,), targets_per_camera=1)


def paper(data: DataPlan) -> Recipe:
    """The paper's size and objective, nothing of ours; for a data-centre GPU."""
    return Recipe(
        name="paper",
        model=paper_model(),
        data=for_model(paper_model(), as_the_paper(data), sizes_px=(320, 512)),
        loss=LossWeights(adversarial=0.01, channels="sum", outside="image"),
        steps=200_000,
        batch=8,
        new_per_batch=4,
        learning_rate=1e-4,
        warmup=1000,
        ema=0.999,
        workers=12,
    )


def paper_small(data: DataPlan) -> Recipe:
    """The paper's model and objective at small widths, for two CPU cores."""
    return replace(
        paper(data),
        name="paper_small",
        model=paper_small_model(),
        data=for_model(paper_small_model(), as_the_paper(data)),
        steps=20_000,
        batch=4,
        new_per_batch=1,
        learning_rate=4e-4,
        warmup=200,
        ema=0.998,
        workers=1,
    )


def windows(data: DataPlan) -> Recipe:
    """`paper_small` on windows around what is missing, eight of each view."""
    recipe = paper_small(data)
    plan = replace(recipe.data, windows=8, held_cameras=2, imperfect_fraction=0.3, sizes_px=(320, 512))
    return replace(recipe, name="windows", data=plan, new_per_batch=4, replay_size=300, context_gradients=0.2)


def autoencoder(data: DataPlan) -> Recipe:
    """The encoder and the decoder of `paper_small`, on patches of the windows' camera images: for `windows --from`."""
    return replace(
        windows(data),
        name="autoencoder",
        warmup=60,
        ema=0.98,
        part="autoencoder",
        loss=LossWeights(channels="sum"),
        minutes=15.0,
        batch=8,
        new_per_batch=2,
        learning_rate=1e-3,
        context_gradients=1.0,
        validate_every=0,
    )


def copies(data: DataPlan) -> Recipe:
    """`paper_small` on blotted copies of the windows' camera images, from an autoencoder: for `windows --from`."""
    return replace(
        autoencoder(data),
        name="copies",
        ema=0.99,
        part="copies",
        loss=LossWeights(channels="sum", attention=0.1, autoencoder=0.5),
        minutes=45.0,
        new_per_batch=4,
        learning_rate=8e-4,
    )


def tokens(data: DataPlan) -> Recipe:
    """The transformer of `paper_small`, on windows that the encoder it begins with has encoded: --from what did so."""
    return replace(
        copies(data),
        name="tokens",
        part="tokens",
        loss=LossWeights(channels="sum", outside="image", attention=0.1),
        minutes=20.0,
        new_per_batch=8,
        replay_size=1,
    )


def base(data: DataPlan) -> Recipe:
    """The paper's size with all of our additions, rays and patches together; for a data-centre GPU."""
    return replace(
        paper(data),
        name="base",
        model=base_model(),
        data=for_model(base_model(), data, sizes_px=(256, 320, 384)),
        loss=LossWeights(log_error=0.5),
        steps=20_000,
        batch=16,
        new_per_batch=6,
        replay_size=4000,
        learning_rate=4e-4,
    )


def finetune(data: DataPlan) -> Recipe:
    """All of the small model, slowly, on captures of one's own with studio scenes among them (--captures, --from)."""
    return replace(
        small(data),
        name="finetune",
        part="all",
        steps=400,
        minutes=20.0,
        learning_rate=1e-4,
        replay_size=200,
        checkpoint_every=50,
        validate_every=100,
    )


def for_model(model: InpainterConfig, data: DataPlan, sizes_px: tuple[int, ...] | None = None) -> DataPlan:
    """The data that this model can use."""
    return replace(
        data, ray_views=model.num_ray_views if model.coarse_fill == "rays" else 0, sizes_px=sizes_px or data.sizes_px
    )


RECIPES: dict[str, Callable[[DataPlan], Recipe]] = {
    "small": small,
    "small_rays": small_rays,
    "views": views,
    "base": base,
    "paper": paper,
    "paper_small": paper_small,
    "windows": windows,
    "autoencoder": autoencoder,
    "copies": copies,
    "tokens": tokens,
    "finetune": finetune,
}
