"""Frames that processes share, with everything that does not depend on the view; arrays are not copied."""

import copyreg
import io
import pickle
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from viewmend.frame_cache import CachedFrame, cache_frame
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.hull import HullConfig
from viewmend.models.base import ContextProvider, Inpainter
from viewmend.types import MultiViewFrame
from viewmend.utils.tensors import size_bytes


@dataclass(frozen=True)
class SharedFrame:
    """A frame and everything that is computed from it whatever the view.

    It is pickled as a few hundred bytes and out-of-band arrays (pickle protocol 5). If
    these are kept in shared memory, as in Ray's object store, the tensors of all processes
    lie there, read-only.
    """

    frame: MultiViewFrame
    cached: CachedFrame | None
    """The frame with its hull, its depth in each camera, and the inpainter's encodings; None if no
    hull can be carved, in which case the renderer raises the reason again."""

    @classmethod
    def prepare(
        cls, frame: MultiViewFrame, bounds: Bounds | None, hull: HullConfig, inpainter: Inpainter
    ) -> "SharedFrame":
        """Carve the hull of a frame, render its depth in the cameras, and encode these with the inpainter."""
        try:
            cached = cache_frame(frame, bounds, hull)
        except ValueError:
            return cls(frame, None)
        cached.pop_geometry_ms()  # it was spent elsewhere
        views = cached.context(frame.cameras.names)
        if views is not None:
            context = ContextProvider(lambda _, names: cached.context(names), memory=lambda _: cached.encoded)
            inpainter.encode_cameras(views, context)
        return cls(frame, cached)

    @cached_property
    def size_bytes(self) -> int:
        """Bytes of all arrays."""
        return size_bytes([self.frame.rgb, self.frame.mask]) if self.cached is None else self.cached.size

    def __reduce__(self) -> tuple[Any, ...]:
        content = io.BytesIO()
        buffers: list[pickle.PickleBuffer] = []
        pickler = pickle.Pickler(content, 5, buffer_callback=buffers.append)
        pickler.dispatch_table = copyreg.dispatch_table | {Tensor: _as_array}
        pickler.dump((self.frame, self.cached))
        return _unpickle, (content.getvalue(), buffers)


def _as_array(tensor: Tensor) -> tuple[Any, ...]:
    """A tensor for pickle: an array, whose buffer is out of band."""
    return torch.from_numpy, (tensor.detach().contiguous().numpy(),)


def _unpickle(content: bytes, buffers: Sequence[Any]) -> SharedFrame:
    with warnings.catch_warnings():
        # The arrays are only read
        warnings.filterwarnings("ignore", message="The given NumPy array is not writable")
        return SharedFrame(*pickle.loads(content, buffers=buffers))
