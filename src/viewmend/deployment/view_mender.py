"""A reader of whole views as one module from tensors to tensors, which `torch.export` can trace."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from viewmend.deployment.any_size_fill import fill_any_size
from viewmend.deployment.hole_reading import read_holes
from viewmend.deployment.packed_rig import PackedRig
from viewmend.deployment.view_inputs import ViewInputs, ViewOutputs
from viewmend.inpainting.ray_blend_net import RayBlendNet
from viewmend.inpainting.sweep.cells import rim_depth, scattered
from viewmend.inpainting.sweep.lookup import Scale
from viewmend.inpainting.sweep.sweep_net import SweepNet


class ViewMender(nn.Module):
    """`SweepNet.step` for one view: the same layers, with lookups of which no size need be known."""

    def __init__(self, net: SweepNet) -> None:
        super().__init__()
        self.net = net

    def forward(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        """`ViewOutputs` of `ViewInputs`."""
        given = ViewInputs(*tensors)
        view, scale = given.view, view_scale(given)
        read = view.read & (rim_depth(view.depth) > 0)
        guess = self._guess(given, scale)
        found = self.net.read(view, PackedRig.of(given), scale, read, guess)
        in_holes = guess if isinstance(self.net.coarse, RayBlendNet) else None
        mended = found.laid_into(view, read, torch.zeros_like(read), given.alpha_slope, in_holes)
        assert mended.confidence is not None, "which this reader tells"
        return tuple(ViewOutputs(mended.rgb, mended.opacity, mended.confidence, mended.surface_depth))

    def _guess(self, given: ViewInputs, scale: Scale) -> Float[Tensor, "3 height width"]:
        """`SweepNet.coarse_guess`."""
        view = given.view
        guess = fill_any_size(view.rgb, view.holes, view.mask > 0)
        if not isinstance(self.net.coarse, RayBlendNet):
            return guess
        holes = view.holes & (view.depth > 0).any()
        pixels = torch.nonzero(holes | _first(holes))  # never none: there are layers that want one
        rgb = read_holes(self.net.coarse, given, pixels, guess, scale)
        return torch.where(holes, scattered(rgb, pixels, holes.shape), guess)


def view_scale(given: ViewInputs) -> Scale:
    """`Scale.of` the view, as tensors."""
    covered = given.depth > 0
    count = covered.sum()
    ordered = torch.where(covered, given.depth, torch.inf).flatten().sort().values
    median = ordered[((count - 1).clamp_min(0) // 2)]
    focal = (given.K[0, 0] * given.K[1, 1]).sqrt()
    size = (given.mask > 0).sum().clamp_min(1).sqrt() * median / focal
    size, median = (torch.where(count > 0, value, 1.0) for value in (size, median))
    return Scale(size, median)


def _first(image: Bool[Tensor, "height width"]) -> Bool[Tensor, "height width"]:
    """The first pixel alone."""
    return torch.arange(image.numel()).view(image.shape) == 0
