"""What a training run is: model, data and schedule. A recipe is a function of a few lines."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

from viewmend.inpainting.config import InpainterConfig
from viewmend.inpainting.config import small as small_model


@dataclass(frozen=True, kw_only=True)
class DataPlan:
    """Which scenes a run sees, and how much of each."""

    sizes_px: tuple[int, ...] = (224, 256, 320)
    """Edge lengths of the square images; each scene takes one."""
    cameras: tuple[int, int] = (6, 18)
    """Fewest and most cameras of a rig."""
    times: tuple[int, ...] = (0, 10, 11, 12, 13)
    """Frames of a scene that are drawn; every one is a target whose past is the window's share of the earlier ones."""
    held_cameras: int = 4
    """Cameras of a scene that are left out in turn."""
    targets_per_camera: int = 3
    """Times at which a camera that is left out gives a sample."""
    context_cameras: tuple[int, ...] = (2, 3, 4)
    """How many cameras colour a view and are its context,"""
    context_weights: tuple[int, ...] = (1, 4, 1)
    """and how often each."""
    rays: int = 0
    """How many cameras near a view an inpainter that reads rays is given."""
    imperfect_share: float = 0.6
    """Share of the scenes whose cameras have noise, differ in colour, and have wrong masks and calibration."""
    min_hole_px: int = 50
    """Views that miss less are passed over."""
    hull_resolution: int = 96
    """Voxels along the hull's longest side (coarser than in production: it is done once for each left-out camera)."""
    performers: Path | None = None
    """Folder of glTF characters for half of the scenes; without it all are procedural."""
    motions: Path | None = None
    """Folder of BVH motions for them."""
    performers_share: float = 0.5
    """Share of the scenes whose performers come from these folders, where they are given."""


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """A named training run."""

    name: str
    model: InpainterConfig
    data: DataPlan = field(default_factory=DataPlan)
    steps: int
    minutes: float | None = None
    """Ends the run by then, whatever its steps: the learning rate follows whichever is further along."""
    batch: int = 8
    fresh: int = 3
    """New samples in a batch; the others come again from the buffer."""
    buffer: int = 600
    """Samples that are kept to be seen again."""
    learning_rate: float = 8e-4
    warmup: int = 60
    weight_decay: float = 0.01
    log_error_weight: float = 0.0
    """Of the logarithm of the squared error in the holes, beside the paper's L1."""
    clip: float = 1.0
    """Largest norm of the gradient."""
    ema: float = 0.995
    """Decay of the averaged weights, which are what is shipped."""
    workers: int = 1
    """Processes that make samples."""
    part: Literal["rays", "patches", "all"] = "all"
    """What is trained: the ray reader alone, on the fill that it makes, all but it, or both."""
    pixels: int = 300
    """For the rays alone: missing pixels that are read of each view, at most."""
    bfloat16: bool = True
    """Run the networks under autocast."""
    seed: int = 0


def small(performers: Path | None = None, motions: Path | None = None) -> Recipe:
    """The small model's patches, for two CPU cores and less than an hour, upon what `small_rays` made."""
    return Recipe(
        name="small",
        model=small_model(),
        data=DataPlan(performers=performers, motions=motions, rays=small_model().rays),
        steps=1500,
        minutes=40,
        part="patches",
        log_error_weight=0.5,
    )


def small_rays(performers: Path | None = None, motions: Path | None = None) -> Recipe:
    """The small model's ray reader: it learns ten times as fast, alone."""
    return replace(
        small(performers, motions),
        name="small_rays",
        part="rays",
        steps=6000,
        batch=16,
        fresh=3,
        learning_rate=3e-3,
        ema=0.998,
        log_error_weight=2.0,
    )


RECIPES = {"small": small, "small_rays": small_rays}
