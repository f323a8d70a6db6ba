"""Windows whose context is encoded already: what costs most of a step is done once, where the encoder is held still.

Ours. With an encoder that was taught before (`autoencoder`, `copies`), the transformer is what is left to learn, and a
step of windows takes a third of the time.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from viewmend.inpainting.context import ContextFrame, window_times
from viewmend.inpainting.patch_transformer import PatchTransformer
from viewmend.views import ContextViews, IncompleteView

KEPT = torch.bfloat16
"""What tokens are kept as: attention works in it."""


@dataclass(frozen=True)
class EncodedContext:
    """The context of a view as an encoder made it."""

    frames: tuple[ContextFrame, ...]
    """Every camera at every time, without keys and values, which are learned."""
    encoder: str
    """What encoded it, by `fingerprint`."""


def fingerprint(net: PatchTransformer) -> str:
    """A name of the encoder's weights: tokens of others mean nothing to what reads this one's."""
    found = hashlib.sha256()
    for name, value in sorted(net.tokeniser.state_dict().items()):
        found.update(name.encode() + value.detach().cpu().float().numpy().tobytes())
    return found.hexdigest()[:16]


@torch.no_grad()
def encode(net: PatchTransformer, view: IncompleteView, context: Sequence[ContextViews]) -> EncodedContext:
    """The images of a view's context, encoded: of the cameras and times that the net looks at."""
    many = net.encode_contexts([c for c in net.looked_at(view, context) if isinstance(c, ContextViews)])
    frames = [frame for own in many for frame in own]
    bare = (replace(f, tokens=f.tokens.to(KEPT), keys_values=f.keys_values[:0]) for f in frames)
    return EncodedContext(tuple(bare), fingerprint(net))


def with_keys(net: PatchTransformer, view: IncompleteView, context: EncodedContext) -> list[ContextFrame]:
    """The frames of the cameras and times that the net looks at, with its keys and values; gradients reach these."""
    names, times = net.context_names(view), window_times(view.time, net.config)
    kept = [frame for frame in context.frames if frame.name in names and frame.time in times]
    if not kept:
        return []
    with net.autocast():
        projected = net.transformer.project_context(torch.cat([frame.tokens.float() for frame in kept]))
    parts = projected.split([len(frame.tokens) for frame in kept], 2)
    return [replace(frame, keys_values=own) for frame, own in zip(kept, parts, strict=True)]
