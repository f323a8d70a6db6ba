"""A stand-in for a GPU: a device that is not the CPU, that refuses to mix tensors of both, and that counts.

Its tensors claim to be on the device `meta`, and are computed on the CPU. What a GPU would pay for is counted: kernels,
view operations (which cost the CPU time only), waits for the device, and copies to it.
"""

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode, return_and_correct_aliasing
from torch.utils._pytree import tree_iter, tree_map_only

DEVICE = torch.device("meta")
COPIES = (torch.ops.aten.copy_.default, torch.ops.aten._to_copy.default)
INDEXING = ("aten::index", "aten::index_put", "aten::index_put_", "aten::_index_put_impl_")
"""These take indices on the CPU for a tensor elsewhere."""
WAITING = (
    "aten::_local_scalar_dense",
    "aten::nonzero",
    "aten::masked_select",
    "aten::equal",
    "aten::is_nonzero",
    "aten::unique_dim",
    "aten::_unique2",
)
"""The CPU waits for the device in these, because a result or its size is needed."""
ALLOCATING = (
    "aten::empty",
    "aten::empty_strided",
    "aten::empty_like",
    "aten::new_empty",
    "aten::_unsafe_view",
)
"""These launch no kernel."""


@dataclass
class Counts:
    """What a GPU would have been asked to do."""

    kernels: int = 0
    """Operators that compute, each as one."""
    views: int = 0
    """Operators that only make another view of a tensor's memory, or reserve memory."""
    waits: int = 0
    """How often the CPU waits for a result of the device."""
    copies: int = 0
    """Copies from the CPU to the device."""
    by_operator: Counter[str] = field(default_factory=Counter)
    """How often each operator was called, of those that count as kernels or waits."""

    def reset(self) -> None:
        """Count from 0 again."""
        self.kernels = self.views = self.waits = self.copies = 0
        self.by_operator.clear()

    @property
    def row(self) -> tuple[int, int, int, int]:
        """Kernels, views, waits and copies."""
        return self.kernels, self.views, self.waits, self.copies


COUNTS = Counts()
"""The counts since the last `reset`; `other_device` resets them."""


class There(Tensor):
    """A tensor that is on the device."""

    values: Tensor

    @staticmethod
    def __new__(cls, values: Tensor) -> "There":
        layout = {
            "strides": values.stride(),
            "storage_offset": values.storage_offset(),
            "dtype": values.dtype,
        }
        made = Tensor._make_wrapper_subclass(cls, values.size(), device=DEVICE, **layout)
        made.values = values
        return made

    def __getitem__(self, index):
        # Lists would become tensors without an operator.
        parts = [
            torch.as_tensor(p) if isinstance(p, list) else p
            for p in (index if type(index) is tuple else [index])
        ]
        COUNTS.copies += sum(isinstance(part, list) for part in (index if type(index) is tuple else [index]))
        return super().__getitem__(tuple(parts))

    def tolist(self) -> list:
        COUNTS.waits += 1
        COUNTS.by_operator["tolist"] += 1
        return self.values.tolist()

    def __repr__(self) -> str:
        return f"There({self.values!r})"

    @classmethod
    def __torch_dispatch__(cls, operator, types, args=(), kwargs=None):
        return _compute(operator, args, kwargs or {})


class _Operators(TorchDispatchMode):
    def __torch_dispatch__(self, operator, types, args=(), kwargs=None):
        return _compute(operator, args, kwargs or {})


def _compute(operator, args, kwargs):
    tensors = [value for value in tree_iter((args, kwargs)) if isinstance(value, Tensor)]
    there = [isinstance(tensor, There) for tensor in tensors]
    assert sum(there) == sum(tensor.device == DEVICE for tensor in tensors), (
        f"{operator}: a tensor without values"
    )
    if operator not in COPIES:
        indexing = operator._schema.name in INDEXING
        compared = [args[0], *args[2:3]] if indexing else tensors
        compared = [
            isinstance(tensor, There) for tensor in compared if isinstance(tensor, Tensor) and tensor.dim()
        ]
        if len(set(compared)) > 1 or (indexing and any(there) and not there[0]):
            shapes = [(type(tensor).__name__, tuple(tensor.shape)) for tensor in tensors]
            raise RuntimeError(f"expected tensors on one device, got {shapes} for {operator}")
    result_there = there[0] if operator is COPIES[0] else any(there)
    if (device := kwargs.get("device")) is not None:
        result_there, kwargs = torch.device(device) == DEVICE, kwargs | {"device": torch.device("cpu")}
    if result_there or any(there):
        _count(operator, args, kwargs, there, result_there)
    given = tree_map_only(There, lambda tensor: tensor.values, (args, kwargs))
    found = operator(*given[0], **given[1])
    if not result_there:
        return found
    found = tree_map_only(
        Tensor, lambda tensor: tensor if isinstance(tensor, There) else There(tensor), found
    )
    return return_and_correct_aliasing(operator, args, kwargs, found)


def _count(operator, args: tuple, kwargs: dict[str, Any], there: list[bool], result_there: bool) -> None:
    """Count an operator on tensors of the device, or one that makes some."""
    name = operator._schema.name
    if operator in COPIES:
        source_there = there[1] if operator is COPIES[0] else there[0]
        if source_there and result_there:
            _count_kernel(name)
        elif source_there:
            _count_wait(f"{name} to the CPU")
        else:
            COUNTS.copies += 1
        return
    if name in ALLOCATING or any(
        r.alias_info is not None and not r.alias_info.is_write for r in operator._schema.returns
    ):
        COUNTS.views += 1
        return
    indices = list(args[1]) if name in INDEXING else []
    masks = sum(isinstance(index, There) and index.dtype == torch.bool for index in indices)
    COUNTS.copies += sum(isinstance(index, Tensor) and not isinstance(index, There) for index in indices)
    repeats_unknown = name == "aten::repeat_interleave" and kwargs.get("output_size") is None
    if masks or repeats_unknown or name in WAITING:
        _count_wait(name)
    _count_kernel(name)


def _count_kernel(name: str) -> None:
    COUNTS.kernels += 1
    COUNTS.by_operator[name] += 1


def _count_wait(name: str) -> None:
    COUNTS.waits += 1
    COUNTS.by_operator[f"wait: {name}"] += 1


@contextmanager
def other_device(monkeypatch: pytest.MonkeyPatch) -> Iterator[torch.device]:
    """Within, tensors can be moved to the device, and made there; `COUNTS` counts. There is no autocast."""
    make = torch.tensor

    def tensor(data, *, device=None, **options):
        return make(data, **options) if device is None else make(data, **options).to(device)

    def new_tensor(self, data, *, dtype=None, device=None):
        return make(data, dtype=dtype or self.dtype).to(device or self.device)

    attend = torch.nn.functional.scaled_dot_product_attention

    def fused_attention(*tensors, attn_mask=None, **options):
        """The fused kernel, which a GPU has in float32, too; it aligns a mask first."""
        if not isinstance(tensors[0], There):
            return attend(*tensors, attn_mask=attn_mask, **options)
        for _ in range(1 if attn_mask is None else 2):
            _count_kernel("fused attention")
        values = tree_map_only(There, lambda tensor: tensor.values, (tensors, attn_mask))
        return There(attend(*values[0], attn_mask=values[1], **options))

    monkeypatch.setattr(torch.nn.functional, "scaled_dot_product_attention", fused_attention)
    # These would make their tensor without an operator, and know no such device.
    monkeypatch.setattr(torch, "tensor", tensor)
    monkeypatch.setattr(Tensor, "new_tensor", new_tensor)
    # Autocast knows no such device.
    monkeypatch.setattr(torch, "autocast", lambda *_, **__: nullcontext())
    COUNTS.reset()
    with _Operators():
        yield DEVICE
