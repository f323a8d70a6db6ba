"""Scenes to train on: rigs of the synthetic studio, and captures; each follows from the config, seed and number."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from random import Random
from typing import Protocol, runtime_checkable

from viewmend.data.prepare import PreparedCapture, prepare
from viewmend.data.source import CaptureSource, limit_size
from viewmend.geometry.cameras import Cameras
from viewmend.scenes.held_out import PROCEDURAL_SEEDS, LeaveOneOut, Split, recordings
from viewmend.studio.imperfections import Imperfections
from viewmend.studio.stage import Studio, StudioConfig
from viewmend.training.config import SamplingConfig, SceneConfig
from viewmend.training.held_back import HeldBack, open_training_captures
from viewmend.training.samples import Sample, rig_samples
from viewmend.types import MultiViewFrame

HARD_CALIBRATION = 4.0
"""Hard scenes have calibration errors of at most this many times the usual size."""
HARD_MASKS = 2.0
"""Hard scenes have silhouette errors of at most this many times the usual size."""


@dataclass(frozen=True)
class Scene:
    """Some frames of a rig whose cameras can be held out."""

    rig: LeaveOneOut
    random: Random
    """Draws everything else about the scene."""
    held_out: str | None = None
    """The only camera that may be held out; None for any."""


@runtime_checkable
class RigSource(Protocol):
    """An endless sequence of numbered rigs; the same number always gives the same rig."""

    def rig(self, number: int) -> Scene:
        """The rig of scene `number`."""
        ...


class StudioRigs:
    """Rigs of the synthetic studio, rendered on request."""

    def __init__(
        self, config: SceneConfig, frames: Sequence[int], seed: str, split: Split = "training"
    ) -> None:
        """`seed` determines everything random except the people, whose seeds belong to the split.

        Raises ValueError if the split, or the config's characters or motions, are reserved for tests.
        """
        self.config = training_people(config, split)
        self.frames = frames
        self.seed = seed
        self.split: Split = split

    def rig(self, number: int) -> Scene:
        """A random rig with random people."""
        random = Random(f"{self.seed}/{number}")
        studio = Studio(random_studio(self.config, max(self.frames) + 1, random, self.split))

        def truth(held: str, time: int) -> MultiViewFrame:
            return studio.truth(studio.true_cameras.select([held]), time, on_stage=True)

        return Scene(LeaveOneOut({time: studio.read(time) for time in self.frames}, true_view=truth), random)


def training_people(config: SceneConfig, split: Split) -> SceneConfig:
    """The config with the characters and motions that a split may use.

    Raises:
        ValueError: the split is test, or the characters or motions are reserved for tests.
    """
    if split == "test":
        raise ValueError("expected the split training or validation, got test; use procedural_set")
    people = [place for place in (config.performers, config.motions) if place is not None]
    return config if recordings(split, people) else replace(config, performers=None, motions=None)


def random_studio(
    config: SceneConfig, frames: int, random: Random, split: Split = "training"
) -> StudioConfig:
    """A studio with random people, rig and imperfections, as varied as real studios are."""
    flawed = random.random() < config.imperfect_fraction
    strength = random.random() if flawed else 0.0
    studio = StudioConfig(
        seed=random.choice(PROCEDURAL_SEEDS[split]),
        cameras=random.randint(*config.cameras),
        rig=random.choice(config.rigs),
        frames=frames,
        size_px=random.choice(config.sizes_px),
        background=random.choice(("black", "stage", "stage")) if flawed else "black",
        imperfections=Imperfections(
            exposure_stops=0.1 * strength,
            white_balance=0.04 * strength,
            shot_noise=0.02 * strength,
            read_noise=0.008 * strength,
            spill=0.5 * strength * random.random(),
            mask_edge_px=strength * random.random(),
            mask_holes=0.2 * strength,
            mask_blobs=0.2 * strength,
            mask_hard=flawed and random.random() < 0.6,
            calibration_px=strength * random.random(),
            calibration_m=0.003 * strength * random.random(),
            jpeg_quality=random.randint(70, 95) if flawed and random.random() < 0.5 else None,
        ),
    )
    if config.hard_fraction and random.random() < config.hard_fraction:
        usual = studio.imperfections
        calibration_factor = random.uniform(1, HARD_CALIBRATION)
        mask_factor = random.uniform(1, HARD_MASKS)
        hard = replace(
            usual,
            calibration_px=calibration_factor * usual.calibration_px,
            calibration_m=calibration_factor * usual.calibration_m,
            mask_edge_px=mask_factor * usual.mask_edge_px,
        )
        studio = replace(studio, imperfections=hard)
    if (
        config.performers is not None
        and config.motions is not None
        and random.random() < config.performers_fraction
    ):
        variety = random.uniform(0.0, 1.0)
        studio = replace(studio, performers=config.performers, motions=config.motions, cloth_variety=variety)
    return studio


@dataclass(frozen=True)
class CaptureRigs:
    """Frames of captures, resized to the config's sizes and aligned.

    A capture is aligned once, without the camera that is held back or is the only truth. To align it
    without each other camera in turn would take longer than fine-tuning does.
    """

    captures: Sequence[tuple[CaptureSource, str | None]]
    """Each with the one camera that is held out, or None for all in turn."""
    config: SceneConfig
    frames: Sequence[int]
    seed: str
    held_back: Sequence[HeldBack | None] = ()
    """The camera and frames of each capture that are never used."""
    _prepared: dict[int, PreparedCapture] = field(default_factory=dict)

    def rig(self, number: int) -> Scene:
        """Some frames of a random capture."""
        random = Random(f"{self.seed}/{number}")
        index = random.randrange(len(self.captures))
        capture, held_out = self.captures[index]
        held_back = self.held_back[index] if self.held_back else None
        last = (len(capture.frame_ids) if held_back is None else held_back.first_frame) - 1
        first = random.randint(0, max(0, last - max(self.frames)))
        size_px = random.choice(self.config.sizes_px)
        times = sorted({min(first + offset, last) for offset in self.frames})
        frames = {time: limit_size(capture.read(time), size_px) for time in times}
        if held_back is not None and held_back.camera is not None:
            frames = {time: frame.without([held_back.camera]) for time, frame in frames.items()}
        # A camera without an image at some of these frames cannot be held out there.
        complete = [
            n for n in frames[times[-1]].cameras.names if all(n in f.cameras.names for f in frames.values())
        ]
        frames = {time: frame.select(complete) for time, frame in frames.items()}

        if index not in self._prepared:
            unused = (held_out, None if held_back is None else held_back.camera)
            inputs = [name for name in capture.cameras.names if name not in unused]
            self._prepared[index] = prepare(capture, inputs, match_colours=False, tighten_masks=False)
        aligned = replace(self._prepared[index], max_image_size=size_px).cameras

        def cameras(held: str) -> Cameras:
            return aligned

        return Scene(LeaveOneOut(frames, capture.bounds, cameras), random, held_out)


@dataclass(frozen=True)
class MixedRigs:
    """Two sources; a fixed fraction of the rigs comes from the first."""

    first: RigSource
    second: RigSource
    fraction: float
    seed: str

    def rig(self, number: int) -> Scene:
        """A rig of either source."""
        use_first = Random(f"{self.seed}/which/{number}").random() < self.fraction
        return (self.first if use_first else self.second).rig(number)


def rig_source(config: SceneConfig, frames: Sequence[int], seed: str, split: Split = "training") -> RigSource:
    """Captures and studio in the proportions of the config; for validation, the studio's procedural people alone.

    Raises:
        CaptureError: a capture cannot be used.
        ValueError: data reserved for tests is requested.
    """
    studio = StudioRigs(config, frames, seed, split)
    folders = recordings(split, config.captures)
    if not folders:
        return studio
    opened = [own for folder in folders for own in open_training_captures(folder, config.hold_out)]
    # `prepare` only checks the captures here. `CaptureRigs` aligns them, without held-back cameras
    captures = [
        (prepare(own.source, align=False, match_colours=False, tighten_masks=False), own.left_out)
        for own in opened
    ]
    held_back = [own.held_back for own in opened]
    rigs = CaptureRigs(captures, config, frames, seed, held_back)
    return MixedRigs(rigs, studio, config.captures_fraction, seed)


@dataclass(frozen=True)
class SampleScenes:
    """The samples of rigs."""

    rigs: RigSource
    config: SceneConfig
    sampling: SamplingConfig
    single_frames: RigSource | None = None
    """The rigs at the last frame only, if some samples have no history."""

    def scene(self, number: int) -> list[Sample]:
        """The samples of rig `number`, for some held-out cameras at some frames."""
        rigs = self.rigs
        sampling = self.sampling
        if self.single_frames is not None and Random(f"window/{number}").random() >= sampling.window_fraction:
            rigs = self.single_frames
            sampling = replace(sampling, min_history=0)
        scene = rigs.rig(number)
        return rig_samples(scene.rig, self.config, sampling, scene.random, scene.held_out)


def sample_scenes(config: SceneConfig, sampling: SamplingConfig, seed: str) -> SampleScenes:
    """The training samples of `rig_source`; raises as it does."""
    rigs = rig_source(config, sampling.frames, seed)
    single = rig_source(config, sampling.frames[-1:], seed) if sampling.window_fraction < 1 else None
    return SampleScenes(rigs, config, sampling, single)


def validation_scenes(config: SceneConfig, sampling: SamplingConfig) -> SampleScenes:
    """The samples of procedural people reserved for validation, one held-out view per scene."""
    config = replace(config, num_holdout_views=1, performers=None, motions=None)
    return SampleScenes(StudioRigs(config, sampling.frames, "validation", "validation"), config, sampling)
