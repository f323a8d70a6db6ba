"""Scenes, each a list of samples that follows from the plan, the seed and the scene's number alone."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from random import Random
from typing import Protocol, TypeVar, runtime_checkable

from jaxtyping import Bool
from torch import Tensor

from viewmend.geometry.hull import HullConfig
from viewmend.inpainting.correspondences import Correspondences
from viewmend.leave_one_out.scenes import LeaveOneOut
from viewmend.leave_one_out.splits import PROCEDURAL_SEEDS, Split, recordings
from viewmend.leave_one_out.true_visibility import TrueSurface, true_correspondences
from viewmend.rendering.view import RenderConfig
from viewmend.studio.imperfections import Imperfections
from viewmend.studio.stage import Studio, StudioConfig
from viewmend.training.plan import DataPlan
from viewmend.training.samples import HeldOutCamera, Sample
from viewmend.views import MultiViewFrame

ROUGHEST = 2.5
"""Calibration of a rough stage is so many times as wrong at most."""
WIDEST_PX = 10
"""Holes are widened by at most so much."""
FEWEST_CAMERAS = 5
"""A rig of so many never misses one."""

Item = TypeVar("Item", covariant=True)


@runtime_checkable
class SceneSource(Protocol[Item]):
    """Endless numbered scenes; a number always gives the same samples."""

    def scene(self, number: int) -> Sequence[Item]:
        """The samples of scene `number`, in the order in which they are used; there may be none."""
        ...


class StudioScenes:
    """Scenes of the studio, made on the fly."""

    def __init__(self, plan: DataPlan, seed: str, split: Split = "training") -> None:
        """`seed` is of everything that is random but the performers, whose seeds are the split's.

        Raises:
            ValueError: the split, or the plan's people or motions, are kept for tests.
        """
        if split == "test":
            raise ValueError("expected scenes for training or validation, got those for tests; take procedural_set")
        people = [place for place in (plan.performers, plan.motions) if place is not None]
        self.plan = plan if recordings(split, people) else replace(plan, performers=None, motions=None)
        self.seed = seed
        self.split: Split = split

    def scene(self, number: int) -> list[Sample]:
        """At each time some cameras of a random stage are left out in turn, and see the truth."""
        rig, random = self.rig(number)
        return rig_samples(rig, self.plan, random)

    def rig(self, number: int) -> tuple[LeaveOneOut, Random]:
        """What the stage of scene `number` saw, and what draws anything else about the scene."""
        random = Random(f"{self.seed}/{number}")
        studio = Studio(random_stage(self.plan, random, self.split))

        def truth(held: str, time: int) -> MultiViewFrame:
            return studio.truth(studio.true_cameras.select([held]), time)

        frames = {time: studio.read(time) for time in self.plan.times}
        if not self.plan.matches:
            return LeaveOneOut(frames, true_view=truth), random
        meshes = {time: studio.scene(time).mesh for time in self.plan.times}

        def correspondences(
            held: str, times: Sequence[int], names: Sequence[str], missing: Bool[Tensor, "height width"]
        ) -> Correspondences:
            seen = {t: replace(frames[t], cameras=studio.true_cameras).select(names) for t in times}
            surfaces = {t: TrueSurface.of(frame, meshes[t]) for t, frame in seen.items()}
            return true_correspondences(surfaces, meshes[times[0]], studio.true_cameras.select([held]), missing)

        return LeaveOneOut(frames, true_view=truth, correspondences=correspondences), random


def random_stage(plan: DataPlan, random: Random, split: Split = "training") -> StudioConfig:
    """A stage as real ones differ: who performs, how many cameras in which rig, and what is wrong with them."""
    flawed = random.random() < plan.imperfect_fraction
    strength = random.random() if flawed else 0.0
    config = StudioConfig(
        seed=random.choice(PROCEDURAL_SEEDS[split]),
        cameras=random.randint(*plan.cameras),
        rig=random.choice(("ring", "dome")),
        frames=max(plan.times) + 1,
        size_px=random.choice(plan.sizes_px),
        background=random.choice(("black", "stage")) if flawed else "black",
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
        device=plan.data_device,
    )
    if plan.rough_fraction and random.random() < plan.rough_fraction:
        config = replace(config, imperfections=_rougher(config.imperfections, random))
    if plan.staged:
        config = replace(config, background="stage")
    if plan.performers is not None and plan.motions is not None and random.random() < plan.performers_fraction:
        variety = random.uniform(*plan.cloth_variety)
        config = replace(config, performers=plan.performers, motions=plan.motions, cloth_variety=variety)
    return config


def _rougher(it: Imperfections, random: Random) -> Imperfections:
    """Calibration up to `ROUGHEST` times as wrong, outlines up to twice."""
    worse = random.uniform(1, ROUGHEST)
    return replace(
        it,
        calibration_px=worse * it.calibration_px,
        calibration_m=worse * it.calibration_m,
        mask_edge_px=random.uniform(1, 2) * it.mask_edge_px,
    )


def rig_samples(rig: LeaveOneOut, plan: DataPlan, random: Random, left_out: str | None = None) -> list[Sample]:
    """Some cameras of a rig are left out in turn, each at some of the times.

    Args:
        rig: what it saw.
        plan: how many cameras and times, and how views are rendered.
        random: which.
        left_out: the only camera that is left out, where it is there; None for any.
    """
    dropped = _dropouts(rig.frames, plan.dropped_fraction, random)
    times = sorted(rig.frames)
    ends = [t for t in times if all(t - back in rig.frames for back in range(plan.clip_length))]
    ends = [t for t in ends if times.index(t) >= plan.least_past]
    if not ends and plan.least_past:
        raise ValueError(
            f"expected more than {plan.least_past} times for a past of as many, got {times}; lower --least-past, or "
            f"use captures of {max(plan.times) + 1} frames or more"
        )
    if not ends:
        raise ValueError(
            f"expected {plan.clip_length} consecutive times for clips, got {times}; leave --clip-length away, give so "
            f"many consecutive --times, or use captures of {max(plan.times) + 1} frames or more"
        )
    names = [n for n in rig.frames[times[-1]].cameras.names if n not in dropped.get(times[-1], ())]
    names = names if left_out is None else [name for name in names if name == left_out]
    samples = []
    for held in random.sample(names, min(plan.held_cameras, len(names))):
        others = HeldOutCamera(rig, held, HullConfig(resolution=plan.hull_resolution), dropped)
        for end in random.sample(ends, min(plan.targets_per_camera, len(ends))):
            reach = random.choice(plan.past)
            render = RenderConfig(cameras=random.choices(plan.context_cameras, weights=plan.context_weights)[0])
            sample, cameras = None, (plan.least_context, plan.ray_views)
            wider_px = random.randint(1, WIDEST_PX) if random.random() < plan.widened_fraction else 0
            for time in range(end - plan.clip_length + 1, end + 1):
                past = [t for t in reversed(times) if t < time][:reach]
                context = (time, *past) if plan.context else ()
                least_px = plan.min_hole_px if time == end else 0
                new = others.sample(time, context, render, least_px, cameras, wider_px)
                sample = new and replace(new, previous=sample)
            if sample is not None:
                samples.append(sample)
    return samples


def _dropouts(frames: Mapping[int, MultiViewFrame], fraction: float, random: Random) -> dict[int, list[str]]:
    """One or two cameras that have no frame, at a fraction of the times."""
    dropped = {}
    for time, frame in frames.items() if fraction else ():
        names = frame.cameras.names
        count = min(random.randint(1, 2), len(names) - FEWEST_CAMERAS) if random.random() < fraction else 0
        dropped[time] = random.sample(names, count) if count > 0 else []
    return dropped
