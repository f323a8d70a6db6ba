"""A device that is not the CPU: operators refuse tensors of both, as with CUDA. What is there is computed here."""

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode, return_and_correct_aliasing
from torch.utils._pytree import tree_iter, tree_map_only

DEVICE = torch.device("meta")
COPIES = (torch.ops.aten.copy_.default, torch.ops.aten._to_copy.default)
INDEXING = ("aten::index", "aten::index_put", "aten::index_put_", "aten::_index_put_impl_")
"""These take indices on the CPU for a tensor elsewhere."""


class There(Tensor):
    """A tensor that is on the device."""

    values: Tensor

    @staticmethod
    def __new__(cls, values: Tensor) -> "There":
        layout = {"strides": values.stride(), "storage_offset": values.storage_offset(), "dtype": values.dtype}
        made = Tensor._make_wrapper_subclass(cls, values.size(), device=DEVICE, **layout)
        made.values = values
        return made

    def __getitem__(self, index):
        # Lists would become tensors without an operator.
        parts = [torch.as_tensor(p) if isinstance(p, list) else p for p in (index if type(index) is tuple else [index])]
        return super().__getitem__(tuple(parts))

    def tolist(self) -> list:
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
    assert sum(there) == sum(tensor.device == DEVICE for tensor in tensors), f"{operator}: a tensor without values"
    if operator not in COPIES:
        indexing = operator._schema.name in INDEXING
        compared = [args[0], *args[2:3]] if indexing else tensors
        compared = [isinstance(tensor, There) for tensor in compared if isinstance(tensor, Tensor) and tensor.dim()]
        if len(set(compared)) > 1 or (indexing and any(there) and not there[0]):
            shapes = [(type(tensor).__name__, tuple(tensor.shape)) for tensor in tensors]
            raise RuntimeError(f"expected tensors on one device, got {shapes} for {operator}")
    result_there = there[0] if operator is COPIES[0] else any(there)
    if (device := kwargs.get("device")) is not None:
        result_there, kwargs = torch.device(device) == DEVICE, kwargs | {"device": torch.device("cpu")}
    given = tree_map_only(There, lambda tensor: tensor.values, (args, kwargs))
    found = operator(*given[0], **given[1])
    if not result_there:
        return found
    found = tree_map_only(Tensor, lambda tensor: tensor if isinstance(tensor, There) else There(tensor), found)
    return return_and_correct_aliasing(operator, args, kwargs, found)


@contextmanager
def other_device(monkeypatch: pytest.MonkeyPatch) -> Iterator[torch.device]:
    """Within, tensors can be moved to the device, and made there."""
    make = torch.tensor

    def tensor(data, *, device=None, **options):
        return make(data, **options) if device is None else make(data, **options).to(device)

    def new_tensor(self, data, *, dtype=None, device=None):
        return make(data, dtype=dtype or self.dtype).to(device or self.device)

    # These would make their tensor without an operator, and know no such device.
    monkeypatch.setattr(torch, "tensor", tensor)
    monkeypatch.setattr(Tensor, "new_tensor", new_tensor)
    monkeypatch.setattr(torch, "autocast", lambda *_, **__: nullcontext())
    with _Operators():
        yield DEVICE
