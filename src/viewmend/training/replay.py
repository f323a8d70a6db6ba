"""Batches that follow from the recipe, the seed and the step alone, so that a run can go on where it was."""

import signal
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import count
from random import Random
from typing import Generic, TypeVar

import torch
from torch.utils.data import DataLoader, Dataset

from viewmend.training.scenes import SceneSource

MOST_EMPTY_SCENES = 100
"""So many scenes in a row without a sample mean that there never will be one."""


@dataclass(frozen=True)
class ReplayPosition:
    """Where a stream of samples is: all that it takes to go on."""

    scene: int
    """Scene of the oldest sample in the buffer."""
    sample: int
    """Number of the oldest sample among that scene's."""
    buffered: int
    """Samples in the buffer."""


Item = TypeVar("Item")


class SampleReplay(Generic[Item]):
    """One stream of batches: new samples, and others from the buffer of the last ones.

    Scenes are made ahead by worker processes, and used in the order of their numbers whoever made them.
    """

    def __init__(
        self,
        scenes: SceneSource[Item],
        seed: str,
        new_per_batch: int,
        replay_size: int,
        workers: int,
        start: ReplayPosition | None = None,
    ) -> None:
        """`start` takes up a stream: the samples that it replays are made again."""
        start = start or ReplayPosition(0, 0, 0)
        self.seed = seed
        self.new_per_batch = new_per_batch
        self._new = samples_in_order(scenes, start.scene, workers)
        for _ in range(start.sample):
            next(self._new)
        self._buffer: deque[tuple[int, int, Item]] = deque(maxlen=max(1, replay_size))
        for _ in range(start.buffered):
            self._buffer.append(next(self._new))

    def batch(self, step: int, size: int) -> list[Item]:
        """The batch of `step`; steps follow one another. Smaller than `size` until the buffer holds enough."""
        count = min(self.new_per_batch, size)
        again = min(size - count, len(self._buffer))
        seen = Random(f"{self.seed}/{step}").sample([sample for _, _, sample in self._buffer], again)
        new = [next(self._new) for _ in range(count)]
        self._buffer.extend(new)
        return [sample for _, _, sample in new] + seen

    @property
    def position(self) -> ReplayPosition:
        """Where the next batch begins."""
        scene, sample, _ = self._buffer[0]
        return ReplayPosition(scene, sample, len(self._buffer))


class _Numbered(Dataset[tuple[int, Sequence[Item] | Exception]]):
    """Scenes by number; what a user can get wrong is handed on, so that it is not wrapped in a worker's traceback."""

    def __init__(self, scenes: SceneSource[Item]) -> None:
        self.scenes = scenes

    def __getitem__(self, index: int) -> tuple[int, Sequence[Item] | Exception]:
        try:
            return index, self.scenes.scene(index)
        except (ValueError, OSError) as error:
            return index, error


def _ignore_interrupts(_: int) -> None:
    """Ctrl-C reaches all processes of a terminal; the first says what it means."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def samples_in_order(scenes: SceneSource[Item], first: int, workers: int) -> Iterator[tuple[int, int, Item]]:
    """(scene, number, sample) of all scenes from `first` on."""
    numbered = _Numbered(scenes)
    if workers:
        # Through files, not descriptors: a buffer of samples would run out of these.
        torch.multiprocessing.set_sharing_strategy("file_system")
        made = iter(
            DataLoader(
                numbered,
                batch_size=None,
                sampler=count(first),  # pyright: ignore[reportArgumentType]
                num_workers=workers,
                prefetch_factor=2,
                worker_init_fn=_ignore_interrupts,
            )
        )
    else:
        made = (numbered[number] for number in count(first))
    empty = 0
    for number, samples in made:
        if isinstance(samples, Exception):
            raise samples
        empty = 0 if samples else empty + 1
        if empty == MOST_EMPTY_SCENES:
            raise ValueError(
                f"expected views with holes to learn from, got none in {empty} scenes; use fewer cameras, or lower "
                "min_hole_px"
            )
        for i, sample in enumerate(samples):
            yield number, i, sample
