"""Which of the run's processes this one is, and how they meet (torchrun starts them)."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import nn
from torch.nn.parallel import DistributedDataParallel

from viewmend.training.replay import ReplayPosition


@dataclass(frozen=True)
class Processes:
    """This process among those of the run."""

    rank: int
    count: int
    device: torch.device

    @property
    def first(self) -> bool:
        """Whether this one writes files and reports."""
        return self.rank == 0

    def wrap_ddp(self, module: nn.Module) -> nn.Module:
        """The module with gradients averaged over all processes; itself where there is one process only."""
        if self.count == 1 or not any(p.requires_grad for p in module.parameters()):
            return module
        devices = [self.device.index] if self.device.type == "cuda" else None
        return DistributedDataParallel(module, device_ids=devices, find_unused_parameters=True)

    def gather(self, positions: list[ReplayPosition]) -> tuple[ReplayPosition, ...]:
        """The positions of all processes' streams, in the order of the streams: number n is of process n % count."""
        own = torch.tensor([[p.scene, p.sample, p.buffered] for p in positions], device=self.device)
        if self.count == 1:
            everyones = [own]
        else:
            everyones = [torch.empty_like(own) for _ in range(self.count)]
            torch.distributed.all_gather(everyones, own)
        return tuple(ReplayPosition(*row.tolist()) for rows in zip(*everyones, strict=True) for row in rows)

    def mean(self, value: torch.Tensor) -> torch.Tensor:
        """The mean of the processes' values."""
        if self.count == 1:
            return value
        value = value.clone()
        torch.distributed.all_reduce(value)
        return value / self.count

    def furthest(self, progress: float) -> float:
        """The largest progress of all processes, whose clocks may differ."""
        if self.count == 1:
            return progress
        value = torch.tensor(progress, dtype=torch.float64, device=self.device)
        torch.distributed.all_reduce(value, torch.distributed.ReduceOp.MAX)
        return float(value)


@contextmanager
def processes() -> Iterator[Processes]:
    """This process's place; joins the others when torchrun started it, and leaves when all are done."""
    count = int(os.environ.get("WORLD_SIZE", "1"))
    rank, local = int(os.environ.get("RANK", "0")), int(os.environ.get("LOCAL_RANK", "0"))
    device = torch.device("cuda", local) if torch.cuda.is_available() else torch.device("cpu")
    if count == 1:
        yield Processes(0, 1, device)
        return
    if device.type == "cuda":
        torch.cuda.set_device(device)
    torch.distributed.init_process_group("nccl" if device.type == "cuda" else "gloo")
    try:
        yield Processes(rank, count, device)
        # What gloo's threads still hold of the last tensors would abort a process that ends at once: all end together.
        torch.distributed.barrier()
    finally:
        torch.distributed.destroy_process_group()
