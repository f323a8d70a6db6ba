"""One padded batch from novel views and their contexts, with coordinates in each novel view (sections 2 and 5)."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

from viewmend.inpainting.config import InpainterConfig
from viewmend.inpainting.context import ContextFrame
from viewmend.inpainting.coordinates import reproject
from viewmend.inpainting.patches import STEP_PX, centers_px
from viewmend.inpainting.transformer import TokenPositions
from viewmend.views import IncompleteView


@dataclass(frozen=True)
class Target:
    """A novel view's own kept patches. The incomplete ones are the input set P, the others join the context."""

    view: IncompleteView
    places: Int[Tensor, "patch 3"]
    tokens: Float[Tensor, "patch dim"]
    shown: Float[Tensor, "channel height width"]
    """The view as the encoder was shown it."""
    incomplete: Bool[Tensor, "patch"]


@dataclass(frozen=True)
class Batch:
    """What the transformer works on."""

    queries: Float[Tensor, "sample query dim"]
    at: TokenPositions
    keys_values: Float[Tensor, "block 2 sample key dim"]
    context_at: TokenPositions


def assemble(
    targets: Sequence[Target],
    contexts: Sequence[Sequence[ContextFrame]],
    own_keys_values: Sequence[Float[Tensor, "block 2 _ dim"]],
    config: InpainterConfig,
) -> Batch:
    """Pads the targets' input tokens, and their context: the frames and then their own complete patches."""
    queries, asking, keys, context = [], [], [], []
    for target, frames, own in zip(targets, contexts, own_keys_values, strict=True):
        uvs = F.pad(centers_px(target.places) / whole_size_px(target.view), (0, 1))  # where they are, now
        queries.append(target.tokens[target.incomplete])
        asking.append((uvs[target.incomplete], torch.ones_like(uvs[target.incomplete, 0], dtype=torch.bool)))
        carried = [_carried(frame, frames, target.view, config) for frame in frames]
        complete = uvs[~target.incomplete]
        carried.append((complete, torch.ones_like(complete[:, 0], dtype=torch.bool)))
        context.append((torch.cat([uvs for uvs, _ in carried]), torch.cat([valid for _, valid in carried])))
        keys.append([*(frame.keys_values.to(own) for frame in frames), own])
    # One key at least, though it does not count: kernels dislike empty tensors.
    most = max(1, *(sum(part.shape[2] for part in parts) for parts in keys))
    length = max(len(q) for q in queries)
    queries, joined = torch.stack([_padded(q, length) for q in queries]), [_joined(parts, most) for parts in keys]
    keys_values = torch.stack(joined, 2) if len(joined) > 1 else joined[0][:, :, None]  # of one, no copy
    return Batch(queries, _placed(asking, targets, length), keys_values, _placed(context, targets, most))


def whole_size_px(view: IncompleteView) -> Int[Tensor, "2"]:
    """Width and height of a view, or of that of which it is a part: what (u, v) are measured in."""
    own = view.camera.size_px[0]
    return own if view.part is None else own.new_tensor(view.part.whole_size_px)


def _carried(
    frame: ContextFrame, frames: Sequence[ContextFrame], view: IncompleteView, config: InpainterConfig
) -> tuple[Float[Tensor, "patch 3"], Bool[Tensor, "patch"]]:
    """(u, v, s) of a camera's patches in the novel view, and which of them count."""
    points, valid = frame.points_world, frame.valid
    if config.past_geometry == "current" and frame.time != view.time:
        now = [f for f in frames if f.name == frame.name and f.time == view.time]
        if now:
            points, valid = frame.lifted_by(now[0])
    uv, counts = reproject(points, valid, view.camera)
    uv = uv * (view.camera.size_px[0] / whole_size_px(view))
    s = torch.full_like(uv[:, :1], (view.time - frame.time) / config.window)
    return torch.cat([uv, s], 1), counts


def _placed(
    parts: Sequence[tuple[Float[Tensor, "_ 3"], Bool[Tensor, "_"]]], targets: Sequence[Target], length: int
) -> TokenPositions:
    uvs = torch.stack([_padded(uvs, length) for uvs, _ in parts])
    sizes = torch.stack([F.pad(whole_size_px(t.view) / STEP_PX, (0, 1), value=1.0) for t in targets])
    return TokenPositions(uvs, uvs * sizes[:, None], torch.stack([_padded(present, length) for _, present in parts]))


def _joined(parts: Sequence[Float[Tensor, "block 2 _ dim"]], length: int) -> Float[Tensor, "block 2 key dim"]:
    """One after the other, and zeros up to this length: in one copy, for these are most of a step's memory."""
    blocks, two, _, dim = parts[0].shape
    missing = length - sum(part.shape[2] for part in parts)
    return torch.cat([*parts, parts[0].new_zeros(blocks, two, missing, dim)], 2)


def _padded(rows: Tensor, length: int) -> Tensor:
    """Rows of zeros (or False) below, up to this length."""
    missing = rows.new_zeros(length - len(rows), *rows.shape[1:])
    return torch.cat([rows, missing])
