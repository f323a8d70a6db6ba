"""The studio's endless stream of training samples, made on the fly by worker processes."""

from collections.abc import Iterator
from dataclasses import replace
from random import Random

import torch
from torch.utils.data import DataLoader, IterableDataset, get_worker_info

from viewmend.capture.studio.imperfections import Imperfections
from viewmend.capture.studio.stage import Studio, StudioConfig
from viewmend.geometry.hull import HullConfig
from viewmend.rendering.view import RenderConfig
from viewmend.training.recipes import DataPlan
from viewmend.training.samples import LeaveOneOut, Sample
from viewmend.views import MultiViewFrame

FIRST_TEST_SEED = 10000
"""Procedural seeds from here on are kept for tests and evaluation."""


class SampleStream(IterableDataset[Sample]):
    """Samples of one random scene after another; the same seed and number of workers give the same samples."""

    def __init__(self, plan: DataPlan, seed: int) -> None:
        super().__init__()
        self.plan = plan
        self.seed = seed

    def __iter__(self) -> Iterator[Sample]:
        worker = get_worker_info()
        number = 0 if worker is None else worker.id
        random = Random(f"{self.seed}/{number}")
        while True:
            yield from scene_samples(random_studio(self.plan, random), self.plan, random)

    def loader(self, workers: int) -> Iterator[Sample]:
        """The stream, made ahead by this many processes (0: by the caller's own, when asked)."""
        if workers == 0:
            return iter(self)
        # Through files, not descriptors: a buffer of samples would run out of these.
        torch.multiprocessing.set_sharing_strategy("file_system")
        ahead = DataLoader(self, batch_size=None, num_workers=workers, prefetch_factor=8, persistent_workers=True)
        return iter(ahead)


def random_studio(plan: DataPlan, random: Random) -> Studio:
    """A stage as real ones differ: who performs, how many cameras in which rig, and what is wrong with them."""
    flawed = random.random() < plan.imperfect_share
    strength = random.random() if flawed else 0.0
    config = StudioConfig(
        seed=random.randrange(FIRST_TEST_SEED),
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
        ),
    )
    if plan.performers is not None and plan.motions is not None and random.random() < plan.performers_share:
        config = replace(config, performers=plan.performers, motions=plan.motions)
    return Studio(config)


def scene_samples(studio: Studio, plan: DataPlan, random: Random) -> Iterator[Sample]:
    """Samples of one scene: at each time some cameras are left out in turn, and see the truth."""
    frames: dict[int, MultiViewFrame] = {time: studio.read(time) for time in plan.times}
    names = studio.cameras.names
    hull = HullConfig(resolution=plan.hull_resolution)
    for held in random.sample(names, min(plan.held_cameras, len(names))):
        rig = LeaveOneOut(frames, held, None, hull)
        for time in random.sample(plan.times, min(plan.targets_per_camera, len(plan.times))):
            past = [t for t in reversed(plan.times) if t < time]
            past = past[: random.choice((0, 0, 0, 1, len(past)))]
            truth = replace(
                studio.truth(studio.true_cameras.select([held]), time), cameras=studio.cameras.select([held])
            )
            cameras = random.choices(plan.context_cameras, weights=plan.context_weights)[0]
            sample = rig.sample(time, past, truth, RenderConfig(cameras=cameras), plan.min_hole_px, plan.rays)
            if sample is not None:
                yield sample
