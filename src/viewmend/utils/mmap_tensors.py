"""Copies of long-lived tensors in their own memory mappings, to avoid heap fragmentation.

Long-lived tensors between short-lived ones keep the C library from returning memory: a server that runs for hours
would occupy several times what it stores.
"""

import mmap
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

import torch

LARGE_BYTES = 1 << 16
"""Smaller tensors are not copied."""
PRIVATE = {"flags": mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS} if hasattr(mmap, "MAP_PRIVATE") else {}
"""Private mappings, so that a forked process gets a copy; not needed on Windows."""

T = TypeVar("T")


def to_mmap(value: T) -> T:
    """Copy the large CPU tensors of a tensor, dataclass or tuple to their own memory mappings.

    The memory returns to the system when the copy is freed. Costs about a millisecond for 3 MB.
    """
    return _moved(value)


def _moved(value: Any) -> Any:
    if isinstance(value, torch.Tensor):
        size = value.numel() * value.element_size()
        if value.device.type != "cpu" or size < LARGE_BYTES:
            return value
        pages = mmap.mmap(-1, size, **PRIVATE)
        return torch.frombuffer(pages, dtype=value.dtype).view(value.shape).copy_(value)
    if type(value) is tuple:
        return tuple(map(_moved, value))
    if not is_dataclass(value) or isinstance(value, type):
        return value
    parts = {f.name: getattr(value, f.name) for f in fields(value) if f.init}
    moved = {name: new for name, part in parts.items() if (new := _moved(part)) is not part}
    return replace(value, **moved) if moved else value


def size_bytes(value: Any) -> int:
    """Bytes of all tensors in a tensor, dataclass, tuple or list."""
    if isinstance(value, torch.Tensor):
        return value.numel() * value.element_size()
    if is_dataclass(value) and not isinstance(value, type):
        value = [getattr(value, f.name) for f in fields(value)]
    return sum(map(size_bytes, value)) if isinstance(value, (tuple, list)) else 0
