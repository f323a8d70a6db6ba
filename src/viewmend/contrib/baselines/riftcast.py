"""RIFTCast's own inpainting: DSTT with memory on the whole view at 432x240, six slots."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import interpolate

from viewmend.contrib.baselines.dstt import DSTT
from viewmend.contrib.baselines.token_transformer import NATIVE_PX, MemorySlot
from viewmend.models.base import ContextProvider, Inpainter, State
from viewmend.models.compositing import blend
from viewmend.types import CompletedView, IncompleteView

SLOTS = 6


@dataclass(frozen=True)
class RiftCastState(State):
    """What the last frames left behind, oldest first."""

    slots: tuple[MemorySlot, ...] = ()


class RiftCast(Inpainter):
    """Every frame of a stream is resized to 432x240 whatever its aspect, completed from the memory of six others.

    Holes are not dilated and stay soft; only pixels with E > 0 change. The memory is of the last six frames. With
    `as_published` it is what RIFTCast's code makes of it: nothing is remembered before six frames are there; then the
    memory is rolled by one number instead of one slot, so that all but the last slot stay those first frames.
    """

    def __init__(self, network: DSTT, as_published: bool = False) -> None:
        self.network, self.as_published = network, as_published

    def initial_state(self) -> RiftCastState:
        """A stream without a past."""
        return RiftCastState()

    @torch.inference_mode()
    def step(self, view: IncompleteView, context: ContextProvider, state: State) -> tuple[CompletedView, RiftCastState]:
        """The completed view; `context` is never asked. Views without holes go through the network too."""
        slots = state.slots if isinstance(state, RiftCastState) else ()
        small = _area_resized(torch.cat([view.rgb, view.error[None]]), NATIVE_PX)
        frame = (2 * small[:3] - 1) * (1 - small[3])
        used = () if self.as_published and len(slots) < SLOTS else slots
        completed, slot = self.network.complete_remembering(frame[None], used)
        filled = _area_resized(((completed + 1) / 2).clamp(0, 1), (view.rgb.shape[1], view.rgb.shape[2]))
        mended = blend(view.rgb, view.error, filled, torch.ones_like(view.error))
        return CompletedView(view, mended), RiftCastState(slots=self._remembered(slots, slot))

    def _remembered(self, slots: tuple[MemorySlot, ...], new: MemorySlot) -> tuple[MemorySlot, ...]:
        if self.as_published and len(slots) == SLOTS:
            rolled = torch.stack(slots).roll(-1)
            return (*rolled[:-1].unbind(), new)
        return (*slots, new)[-SLOTS:]


def _area_resized(
    image: Float[Tensor, "channel height width"], size: tuple[int, int]
) -> Float[Tensor, "channel newheight newwidth"]:
    return interpolate(image[None], size=size, mode="area")[0].clamp(0, 1)
