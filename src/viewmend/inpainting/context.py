"""What an inpainter remembers of the input cameras (sections 2 and 9)."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from viewmend.geometry.cameras import Cameras, unproject
from viewmend.inpainting.config import InpainterConfig


@dataclass(frozen=True)
class ContextFrame:
    """One camera at one time: its patches, encoded and lifted. It depends on no novel view."""

    camera: Cameras
    """The camera (one view) as it was then."""
    time: int
    places: Int[Tensor, "patch 2"]
    """Row and column of each kept patch."""
    uv_px: Float[Tensor, "patch 2"]
    """Centres of the patches in the camera's image, pixels."""
    points_world: Float[Tensor, "patch 3"]
    """The centres lifted by the geometry of this frame's own time, metres."""
    valid: Bool[Tensor, "patch"]
    """Whether that geometry gave the patch a depth."""
    depths: Float[Tensor, "rows cols"]
    """z-depth of every patch of the grid, kept or not (0: none): carries older frames in the paper's variant."""
    tokens: Float[Tensor, "patch dim"]
    keys_values: Float[Tensor, "block 2 patch dim"]
    """K and V of every block, before rotation."""

    @property
    def name(self) -> str:
        """The camera's name."""
        return self.camera.names[0]

    @property
    def uv(self) -> Float[Tensor, "patch 2"]:
        """Centres normalised by the image's size."""
        return self.uv_px / self.camera.size_px

    def lifted_by(self, other: "ContextFrame") -> tuple[Float[Tensor, "patch 3"], Bool[Tensor, "patch"]]:
        """This frame's centres at the depths that the same camera has in `other`: the paper's variant of C_G."""
        rows, cols = other.depths.shape
        row, col = self.places.unbind(1)
        inside = (row < rows) & (col < cols)
        z = torch.where(inside, other.depths[row.clamp_max(rows - 1), col.clamp_max(cols - 1)], 0.0)
        return unproject(self.uv_px[None], z[None], self.camera)[0], z > 0


@dataclass(frozen=True)
class ContextCache:
    """The frames that a stream may still need. A value: `add` gives a new one."""

    frames: Mapping[tuple[str, int], ContextFrame] = field(default_factory=lambda: MappingProxyType({}))
    """By camera name and time."""

    def add(self, frames: Iterable[ContextFrame], time: int, config: InpainterConfig) -> "ContextCache":
        """The cache at `time` with these frames, without those that no later view can ask for, nor later ones."""
        merged = dict(self.frames) | {(f.name, f.time): f for f in frames}
        kept = {key: f for key, f in merged.items() if _still_wanted(f.time, time, config)}
        return ContextCache(MappingProxyType(kept))

    def find(self, names: Sequence[str], times: Sequence[int]) -> tuple[ContextFrame, ...]:
        """The frames at hand of these cameras and times, in that order."""
        keys = [(name, time) for time in times for name in names]
        return tuple(self.frames[key] for key in keys if key in self.frames)

    def missing(self, names: Sequence[str], time: int) -> tuple[str, ...]:
        """The cameras whose frame at `time` is not at hand."""
        return tuple(name for name in names if (name, time) not in self.frames)


def window_times(time: int, config: InpainterConfig) -> tuple[int, ...]:
    """The times whose frames are the context of a view at `time`, latest first; none before 0.

    `time` itself, the n_c before it, and n_w further back: time - k_w j, or the latest multiples of k_w before
    those n_c ("absolute").
    """
    near = range(time, time - config.n_c - 1, -1)
    if config.grid == "relative":
        far = [time - config.k_w * j for j in range(1, config.n_w + 1)]
    else:
        latest = (time - config.n_c - 1) // config.k_w
        far = [config.k_w * (latest - j) for j in range(config.n_w)]
    return tuple(sorted({t for t in (*near, *far) if t >= 0}, reverse=True))


def _still_wanted(frame_time: int, time: int, config: InpainterConfig) -> bool:
    """Whether a view at `time` or later may ask for a frame of `frame_time`."""
    age = time - frame_time
    if config.grid == "relative":
        return 0 <= age <= config.window
    return frame_time in window_times(time, config)
