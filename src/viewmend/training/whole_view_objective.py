"""What the reader of whole views is taught: colours, and what the studio knows exactly besides. Ours.

Colours are three labels a pixel. Which place along the ray is the surface, which cameras see it, and how much of the
pixel the subject covers are a hundred, and say why a colour is right.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional as F

from viewmend.geometry.cameras import project, unproject
from viewmend.geometry.sampling import in_view
from viewmend.inpainting.sweep.cells import CELL_PX, nearest_depth, scattered
from viewmend.inpainting.sweep.config import OFFSETS
from viewmend.inpainting.sweep.reading import Reading
from viewmend.inpainting.sweep.sweep_net import SweepNet
from viewmend.training.losses import LEAST_SQUARE, ImageLoss
from viewmend.training.objective import StepOutput
from viewmend.training.plan import ViewLossWeights
from viewmend.training.whole_views import WholeView, random_part, random_window

SEEN = 0.02
"""A camera sees a point if its true depth there is no farther off, in subject sizes."""
SURE = 0.1
"""A pixel is right where no channel is farther off."""
GAIN = 4.0
"""Gains are small numbers: their cross-entropy counts so many times."""


class WholeViewObjective(nn.Module):
    """All terms of a batch, of a random window of each view."""

    def __init__(self, model: SweepNet, weights: ViewLossWeights) -> None:
        super().__init__()
        self.model = model
        self.weights = weights

    def forward(self, batch: Sequence[WholeView]) -> StepOutput:
        """The means over the batch."""
        terms = [self._terms(random_window(whole)) for whole in batch]
        image = ImageLoss(*(torch.stack(values).mean() for values in zip(*(own[1:] for own in terms), strict=True)))
        return StepOutput(image, torch.stack([own[0] for own in terms]).mean(), ())

    def _terms(self, window: WholeView) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The weighted sum, L1 in the holes and elsewhere, and the logarithmic error."""
        reading = self.model(window.view, window.rig, window.scale, random_part(window), window.guess)
        at, weights = tuple(reading.pixels.T), self.weights
        truth, alpha = window.truth / 255, window.alpha[at] / 255
        off = reading.rgb - truth[:, at[0], at[1]].T
        hole = window.view.holes[at].float()
        weight = 1 + weights.holes * hole
        colour = (weight * off.abs().mean(1)).sum() / weight.sum()
        log_error = (off.square().mean() + LEAST_SQUARE).log10()
        right = (off.detach().abs().amax(1) < SURE).float()
        total = weights.colour * colour + weights.log_error * log_error
        total = total + weights.gradient * _gradient_loss(reading, off, window.view.mask.shape)
        total = total + weights.alpha * ((reading.alpha - alpha).abs().mean() + 0.3 * _entropy(reading.alpha, alpha))
        total = total + weights.confidence * _entropy(reading.confidence, right)
        total = total + self._cell_terms(window, reading)
        total = total + weights.errors * self._error_terms(window, reading, off)
        inside = (hole * off.detach().abs().mean(1)).sum() / hole.sum().clamp_min(1)
        return total, inside, colour.detach(), log_error.detach()

    def _error_terms(self, window: WholeView, reading: Reading, off: Float[Tensor, "pixel 3"]) -> Float[Tensor, ""]:
        """What the `ErrorNet` is taught, of the pixels that were read: it need not know why."""
        if self.model.errors is None:
            return off.new_zeros(())
        at = tuple(reading.pixels.T)
        found = self.model.errors(window.view, window.rig, window.scale)
        rendered, read = window.view.rgb[:, *at].T, reading.rgb.detach()
        wrong = ((rendered - (read - off.detach())).abs().amax(1) > SURE).float()
        alpha = found.alpha[at]
        gain, rest = ((k * rendered - read).square().mean(1) for k in (1.0, alpha.detach()[:, None]))
        gains = _entropy(found.gain[at], gain) + _entropy(found.rest[at], rest)
        return _entropy(found.wrong[at], wrong) + _entropy(alpha, reading.alpha.detach()) + GAIN * gains

    def _cell_terms(self, window: WholeView, reading: Reading) -> Float[Tensor, ""]:
        """What cells are taught: mean colour, the surface's place, and who sees it."""
        swept, weights = reading.swept, self.weights
        cells = tuple(swept.cells.T)
        shares = swept.logits.softmax(1)[..., None]
        truth = F.avg_pool2d(window.truth[None] / 255, CELL_PX, ceil_mode=True)[0, :, cells[0], cells[1]].T
        colour = ((shares * swept.weighed.colour).sum(1) - truth).abs().mean()
        alpha = F.avg_pool2d(window.alpha[None] / 255, CELL_PX, ceil_mode=True)[0][cells]
        z = nearest_depth(window.depth)[cells]
        offsets = z.new_tensor(OFFSETS)
        offset = (z - swept.depth[cells]) / window.scale.size_m
        known = (z > 0) & (alpha > 0.5) & (offset > offsets[0] - SEEN) & (offset < offsets[-1] + 0.1)
        above = torch.searchsorted(offsets, offset.contiguous()).clamp(1, len(OFFSETS) - 1)
        upper = ((offset - offsets[above - 1]) / (offsets[above] - offsets[above - 1])).clamp(0, 1)
        chance = swept.logits.log_softmax(1)
        place = -_mean(
            (1 - upper) * chance.gather(1, above[:, None] - 1)[:, 0] + upper * chance.gather(1, above[:, None])[:, 0],
            known,
        )
        seen = _visible(window, reading, z)
        nearest = above - (upper < 0.5).long()
        trust = swept.weighed.trust[torch.arange(len(nearest)), nearest]
        visible = -_mean(((trust * seen).sum(1) + 1e-3).log(), known & seen.any(1))
        return weights.cell_colour * colour + weights.place * place + weights.visible * visible


def _gradient_loss(reading: Reading, off: Float[Tensor, "pixel 3"], shape: torch.Size) -> Float[Tensor, ""]:
    """Mean difference of the errors of neighbours that were both read."""
    image = scattered(F.pad(off, (0, 1), value=1.0), reading.pixels, shape)
    total, count = image.new_zeros(()), image.new_zeros(())
    for axis in (1, 2):
        one, other = image.narrow(axis, 1, image.shape[axis] - 1), image.narrow(axis, 0, image.shape[axis] - 1)
        both = one[3] * other[3]
        total, count = total + (both * (one[:3] - other[:3]).abs().mean(0)).sum(), count + both.sum()
    return total / count.clamp_min(1)


def _visible(window: WholeView, reading: Reading, z: Float[Tensor, "cell"]) -> Bool[Tensor, "cell view"]:
    """Which cameras see the true surface of each cell."""
    middles = CELL_PX * (reading.swept.cells.flip(1).float() + 0.5)
    points = unproject(middles[None], z[None], window.view.camera)[0]
    frame = window.rig.views.frame
    assert frame.depth is not None, "a stored scene's"
    at, depth = project(points, frame.cameras)
    column, row = at.long().clamp_min(0).unbind(-1)
    height, width = frame.depth.shape[1:]
    there = frame.depth.flatten(1).gather(1, row.clamp_max(height - 1) * width + column.clamp_max(width - 1))
    near = (depth - there).abs() < SEEN * window.scale.size_m
    return (in_view(at, depth, frame.cameras) & (there > 0) & near).T


def _entropy(chance: Float[Tensor, "pixel"], truth: Float[Tensor, "pixel"]) -> Float[Tensor, ""]:
    return F.binary_cross_entropy(chance.clamp(1e-4, 1 - 1e-4), truth.clamp(0, 1))


def _mean(values: Float[Tensor, "cell"], where: Bool[Tensor, "cell"]) -> Float[Tensor, ""]:
    """0 where there are none."""
    return (values * where).sum() / where.sum().clamp_min(1)
