"""Base class of all networks, and the precision that they compute in."""

import hashlib
from contextlib import AbstractContextManager, nullcontext

import torch
from torch import nn

from viewmend.models.base import Inpainter
from viewmend.models.compositing import Background

BFLOAT16_UNITS = ("amx_bf16", "avx512_bf16")
"""Features of x86 processors with which layers are faster in bfloat16 than in float32: 5 to 7 times
with matrix units (AMX), 1.7 to 1.9 times with vectors of 512 bits. Without either, bfloat16 is up
to ten times slower."""


class Network(nn.Module, Inpainter):
    """An inpainter that is a torch module. Layers compute in `compute_dtype`; coordinates always stay float32."""

    compute_dtype: torch.dtype = torch.float32
    trained_in_bfloat16 = False
    """Whether the model was trained in bfloat16, and so is as good in it as in float32."""
    background: Background | None = "black"

    _encoding_kind: tuple[int, str] = (-1, "")
    """How often the weights had been changed when `encoding_kind` was last computed, and its value."""

    @property
    def encoding_kind(self) -> str:
        """A name for this model's encodings in a frame's memory: a digest of its weights, the same in all processes.

        Models of different weights may share a memory, and so must not find each other's encodings there.
        """
        weights = list(self.parameters())
        version = sum(weight._version for weight in weights if not weight.is_inference())
        if self._encoding_kind[0] != version:
            digest = hashlib.sha256(str([tuple(weight.shape) for weight in weights]).encode())
            digest.update(torch.cat([weight.detach().flatten() for weight in weights]).cpu().numpy().data)
            self._encoding_kind = (version, digest.hexdigest()[:16])
        return self._encoding_kind[1]

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
    """bfloat16 for a model trained in it, if it is faster on the model's device; else float32."""
    if not (isinstance(model, Network) and model.trained_in_bfloat16):
        return torch.float32
    return faster_dtype(next(model.parameters()).device)


def faster_dtype(device: torch.device) -> torch.dtype:
    """bfloat16 if the device has units for it, else float32.

    Nothing is timed, so that a machine always chooses the same format, whatever else it is doing.
    """
    if device.type == "cuda":
        has_units = torch.cuda.is_bf16_supported(including_emulation=False)
    else:
        features = torch.cpu.get_capabilities()
        has_units = any(features.get(unit, False) for unit in BFLOAT16_UNITS)
    return torch.bfloat16 if has_units else torch.float32
