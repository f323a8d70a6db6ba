"""Published networks by name, with weights of their authors or of our training.

`NETWORK-VARIANT-FRAMING`: a network of `NETWORKS`; o or om (`OnlineConfig.memory`); def, win or mul
(`OnlineConfig.framing`). Then, optionally, `-relative` (`Sampling.grid`). The weights are the authors'; with
`-finetuned` those that our training wrote to `finetuned/NETWORK/`, with `@PATH` those of a run's folder, or of a file.
`riftcast` and `riftcast-published` are DSTT as RIFTCast runs it.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import interpolate

from viewmend.contrib.baselines.e2fgvi import E2FGVI, E2FGVIHQ
from viewmend.contrib.baselines.online import OnlineConfig, OnlineInpainter, Sampling
from viewmend.contrib.baselines.token_transformers import DSTT, NATIVE_PX, FuseFormer, MemorySlot
from viewmend.metrics.weights import KnownWeights, checked_weights, known_weights
from viewmend.models.base import ContextProvider, Inpainter, State
from viewmend.models.compositing import blend
from viewmend.types import CompletedView, IncompleteView
from viewmend.utils.weight_files import load_weights

SLOTS = 6
"""Frames in RIFTCast's memory."""


@dataclass(frozen=True)
class RiftCastState(State):
    """The last frames' tokens, oldest first."""

    slots: tuple[MemorySlot, ...] = ()


class RiftCast(Inpainter):
    """RIFTCast's inpainting: DSTT with a memory of the last six frames on the whole view, resized to 432x240.

    Holes are not dilated and stay soft; only pixels with E > 0 change. `as_published` reproduces RIFTCast's code:
    nothing is remembered before six frames; then the memory is rolled by one number instead of one slot, so that all
    but the last slot stay those first frames.
    """

    def __init__(self, network: DSTT, as_published: bool = False) -> None:
        self.network, self.as_published = network, as_published

    def initial_state(self) -> RiftCastState:
        """A stream without a past."""
        return RiftCastState()

    @torch.inference_mode()
    def step(self, view: IncompleteView, context: ContextProvider, state: State) -> tuple[CompletedView, RiftCastState]:
        """The completed view; `context` is not used. Views without holes go through the network too."""
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


NETWORKS: dict[str, Callable[[], DSTT | FuseFormer | E2FGVI]] = {
    "dstt": DSTT,
    "fuseformer": FuseFormer,
    "e2fgvi": E2FGVI,
    "e2fgvi-hq": E2FGVIHQ,
}
"""The published networks by the names of methods, weights and recipes."""
TRAINED = "model.safetensors"
"""The weights in the folder of a run."""
_NAME = re.compile(
    rf"(?P<network>{'|'.join(NETWORKS)})-(?P<variant>om|o)-(?P<framing>def|win|mul)(?P<grid>-relative)?"
    r"(?P<weights>-finetuned|@.+)?"
)
_RIFTCAST = re.compile(r"riftcast(?P<published>-published)?(?P<weights>-finetuned|@.+)?")


def make_baseline(name: str, device: torch.device | str = "cpu") -> Inpainter:
    """The inpainter of this name, never with random weights.

    Raises:
        MissingWeightsError: its weights were not found.
        ValueError: no such name; or the weights are damaged or another network's (`WeightsError`).
    """
    if found := _NAME.fullmatch(name):
        network = load_baseline(found["network"], found["weights"] or "", device)
        sampling = Sampling(grid="relative" if found["grid"] else "absolute")
        framing, memory = found["framing"], found["variant"] == "om"
        return OnlineInpainter(network, OnlineConfig(framing=framing, memory=memory, sampling=sampling))  # pyright: ignore[reportArgumentType]
    if found := _RIFTCAST.fullmatch(name):
        network = load_baseline("dstt", found["weights"] or "", device)
        assert isinstance(network, DSTT)
        return RiftCast(network, as_published=bool(found["published"]))
    raise ValueError(f"expected a name like dstt-o-def, got '{name}'; the networks are {', '.join(NETWORKS)}")


def load_baseline(network: str, weights: str = "", device: torch.device | str = "cpu") -> DSTT | FuseFormer | E2FGVI:
    """A network of `NETWORKS` with its authors' weights (""), with ours ("-finetuned"), or with a file's ("@PATH")."""
    if weights.startswith("@"):
        path = Path(weights[1:])
        path = path / TRAINED if path.is_dir() else path
    else:
        path = checked_weights(finetuned_weights(network) if weights else known_weights(network))
    return load_weights(NETWORKS[network](), path, device)


def finetuned_weights(network: str) -> KnownWeights:
    """Where the weights of a network that our training fine-tuned are looked for."""
    file = f"finetuned/{network}/{TRAINED}"
    made_by = f"viewmend train {network} --from CHECKPOINT --out PLACE/finetuned/{network}"
    return KnownWeights(f"{network}-finetuned", (file,), f"{network} as fine-tuned here", made_by, "the user's")
