"""A frame as processes share it: its arrays stay where they are, without copies."""

import io
import pickle
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from viewmend.frame_cache import CachedFrame, cache_frame
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.hull import HullConfig
from viewmend.geometry.proxy import GeometryProxy
from viewmend.models.base import ContextProvider, Inpainter, Memory
from viewmend.types import MultiViewFrame
from viewmend.utils.mmap_tensors import size_bytes


@dataclass(frozen=True)
class SharedFrame:
    """A frame and everything that is computed from it whatever the view.

    It is pickled as a few hundred bytes and out-of-band arrays (pickle protocol 5). If these are kept in shared memory,
    as in Ray's object store, the tensors of all processes lie there, read-only.
    """

    frame: MultiViewFrame
    proxy: GeometryProxy | None
    """The visual hull; None if it cannot be carved, in which case the renderer raises the reason again."""
    depths: dict[str, Float[Tensor, "_height _width"]]
    """Depth of the hull in each camera."""
    encoded: Memory
    """The inpainter's encodings of each camera: tokens, or pyramids."""

    @classmethod
    def prepare(
        cls, frame: MultiViewFrame, bounds: Bounds | None, hull: HullConfig, inpainter: Inpainter
    ) -> "SharedFrame":
        """Carve the hull of a frame, render its depth in the cameras, and encode these with the inpainter."""
        try:
            cached = cache_frame(frame, bounds, hull)
        except ValueError:
            return cls(frame, None, {}, {})
        assert isinstance(cached.proxy, GeometryProxy), "it was carved"
        views = cached.context(frame.cameras.names)
        if views is not None:
            context = ContextProvider(lambda _, names: cached.context(names), memory=lambda _: cached.encoded)
            inpainter.encode_cameras(views, context)
        return cls(frame, cached.proxy, cached.depths, cached.encoded)

    def cached_frame(self) -> CachedFrame | None:
        """The frame in the form that a stream keeps; None without a hull."""
        return None if self.proxy is None else CachedFrame(self.frame, self.proxy, 0.0, self.encoded, self.depths)

    @cached_property
    def size_bytes(self) -> int:
        """Bytes of all arrays."""
        made = [*self.depths.values(), *self.encoded.values()]
        hull = () if self.proxy is None else (self.proxy.mesh.vertices, self.proxy.mesh.faces, self.proxy.normals)
        return size_bytes([self.frame.rgb, self.frame.mask, *hull, *made])

    def __reduce__(self) -> tuple[Any, ...]:
        content = io.BytesIO()
        pickler = _TensorPickler(content, protocol=5)
        pickler.dump({part.name: getattr(self, part.name) for part in fields(self)})
        return _unpickle, (content.getvalue(), pickler.arrays)


class _TensorPickler(pickle.Pickler):
    """Pickles everything but tensors, which are collected as arrays, each of them once."""

    def __init__(self, file: io.BytesIO, protocol: int) -> None:
        super().__init__(file, protocol)
        self.arrays: list[np.ndarray] = []
        self._indices: dict[int, int] = {}

    def persistent_id(self, obj: Any) -> int | None:
        if not isinstance(obj, torch.Tensor):
            return None
        if id(obj) not in self._indices:
            self._indices[id(obj)] = len(self.arrays)
            self.arrays.append(obj.detach().contiguous().numpy())
        return self._indices[id(obj)]


class _TensorUnpickler(pickle.Unpickler):
    def __init__(self, file: io.BytesIO, tensors: Sequence[Tensor]) -> None:
        super().__init__(file)
        self._tensors = tensors

    def persistent_load(self, pid: int) -> Tensor:
        return self._tensors[pid]


def _unpickle(content: bytes, arrays: Sequence[np.ndarray]) -> SharedFrame:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="The given NumPy array is not writable")  # they are only read
        tensors = [torch.from_numpy(array) for array in arrays]
    return SharedFrame(**_TensorUnpickler(io.BytesIO(content), tensors).load())
