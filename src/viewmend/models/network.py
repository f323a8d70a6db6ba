"""Base class of all networks, and the precision that they compute in."""

from contextlib import AbstractContextManager, nullcontext
from functools import lru_cache

import torch
from torch import nn

from viewmend.models.base import Inpainter
from viewmend.models.compositing import Background
from viewmend.utils.timing import ms_since, now_s

MIN_SPEEDUP = 1.5
"""bfloat16 is used where it is at least this many times faster. A smaller difference may be noise, so that images would
differ from run to run."""
ROUNDS = 8


class Network(nn.Module, Inpainter):
    """An inpainter that is a torch module. Layers compute in `compute_dtype`; coordinates always stay float32."""

    compute_dtype: torch.dtype = torch.float32
    trained_in_bfloat16 = False
    """Whether the model was trained in bfloat16, and so is as good in it as in float32."""
    background: Background | None = "black"

    def autocast(self) -> AbstractContextManager[object]:
        """A context in which layers compute in `compute_dtype`; no autocast while `torch.export` traces."""
        if torch.compiler.is_exporting():
            return nullcontext()
        device = next(self.parameters()).device
        return torch.autocast(device.type, self.compute_dtype, enabled=self.compute_dtype != torch.float32)


def set_compute_dtype(model: nn.Module, dtype: torch.dtype) -> None:
    """Set the precision of every network within `model`: float32, or bfloat16 by autocast."""
    for module in model.modules():
        if isinstance(module, Network):
            module.compute_dtype = dtype


def auto_dtype(model: nn.Module) -> torch.dtype:
    """bfloat16 for a model trained in it, if it is clearly faster on the model's device; else float32."""
    if not (isinstance(model, Network) and model.trained_in_bfloat16):
        return torch.float32
    return faster_dtype(next(model.parameters()).device)


def faster_dtype(device: torch.device) -> torch.dtype:
    """bfloat16 if it is clearly faster on the device, else float32; on a GPU, bfloat16 if it has units for it."""
    if device.type == "cuda":  # the convolution that is measured is too small to be limited by computing there
        return torch.bfloat16 if torch.cuda.is_bf16_supported(including_emulation=False) else torch.float32
    return torch.bfloat16 if bfloat16_speedup(device) > MIN_SPEEDUP else torch.float32


@lru_cache
def bfloat16_speedup(device: torch.device) -> float:
    """How many times faster a convolution of a view's size is in bfloat16 than in float32; measured once, 0.1 s.

    About 5 to 7 on CPUs with matrix units, and as low as 0.1 on those without. The two alternate, and the fastest run
    of each counts, which makes the result less dependent on other load.
    """
    layer = nn.Conv2d(48, 48, 3, padding=1, device=device)
    image = torch.zeros(1, 48, 128, 128, device=device).contiguous(memory_format=torch.channels_last)

    def took_ms(dtype: torch.dtype) -> float:
        start = now_s(device)
        with torch.no_grad(), torch.autocast(device.type, dtype, enabled=dtype != torch.float32):
            layer(image)
        return ms_since(start, device)

    rounds = [(took_ms(torch.float32), took_ms(torch.bfloat16)) for _ in range(1 + ROUNDS)]
    return min(float32 for float32, _ in rounds[1:]) / min(bfloat16 for _, bfloat16 in rounds[1:])
