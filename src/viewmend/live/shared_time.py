"""One time of a rig as processes share it: read where it lies, without copies."""

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

from viewmend.geometry.bounds import Bounds
from viewmend.geometry.hull import HullConfig
from viewmend.geometry.proxy import GeometryProxy
from viewmend.inpainting.protocol import ContextProvider, Memory, ViewInpainter, encode_cameras
from viewmend.observation import Observation, observe
from viewmend.own_pages import size_bytes
from viewmend.views import MultiViewFrame


@dataclass(frozen=True)
class SharedTime:
    """A frame and all that was made of it before anybody looked.

    It is pickled as arrays beside a few hundred bytes (protocol 5, out of band). Whoever keeps them in memory that
    processes share, as Ray's object store does, gives each its tensors there: read only, and as long as they are used.
    """

    frame: MultiViewFrame
    proxy: GeometryProxy | None
    """The visual hull; None where none can be carved, which whoever renders the time finds again, and says why."""
    depths: dict[str, Float[Tensor, "_height _width"]]
    """The hull's depth in each camera."""
    encoded: Memory
    """What the inpainter encodes of each camera: tokens, or pyramids."""

    @classmethod
    def of(
        cls, frame: MultiViewFrame, bounds: Bounds | None, hull: HullConfig, inpainter: ViewInpainter
    ) -> "SharedTime":
        """A frame with its hull, the hull's depth in the cameras, and what the inpainter encodes of them."""
        try:
            observation = observe(frame, bounds, hull)
        except ValueError:
            return cls(frame, None, {}, {})
        assert isinstance(observation.proxy, GeometryProxy), "it was carved"
        views = observation.context(frame.cameras.names)
        if views is not None:
            context = ContextProvider(lambda _, names: observation.context(names), memory=lambda _: observation.encoded)
            encode_cameras(inpainter, views, context)
        return cls(frame, observation.proxy, observation.depths, observation.encoded)

    def observation(self) -> Observation | None:
        """The same as a stream keeps it; None without a hull."""
        return None if self.proxy is None else Observation(self.frame, self.proxy, 0.0, self.encoded, self.depths)

    @cached_property
    def bytes(self) -> int:
        """What its arrays take."""
        made = [*self.depths.values(), *self.encoded.values()]
        hull = () if self.proxy is None else (self.proxy.mesh.vertices, self.proxy.mesh.faces, self.proxy.normals)
        return size_bytes([self.frame.rgb, self.frame.mask, *hull, *made])

    def __reduce__(self) -> tuple[Any, ...]:
        content = io.BytesIO()
        lender = _Lender(content, protocol=5)
        lender.dump({part.name: getattr(self, part.name) for part in fields(self)})
        return _returned, (content.getvalue(), lender.lent)


class _Lender(pickle.Pickler):
    """Pickles everything but tensors, which are lent as arrays: one that is met twice, once."""

    def __init__(self, file: io.BytesIO, protocol: int) -> None:
        super().__init__(file, protocol)
        self.lent: list[np.ndarray] = []
        self._met: dict[int, int] = {}

    def persistent_id(self, obj: Any) -> int | None:
        if not isinstance(obj, torch.Tensor):
            return None
        if id(obj) not in self._met:
            self._met[id(obj)] = len(self.lent)
            self.lent.append(obj.detach().contiguous().numpy())
        return self._met[id(obj)]


class _Borrower(pickle.Unpickler):
    def __init__(self, file: io.BytesIO, tensors: Sequence[Tensor]) -> None:
        super().__init__(file)
        self._tensors = tensors

    def persistent_load(self, pid: int) -> Tensor:
        return self._tensors[pid]


def _returned(content: bytes, lent: Sequence[np.ndarray]) -> SharedTime:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="The given NumPy array is not writable")  # nobody writes there
        tensors = [torch.from_numpy(array) for array in lent]
    return SharedTime(**_Borrower(io.BytesIO(content), tensors).load())
