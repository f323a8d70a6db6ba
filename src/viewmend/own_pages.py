"""Memory of its own for what a stream keeps.

Results that live for seconds lie between those that live for milliseconds: freed, these leave holes that the C library
can hardly use or give back, and a server that runs for hours occupies a multiple of what it stores.
"""

import mmap
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

import torch

LARGE_BYTES = 1 << 16
"""Smaller tensors stay where they are."""
PRIVATE = {"flags": mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS} if hasattr(mmap, "MAP_PRIVATE") else {}
"""A process that is forked has a copy, as of the heap; Windows does not fork."""

T = TypeVar("T")


def to_own_pages(value: T) -> T:
    """The tensor, or the dataclass or tuple of such, with copies of what is large and on the CPU in pages of its own.

    They go back to the system with the copy. It costs about a millisecond for 3 MB.
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
    """Bytes of the tensors in a tensor, a dataclass, or a tuple or list of such."""
    if isinstance(value, torch.Tensor):
        return value.numel() * value.element_size()
    if is_dataclass(value) and not isinstance(value, type):
        value = [getattr(value, f.name) for f in fields(value)]
    return sum(map(size_bytes, value)) if isinstance(value, (tuple, list)) else 0
