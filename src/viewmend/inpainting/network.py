"""What our networks have in common."""

from contextlib import AbstractContextManager, nullcontext
from functools import lru_cache

import torch
from torch import nn

from viewmend.backgrounds import Background
from viewmend.inpainting.config import InpainterConfig
from viewmend.inpainting.protocol import State
from viewmend.timing import ms_since, now_s

CLEARLY = 1.5
"""bfloat16 is taken where it is so many times faster: less may be noise, and then pictures would differ by chance."""

ROUNDS = 8


class Network(nn.Module):
    """A network with a config, which computes in a precision of its own; coordinates always stay float32."""

    config: InpainterConfig
    compute_dtype: torch.dtype = torch.float32
    trained_in_bfloat16 = False
    """Whether bfloat16 is as good as float32 for it."""

    @property
    def background(self) -> Background | None:
        """What it was trained to paint upon: black or white; None for whatever it is shown."""
        return "black"

    def initial_state(self) -> State:
        """The state before the first view of a stream."""
        return State()

    def autocast(self) -> AbstractContextManager[object]:
        """The context in which the layers compute in `compute_dtype`; none in what `torch.export` traces."""
        if torch.compiler.is_exporting():
            return nullcontext()
        device = next(self.parameters()).device
        return torch.autocast(device.type, self.compute_dtype, enabled=self.compute_dtype != torch.float32)


def set_compute_dtype(model: nn.Module, dtype: torch.dtype) -> None:
    """Let every network within `model` compute in this type: float32, or bfloat16 by autocast."""
    for module in model.modules():
        if isinstance(module, Network):
            module.compute_dtype = dtype


def auto_dtype(model: nn.Module) -> torch.dtype:
    """bfloat16 for a model that was trained in it, where it is clearly faster on the model's device; else float32."""
    if not getattr(model, "trained_in_bfloat16", False):
        return torch.float32
    return torch.bfloat16 if bfloat16_speedup(next(model.parameters()).device) > CLEARLY else torch.float32


@lru_cache
def bfloat16_speedup(device: torch.device) -> float:
    """How many times faster a convolution of a view's size is in bfloat16 than in float32; measured once, 0.1 s.

    It is 5 to 7 on CPUs with matrix units for it, and may be a quarter on those without. Both are tried by turns, and
    the best of each counts, so that a busy machine does not decide.
    """
    layer = nn.Conv2d(48, 48, 3, padding=1, device=device)
    image = torch.zeros(1, 48, 128, 128, device=device).contiguous(memory_format=torch.channels_last)

    def took_ms(dtype: torch.dtype) -> float:
        start = now_s(device)
        with torch.no_grad(), torch.autocast(device.type, dtype, enabled=dtype != torch.float32):
            layer(image)
        return ms_since(start, device)

    float32, bfloat16 = zip(
        *((took_ms(torch.float32), took_ms(torch.bfloat16)) for _ in range(1 + ROUNDS)), strict=True
    )
    return min(float32[1:]) / min(bfloat16[1:])
