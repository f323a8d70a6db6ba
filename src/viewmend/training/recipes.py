"""The recipes: named `TrainConfig`s, each of which states only what differs from the defaults."""

from collections.abc import Callable
from dataclasses import replace

from viewmend.models.checkpoint import load_config
from viewmend.models.paper.config import PaperConfig
from viewmend.models.paper.config import paper_small as paper_small_model
from viewmend.models.views.config import ViewsConfig
from viewmend.training.config import SceneConfig, TrainConfig
from viewmend.training.paper import PaperObjectiveConfig
from viewmend.training.rays import RaysObjectiveConfig
from viewmend.training.views import ViewsObjectiveConfig
from viewmend.utils.plugins import import_object

PROTOCOLS = ("target-mask", "hull-with-target-mask", "strict")
"""What the paper's model may know of the held-out mask in training."""
MOSTLY_GIVEN = ("target-mask", "target-mask", "target-mask", "hull-with-target-mask", "strict")
"""Protocols of `paper-small`, one of which is drawn for each rig."""
SMALL_RIGS = SceneConfig(
    sizes_px=(224, 320, 416),
    cameras=(6, 24),
    num_holdout_views=6,
    imperfect_fraction=0.5,
    protocols=PROTOCOLS,
    captures_fraction=1.0,
)
"""Rings and domes of few cameras, for fine-tuning `paper-small` next to captures."""
SUBJECT_SCENES = SceneConfig(
    sizes_px=(224, 320, 416, 576), num_holdout_views=5, imperfect_fraction=0.8, hard_fraction=0.5
)
"""Scenes of `views` and `rays`. Each image size is at most 1.5 times the one before, so subjects of
all sizes occur."""
CAPTURE_SIZES_PX = (320, 576, 832)
"""Image sizes of fine-tuning, up to those of real cameras."""
BASELINES = ("dstt", "fuseformer", "e2fgvi", "e2fgvi-hq")
"""Published networks; their recipe takes the network's name."""
RECIPES: dict[str, str] = {
    "views": "viewmend.training.recipes:views",
    "rays": "viewmend.training.recipes:rays",
    "paper": "viewmend.training.recipes:paper",
    "paper-small": "viewmend.training.recipes:paper_small",
    "finetune": "viewmend.training.recipes:finetune",
    **dict.fromkeys(BASELINES, "viewmend.contrib.baselines.training:recipe"),
}
"""MODULE:NAME of the function that makes each recipe; a module is imported when its recipe is requested."""


def views() -> TrainConfig:
    """The default model: every pixel of the subject, with alpha, confidence, depth and predicted errors."""
    return TrainConfig(
        name="views",
        objective=ViewsObjectiveConfig(),
        scenes=replace(SUBJECT_SCENES, hull_resolution=128),
        steps=20_000,
        minutes=60.0,
        batch=4,
        new_per_batch=1,
        replay_size=48,
        learning_rate=1e-3,
        warmup=100,
        ema=0.998,
    )


def rays() -> TrainConfig:
    """The ray fill that `views` uses in holes; one frame of each scene, since more scenes help more than more views."""
    return TrainConfig(
        name="rays",
        objective=RaysObjectiveConfig(),
        scenes=replace(SUBJECT_SCENES, cameras=(6, 20)),
        steps=10_000,
        minutes=60.0,
        batch=16,
        new_per_batch=4,
        learning_rate=1e-3,
        ema=0.998,
    )


def paper() -> TrainConfig:
    """The paper's model at its full size, with the paper's objective; for a data-centre GPU.

    M_t is given for a third of the held-out cameras; for another third, it only helps to carve the
    hull. With --captures, all scenes are captures.
    """
    return TrainConfig(
        name="paper",
        objective=PaperObjectiveConfig(),
        scenes=SceneConfig(sizes_px=(320, 512), protocols=PROTOCOLS, captures_fraction=1.0),
        steps=200_000,
        new_per_batch=4,
        learning_rate=1e-4,
        warmup=1000,
        ema=0.999,
        workers=12,
    )


def paper_small() -> TrainConfig:
    """The paper's model and objective at smaller widths; for two CPU cores.

    Most rigs are as large as the paper's; the others have few cameras and give no mask, so that
    the model does not forget that holes are often background if the hull is too large. Each sample
    is seen once. Nine scenes of ten have no past frames: a whole window takes eight times as long.
    """
    sampling = replace(PaperObjectiveConfig().sampling, window_fraction=0.1, min_hole_px=100)
    return TrainConfig(
        name="paper-small",
        objective=PaperObjectiveConfig(model=paper_small_model(), sampling=sampling),
        scenes=SceneConfig(
            sizes_px=(512,),
            cameras=(32, 60),
            rigs=("layers", "layers", "dome"),
            shared_hull=True,
            few_cameras_fraction=0.15,
            num_holdout_views=6,
            imperfect_fraction=0.3,
            protocols=MOSTLY_GIVEN,
            captures_fraction=1.0,
            hull_resolution=128,
        ),
        steps=20_000,
        new_per_batch=8,
        replay_size=1,
        microbatch=1,
        validation_views=12,
        validate_every=200,
        learning_rate=6e-4,
        warmup=100,
        ema=0.998,
    )


def finetune(start: str = "views") -> TrainConfig:
    """A trained model adapted to your own captures for 20 minutes.

    `views` trains on the captures alone, at a rate at which few steps count; the weights that are
    best on what is held back are kept. Other models are mixed with studio scenes against forgetting.

    Raises:
        WeightsError: the model does not exist, or is damaged.
    """
    model = load_config(start)
    learning_rate = 1e-4
    captures_fraction = 0.5
    if isinstance(model, ViewsConfig):
        config = views()
        objective = ViewsObjectiveConfig(model=model, coarse_from=start)
        learning_rate = 4e-4
        captures_fraction = 1.0
    elif isinstance(model, PaperConfig):
        config = replace(paper_small(), scenes=SMALL_RIGS, replay_size=600)
        sampling = replace(PaperObjectiveConfig().sampling, min_history=0)  # captures may be short
        objective = PaperObjectiveConfig(model=model, sampling=sampling, adversarial=0.0)
    else:
        config = rays()
        objective = RaysObjectiveConfig(model=model)
    return replace(
        config,
        name="finetune",
        objective=objective,
        scenes=replace(
            config.scenes, hold_out="auto", sizes_px=CAPTURE_SIZES_PX, captures_fraction=captures_fraction
        ),
        start=start,
        steps=4000,
        minutes=20.0,
        new_per_batch=1,
        learning_rate=learning_rate,
        warmup=60,
        ema=0.995,
        checkpoint_minutes=2.0,
        validate_every=30,
    )


def make_recipe(name: str, start: str | None = None) -> TrainConfig:
    """The recipe of this name; `start` is the model that `finetune` adapts.

    Raises:
        ValueError: there is no such recipe.
        WeightsError: the model to fine-tune does not exist, or is damaged.
    """
    if name not in RECIPES:
        raise ValueError(f"expected a recipe among {', '.join(RECIPES)}, got '{name}'; see --help")
    make: Callable[..., TrainConfig] = import_object(RECIPES[name])
    argument = name if name in BASELINES else start if name == "finetune" else None
    return make() if argument is None else make(argument)
