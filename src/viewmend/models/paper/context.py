"""The context of a view: encoded camera images, and tokens of several views as one padded batch (2, 4, 5 and 9)."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

from viewmend.geometry.cameras import Cameras, unproject
from viewmend.models.paper.config import PaperConfig
from viewmend.models.paper.patches import centers_px, reproject
from viewmend.models.paper.transformer import TokenPositions
from viewmend.types import IncompleteView

Positions = tuple[Float[Tensor, "_patch 3"], Bool[Tensor, "_patch"]]
"""(u, v, s) of patches, and which of them are valid."""


@dataclass(frozen=True)
class ContextFrame:
    """One camera image, encoded and lifted. It is independent of the novel view, so all viewers share it."""

    camera: Cameras
    """The camera (one view) at that frame."""
    time: int
    """Frame number."""
    places: Int[Tensor, "patch 2"]
    """Row and column of each kept patch."""
    uv_px: Float[Tensor, "patch 2"]
    """Patch centres in the camera's image, in pixels."""
    points_world: Float[Tensor, "patch 3"]
    """Patch centres lifted by the geometry of this frame, in metres."""
    valid: Bool[Tensor, "patch"]
    """Whether that geometry gives the patch a depth."""
    depths: Float[Tensor, "rows cols"]
    """z-depth of every patch of the grid, kept or not, in metres; 0 without depth. Older frames are
    lifted by it."""
    tokens: Float[Tensor, "patch dim"]
    """R of section 6."""
    keys_values: Float[Tensor, "block 2 patch dim"]
    """K and V of every block, before rotation."""

    def lifted_by(self, other: "ContextFrame") -> tuple[Float[Tensor, "patch 3"], Bool[Tensor, "patch"]]:
        """This frame's patch centres at the depths of the same camera in `other`, and validity (section 5)."""
        rows, cols = other.depths.shape
        row, col = self.places.unbind(1)
        inside = (row < rows) & (col < cols)
        z = torch.where(inside, other.depths[row.clamp_max(rows - 1), col.clamp_max(cols - 1)], 0.0)
        return unproject(self.uv_px[None], z[None], self.camera)[0], z > 0


def window_times(time: int, config: PaperConfig) -> tuple[int, ...]:
    """Frame numbers of the context of a view at `time`, latest first; none below 0 (section 2).

    `time` itself, the n_c frames before it, and t - k_w j for j from 1 to n_w.
    """
    near = range(time, time - config.n_c - 1, -1)
    far = (time - config.k_w * j for j in range(1, config.n_w + 1))
    return tuple(sorted({t for t in (*near, *far) if t >= 0}, reverse=True))


@dataclass(frozen=True)
class Target:
    """A novel view's kept patches. The incomplete ones are the input set P, the others join the context."""

    view: IncompleteView
    places: Int[Tensor, "patch 3"]
    tokens: Float[Tensor, "patch dim"]
    incomplete: Bool[Tensor, "patch"]
    """Patches with any pixel of E > 0; on the CPU, so that no device is read to find them."""


@dataclass(frozen=True)
class Batch:
    """The input of the transformer."""

    queries: Float[Tensor, "sample query dim"]
    counts: list[int]
    """How many queries of each sample are not padding."""
    at: TokenPositions
    keys_values: Float[Tensor, "block 2 sample key dim"]
    context_at: TokenPositions


def collate(
    targets: Sequence[Target],
    contexts: Sequence[Sequence[ContextFrame]],
    own_keys_values: Sequence[Float[Tensor, "block 2 _ dim"]],
    config: PaperConfig,
) -> Batch:
    """Pad the input tokens of all targets, and their context: first its frames, then the target's complete patches.

    `own_keys_values` are K and V of each target's complete patches.
    """
    queries = []
    query_positions = []
    keys = []
    key_positions = []
    for target, frames, own in zip(targets, contexts, own_keys_values, strict=True):
        # s = 0 in the novel view
        uvs = F.pad(centers_px(target.places) / target.view.camera.size_px[0], (0, 1))
        valid = torch.ones(len(uvs), dtype=torch.bool, device=uvs.device)
        queries.append(target.tokens[target.incomplete])
        query_positions.append((uvs[target.incomplete], valid[target.incomplete]))
        parts = [_carry(frames, target.view, config)] if frames else []
        parts.append((uvs[~target.incomplete], valid[~target.incomplete]))
        uv, is_valid = zip(*parts, strict=True)
        key_positions.append((torch.cat(uv), torch.cat(is_valid)))
        keys.append([*(frame.keys_values.to(own) for frame in frames), own])
    # At least one key, although it is not present: kernels do not accept empty tensors.
    num_keys = max(1, *(sum(part.shape[2] for part in parts) for parts in keys))
    num_queries = max(len(q) for q in queries)
    joined = [_join(parts, num_keys) for parts in keys]
    keys_values = torch.stack(joined, 2) if len(joined) > 1 else joined[0][:, :, None]  # one sample: no copy
    padded = torch.stack([_pad(q, num_queries) for q in queries])
    counts = [len(own_queries) for own_queries in queries]
    return Batch(
        padded, counts, _stack(query_positions, num_queries), keys_values, _stack(key_positions, num_keys)
    )


def _carry(frames: Sequence[ContextFrame], view: IncompleteView, config: PaperConfig) -> Positions:
    """C_G(x) of the patches of all frames, one after the other."""
    lifted = [_lift(frame, frames, view) for frame in frames]
    points = torch.cat([points for points, _ in lifted])
    has_surface = torch.cat([valid for _, valid in lifted])
    uv, in_front = reproject(points, has_surface, view.camera)
    s = [torch.full_like(frame.uv_px[:, :1], (view.time - frame.time) / config.window) for frame in frames]
    return torch.cat([uv, torch.cat(s)], 1), in_front


def _lift(
    frame: ContextFrame, frames: Sequence[ContextFrame], view: IncompleteView
) -> tuple[Float[Tensor, "patch 3"], Bool[Tensor, "patch"]]:
    """A frame's patch centres. Past frames use the current geometry, if their camera has a current frame."""
    if frame.time != view.time:
        current = [f for f in frames if f.camera.names == frame.camera.names and f.time == view.time]
        if current:
            return frame.lifted_by(current[0])
    return frame.points_world, frame.valid


def _stack(positions: Sequence[Positions], length: int) -> TokenPositions:
    return TokenPositions(
        *(torch.stack([_pad(own, length) for own in v]) for v in zip(*positions, strict=True))
    )


def _join(parts: Sequence[Float[Tensor, "block 2 _ dim"]], length: int) -> Float[Tensor, "block 2 key dim"]:
    """The parts concatenated and zero-padded to this length, in a single copy: they take most of a step's memory."""
    blocks, two, _, dim = parts[0].shape
    missing = length - sum(part.shape[2] for part in parts)
    return torch.cat([*parts, parts[0].new_zeros(blocks, two, missing, dim)], 2)


def _pad(rows: Float[Tensor, "row *feature"] | Bool[Tensor, "row"], length: int) -> Tensor:
    """The rows, followed by zeros (or False) up to this length."""
    return torch.cat([rows, rows.new_zeros(length - len(rows), *rows.shape[1:])])
