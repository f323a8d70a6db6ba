"""Batches that depend only on the config, the seed and the step, so that a resumed run makes the same steps."""

import gc
import io
import signal
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import count, islice
from random import Random
from typing import Any, Generic, TypeVar

import torch
from torch.utils.data import DataLoader, Dataset

from viewmend.training.config import SceneSource

MAX_EMPTY_SCENES = 100
"""Scenes in a row without a sample after which the data is considered empty."""
Item = TypeVar("Item")


@dataclass(frozen=True)
class ReplayPosition:
    """Position of a stream of batches, from which it can be resumed."""

    scene: int
    """Scene of the oldest sample in the buffer."""
    sample: int
    """Index of that sample within its scene."""
    buffered: int
    """Samples in the buffer."""


class SampleReplay(Generic[Item]):
    """A stream of batches: new samples, and others from a buffer of recent ones.

    Worker processes make scenes ahead of time; they are used in the order of their numbers,
    whichever worker made them.
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
        """Begin at the first scene, or resume at `start`, whose buffered samples are made again."""
        start = start or ReplayPosition(0, 0, 0)
        self.seed = seed
        self.new_per_batch = new_per_batch
        self._new = islice(samples_in_order(scenes, start.scene, workers), start.sample, None)
        self._buffer = deque(islice(self._new, start.buffered), maxlen=max(1, replay_size))

    def batch(self, step: int, size: int) -> list[Item]:
        """The batch of `step`, to be called for consecutive steps; smaller than `size` until the buffer has filled."""
        num_new = min(self.new_per_batch, size)
        num_replayed = min(size - num_new, len(self._buffer))
        replayed = Random(f"{self.seed}/{step}").sample(
            [sample for _, _, sample in self._buffer], num_replayed
        )
        new = [next(self._new) for _ in range(num_new)]
        self._buffer.extend(new)
        return [sample for _, _, sample in new] + replayed

    @property
    def position(self) -> ReplayPosition:
        """The position from which this buffer can be made again."""
        scene, sample, _ = self._buffer[0]
        return ReplayPosition(scene, sample, len(self._buffer))


@dataclass(frozen=True)
class _Numbered(Dataset[tuple[int, Sequence[Item] | Exception]]):
    """Scenes by number. Errors in the data are returned, so that they do not end in a worker's traceback."""

    scenes: SceneSource[Item]

    def __getitem__(self, index: int) -> tuple[int, Sequence[Item] | Exception]:
        try:
            return index, self.scenes.scene(index)
        except (ValueError, OSError) as error:
            return index, error


def _to_bytes(scene: object) -> bytes:
    """A scene as it comes from a worker: tensors would come through /dev/shm, which is 64 MB in many containers."""
    file = io.BytesIO()
    torch.save(scene, file)
    return file.getvalue()


def _from_bytes(data: bytes) -> tuple[int, Sequence[Any] | Exception]:
    return torch.load(io.BytesIO(data), weights_only=False)  # a worker of this process wrote it


def _ignore_signals(_: int) -> None:
    """Let the main process alone handle Ctrl-C and SIGTERM, which reach the whole process group."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)


def samples_in_order(scenes: SceneSource[Item], first: int, workers: int) -> Iterator[tuple[int, int, Item]]:
    """(scene, index, sample) of all scenes from `first`. ValueError, OSError: one cannot be made, or many are empty."""
    numbered = _Numbered(scenes)
    if workers:
        loader = DataLoader(
            numbered,
            batch_size=None,
            sampler=count(first),
            num_workers=workers,
            prefetch_factor=2,
            collate_fn=_to_bytes,
            worker_init_fn=_ignore_signals,
        )
        # Forked workers must not collect what this process left behind: a decoder, say, would wait
        # for its threads, which exist here only.
        gc.collect()
        gc.freeze()
        try:
            loaded = map(_from_bytes, iter(loader))
        finally:
            gc.unfreeze()
    else:
        loaded = (numbered[number] for number in count(first))
    empty = 0
    samples = None
    try:
        for number, samples in loaded:
            if isinstance(samples, Exception):
                raise samples
            empty = 0 if samples else empty + 1
            if empty == MAX_EMPTY_SCENES:
                raise ValueError(
                    f"expected views with holes, got none in {empty} scenes; use rigs of fewer cameras, or "
                    "larger images"
                )
            for index, sample in enumerate(samples):
                yield number, index, sample
    finally:
        # An error that is raised refers to this frame, which must not keep the workers alive.
        del loaded, samples


def first_samples(scenes: SceneSource[Item], number: int) -> list[Item]:
    """The first samples of the scenes, made in this process; raises as `samples_in_order` does."""
    return [sample for _, _, sample in islice(samples_in_order(scenes, 0, workers=0), number)]
