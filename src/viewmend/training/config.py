"""What a training run is: an objective, scenes to train on, and a schedule."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Protocol, TypeVar, runtime_checkable

import tyro

from viewmend.utils.options import FLAT, HIDDEN

if TYPE_CHECKING:
    from torch import nn

Item = TypeVar("Item", covariant=True)


@runtime_checkable
class SceneSource(Protocol[Item]):
    """An endless sequence of numbered scenes; the same number always gives the same items."""

    def scene(self, number: int) -> Sequence[Item]:
        """The items of scene `number`, in the order in which they are used; may be empty."""
        ...


@dataclass(frozen=True, kw_only=True)
class SceneConfig:
    """The scenes of a run: rigs of the synthetic studio, and captures of your own."""

    sizes_px: tuple[int, ...] = (224, 256, 320)
    """Edge lengths of the images; each scene uses one of them."""
    cameras: tuple[int, int] = (5, 20)
    """Smallest and largest number of cameras in a studio rig."""
    rigs: Annotated[tuple[Literal["ring", "dome", "layers"], ...], HIDDEN] = ("ring", "dome")
    """How the cameras of studio rigs are placed; of several ways, one is drawn for each rig."""
    fused_fraction: float = 0.0
    """Fraction of the scenes of `views` behind geometry that is fused from predicted depth,
    instead of hulls."""
    shared_hull: Annotated[bool, HIDDEN] = False
    """Whether a quarter of each studio rig's cameras are held out together, and share the hull of
    the others."""
    few_cameras_fraction: Annotated[float, HIDDEN] = 0.0
    """Fraction of the rigs with a shared hull that have few cameras, and whose samples have no M_t."""
    num_holdout_views: int = 4
    """Cameras of a scene that are held out, one after the other, to serve as ground truth."""
    imperfect_fraction: float = 0.6
    """Fraction of the studio scenes with noise, colour differences, and errors in masks and calibration."""
    hard_fraction: float = 0.0
    """Fraction of the imperfect scenes whose calibration errors are up to 4 times as large, mask
    errors twice."""
    performers: Path | None = None
    """Folder of glTF characters for half of the studio scenes; without it, all people are procedural."""
    motions: Path | None = None
    """Folder of BVH motions for these characters."""
    performers_fraction: Annotated[float, HIDDEN] = 0.5
    """Fraction of the studio scenes with characters from these folders."""
    captures: tuple[Path, ...] = ()
    """Folders of your own captures, or files written by `viewmend splits`, of which only the
    training part is used."""
    hold_out: str | None = None
    """Camera of the captures to hold back from training, with the last tenth of their frames. The
    run is validated on both, keeps the best weights, and ends early when they stop improving.
    'auto' chooses a camera in rigs of five or more."""
    protocols: tuple[Literal["strict", "target-mask", "hull-with-target-mask"], ...] = ("strict",)
    """What is known of a held-out camera's mask (docs/evaluation.md); of several, one is drawn for
    each camera, or for each rig of `paper-small`."""
    captures_fraction: float = 0.75
    """Fraction of the scenes that come from the captures, if any are given; the rest come from the studio."""
    hull_resolution: Annotated[int, HIDDEN] = 96
    """Voxels along the longest side of the hull; lower than at run time, as each held-out camera
    needs its own hull."""


@dataclass(frozen=True, kw_only=True)
class SamplingConfig:
    """How training samples are taken from a scene; set by the recipe to suit the model."""

    frames: tuple[int, ...] = (0,)
    """Frames of a scene that are used, relative to the first one."""
    num_target_frames: int = 1
    """Frames at which a held-out camera gives a sample."""
    min_history: int = 0
    """Earlier frames that a target must have."""
    clip_length: int = 1
    """Consecutive frames in a sample, for discriminators of clips."""
    window_fraction: float = 1.0
    """Fraction of the scenes with all `frames`; the others have the last only, in an eighth of the time."""
    with_context: bool = False
    """Whether samples have context: the source views now and at all earlier `frames`."""
    num_source_views: tuple[int, ...] = (2, 3, 4, 5)
    """Numbers of cameras that may colour a view and be its context; each view draws one of them."""
    source_view_weights: tuple[int, ...] = (2, 8, 2, 1)
    """Relative frequencies of `num_source_views`."""
    min_context_views: int = 0
    """Cameras in the context at least, however many coloured the view."""
    num_ray_views: int = 0
    """Cameras that models which sample along rays receive: the source views, then the closest others."""
    depth_fraction: float = 0.0
    """Fraction of the views that are rendered from depth maps with errors instead of the
    hull, for `views`."""
    min_hole_px: int = 50
    """Views with fewer pixels to inpaint are skipped."""


@dataclass(frozen=True, kw_only=True)
class ObjectiveConfig(ABC):
    """What a run trains and by which loss.

    Subclasses are frozen dataclasses next to their `Objective`; their fields are options of `viewmend train`.
    """

    sampling: Annotated[SamplingConfig, HIDDEN]
    make_objective: ClassVar[Callable[..., Any]]
    """The `Objective` to train; called with a `TrainConfig`, this config, and the model to
    start from or None."""
    item: ClassVar[type]
    """Class of the items of `make_scenes`."""
    whole_shards: ClassVar[bool] = True
    """Whether a shard is read as one scene; else item by item, for large items."""
    shard_size: ClassVar[int] = 48
    """Items in one file of `viewmend make-dataset`."""

    @abstractmethod
    def make_scenes(self, scenes: SceneConfig, seed: str) -> SceneSource[Any]:
        """The scenes that `viewmend make-dataset` writes, generated on the fly.

        Raises:
            CaptureError: a capture cannot be used.
            ValueError: data reserved for tests is requested.
        """

    def load_start(self, name: str) -> "nn.Module":
        """The model of `TrainConfig.start`; raises WeightsError if there is none, or it is damaged."""
        from viewmend.models.checkpoint import load_network

        return load_network(name)


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """A training run: its objective, its scenes and its schedule."""

    name: Annotated[str, HIDDEN]
    """Name of the recipe."""
    objective: Annotated[ObjectiveConfig, FLAT]
    scenes: Annotated[SceneConfig, FLAT] = field(default_factory=SceneConfig)
    start: Annotated[str | None, tyro.conf.arg(name="from")] = None
    """Name or folder of a model to start from; without one, the run starts from random weights."""
    shards: Path | None = None
    """Folder written by `viewmend make-dataset`; the run reads its scenes from there and ignores the
    options of scenes."""
    steps: int
    """Optimisation steps."""
    minutes: float | None = None
    """End the run after this time or --steps, whichever is first; the learning rate follows the one
    further along."""
    batch: int = 8
    """Samples per step; under torchrun, in each process."""
    learning_rate: float = 8e-4
    """Peak learning rate."""
    workers: int = 1
    """Processes that generate samples, for each training process."""
    precision: Literal["auto", "bfloat16", "float32"] = "auto"
    """Number format in which the networks compute: bfloat16 by autocast, float32, or auto: bfloat16 if the
    device has units for it."""
    checkpoint_minutes: float = 5.0
    """Minutes between checkpoints, from which the same command resumes; 0 writes one after every step."""
    validate_every: int = 500
    """Steps between validations of the averaged weights, on fixed scenes or what --hold-out holds
    back; 0: none."""
    seed: int = 0
    """Seed of the weights, the scenes and the samples."""
    new_per_batch: Annotated[int, HIDDEN] = 3
    """New samples per batch; the others are replayed."""
    replay_size: Annotated[int, HIDDEN] = 600
    """Recent samples kept for replay, per stream."""
    microbatch: Annotated[int | None, HIDDEN] = None
    """Samples whose gradients are computed at once, which bounds memory; None: the whole batch."""
    streams: Annotated[int, HIDDEN] = 1
    """Batches whose gradients are averaged in one step; the processes of torchrun share them."""
    warmup: Annotated[int, HIDDEN] = 60
    """Steps over which the learning rate rises."""
    ema: Annotated[float, HIDDEN] = 0.995
    """Decay of the averaged weights, which are the result of the run."""
    validation_views: Annotated[int, HIDDEN] = 24
    """Views of the validation scenes."""

    def __post_init__(self) -> None:
        least = {"steps": 1, "batch": 1, "streams": 1, "new_per_batch": 1, "workers": 0, "validate_every": 0}
        least |= {"checkpoint_minutes": 0}
        wrong = [
            f"{name} of {getattr(self, name)}"
            for name, low in least.items()
            if not getattr(self, name) >= low
        ]
        wrong += [f"minutes of {self.minutes}"] if self.minutes is not None and not self.minutes > 0 else []
        wrong += (
            [f"microbatch of {self.microbatch}"]
            if self.microbatch is not None and self.microbatch < 1
            else []
        )
        wrong += [] if 0 < self.learning_rate < math.inf else [f"learning_rate of {self.learning_rate}"]
        if wrong:
            raise ValueError(
                "expected positive numbers (workers, validate_every and checkpoint_minutes may be 0), got "
                f"{', '.join(wrong)}; change the options"
            )
