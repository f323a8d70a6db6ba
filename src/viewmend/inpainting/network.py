"""What our networks have in common."""

import torch
from torch import nn

from viewmend.inpainting.config import InpainterConfig
from viewmend.inpainting.protocol import State


class Network(nn.Module):
    """A network with a config, which computes in a precision of its own; coordinates always stay float32."""

    config: InpainterConfig
    compute_dtype: torch.dtype = torch.float32

    def initial_state(self) -> State:
        """The state before the first view of a stream."""
        return State()

    def autocast(self) -> torch.autocast:
        """The context in which the layers compute in `compute_dtype`."""
        device = next(self.parameters()).device
        return torch.autocast(device.type, self.compute_dtype, enabled=self.compute_dtype != torch.float32)


def set_compute_dtype(model: nn.Module, dtype: torch.dtype) -> None:
    """Let every network within `model` compute in this type: float32, or bfloat16 by autocast."""
    for module in model.modules():
        if isinstance(module, Network):
            module.compute_dtype = dtype
