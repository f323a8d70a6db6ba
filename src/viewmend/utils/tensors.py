"""Tensors in dataclasses and tuples: moved to a device, copied to memory of their own, counted; checks of one tensor.

Long-lived tensors between short-lived ones keep the C library from returning memory: a
server that runs for hours would occupy several times what it stores. So they are copied to
their own memory mappings.
"""

import mmap
from collections.abc import Callable, Iterable, Sequence
from dataclasses import fields, is_dataclass, replace
from typing import Any, ClassVar, TypeVar

import torch
from torch import Tensor

LARGE_BYTES = 1 << 16
"""Smaller tensors are not copied."""
PRIVATE = {"flags": mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS} if hasattr(mmap, "MAP_PRIVATE") else {}
"""Private mappings, so that a forked process gets a copy; not needed on Windows."""

T = TypeVar("T")


class OnDevice:
    """Base class of dataclasses of tensors."""

    keeps_host_copy: ClassVar[bool] = False
    """Whether a copy on another device keeps what it was copied from, because code on the CPU needs
    its numbers."""

    def to(self: T, device: torch.device | str) -> T:
        """The same with all tensors on `device`."""
        return to_device(self, device)

    @property
    def on_host(self: T) -> T:
        """The same on the CPU; itself if it is there. A device is read only once, and not at all for a copy on it."""
        if "_host" in vars(self):
            return vars(self)["_host"]
        host = to_device(self, "cpu")
        if host is not self:
            vars(self)["_host"] = host
        return host


def to_device(value: T, device: torch.device | str) -> T:
    """A tensor, or the tuple or dataclass with all of its tensors, on `device`; other values as they are."""
    return _changed(value, lambda tensor: tensor.to(device))


def to_mmap(value: T) -> T:
    """Copy the large CPU tensors of a tensor, dataclass or tuple to their own memory mappings.

    The memory returns to the system when the copy is freed. Costs about a millisecond for 3 MB.
    """
    return _changed(value, _copied)


def _copied(tensor: Tensor) -> Tensor:
    size = tensor.numel() * tensor.element_size()
    if tensor.device.type != "cpu" or size < LARGE_BYTES:
        return tensor
    return (
        torch.frombuffer(mmap.mmap(-1, size, **PRIVATE), dtype=tensor.dtype).view(tensor.shape).copy_(tensor)
    )


def _changed(value: Any, change: Callable[[Tensor], Tensor]) -> Any:
    if isinstance(value, Tensor):
        return change(value)
    if type(value) is tuple:
        items = tuple(_changed(item, change) for item in value)
        same = all(new is old for new, old in zip(items, value, strict=True))
        return value if same else items
    if not is_dataclass(value) or isinstance(value, type):
        return value
    changed = {}
    for field in fields(value):
        part = getattr(value, field.name) if field.init else None
        new = _changed(part, change)
        if new is not part:
            changed[field.name] = new
    if not changed:
        return value
    made = replace(value, **changed)
    if isinstance(value, OnDevice) and value.keeps_host_copy:
        vars(made)["_host"] = value.on_host
    return made


def size_bytes(value: Any) -> int:
    """Bytes of all tensors in a tensor, dataclass, tuple or list."""
    if isinstance(value, Tensor):
        return value.numel() * value.element_size()
    if is_dataclass(value) and not isinstance(value, type):
        value = [getattr(value, f.name) for f in fields(value)]
    return sum(map(size_bytes, value)) if isinstance(value, (tuple, list)) else 0


def check_tensor(
    name: str,
    value: object,
    dtypes: Sequence[torch.dtype],
    shape: Sequence[int],
    *,
    convert: str,
    arrange: str,
    padded: bool = False,
) -> Tensor:
    """The value; ValueError unless it is a tensor of one of these types and of this shape.

    Args:
        name: what the message calls it.
        value: the tensor.
        dtypes: allowed types.
        shape: expected shape; with `padded`, height and width (the last two) may be larger.
        convert: what to do about another type.
        arrange: what to do about another shape.
        padded: whether larger images are allowed.
    """
    if not isinstance(value, Tensor):
        raise ValueError(
            f"expected {name} as a tensor, got {type(value).__name__}; convert it with torch.as_tensor"
        )
    fixed = len(shape) - 2 if padded else len(shape)
    same = value.ndim == len(shape) and tuple(value.shape[:fixed]) == tuple(shape[:fixed])
    if not same or any(own < least for own, least in zip(value.shape[fixed:], shape[fixed:], strict=True)):
        least = " or larger images" if padded else ""
        raise ValueError(
            f"expected {name} of shape {tuple(shape)}{least}, got {tuple(value.shape)}; {arrange}"
        )
    if value.dtype not in dtypes:
        raise ValueError(f"expected {name} as {' or '.join(map(str, dtypes))}, got {value.dtype}; {convert}")
    return value


def nonzero_of(*masks: Tensor) -> list[Tensor]:
    """`torch.nonzero` of each mask; waits for a GPU only once."""
    if masks[0].device.type == "cpu":
        return [torch.nonzero(mask) for mask in masks]
    return [
        torch.nonzero_static(mask, size=count) for mask, count in zip(masks, counts_of(*masks), strict=True)
    ]


def counts_of(*masks: Tensor) -> list[int]:
    """How many elements of each mask are true; waits for a GPU only once."""
    return torch.stack([mask.sum() for mask in masks]).tolist()


def extremes(images: Iterable[Tensor]) -> list[tuple[float, float]]:
    """The smallest and the largest number of each image, both NaN if any is; waits for a GPU only once."""
    found = torch.stack([extreme for image in images for extreme in image.detach().aminmax()])
    return [(low, high) for low, high in found.view(-1, 2).float().tolist()]
