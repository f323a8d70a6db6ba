"""The discriminator's side of a run: it is judged on the same batches, and has its own optimizer (section 8)."""

import torch
from jaxtyping import Float
from torch import Tensor

from viewmend.backgrounds import Background
from viewmend.training.adversarial import Objective, discriminator_objective, inpainter_objective
from viewmend.training.discriminator import Discriminator, DiscriminatorConfig
from viewmend.training.plan import LossWeights
from viewmend.training.processes import Processes
from viewmend.training.samples import Sample
from viewmend.training.true_images import true_image

BETAS = (0.0, 0.99)
"""Adam's betas, as in the baselines' training."""


class Adversary:
    """D with its optimizer."""

    def __init__(
        self, loss: LossWeights, learning_rate: float, own: Processes, background: Background = "black"
    ) -> None:
        """`background` is what the inpainter paints upon, where D is shown the truth, too."""
        self.background: Background = background
        self.kind: Objective = loss.adversarial_kind
        self.of_clips = loss.discriminator == "clip"
        layers = 6 if self.of_clips else 4
        self.discriminator = Discriminator(DiscriminatorConfig(kind=loss.discriminator, layers=layers))
        self.discriminator.to(own.device)
        self.optimizer = torch.optim.Adam(self.discriminator.parameters(), lr=learning_rate, betas=BETAS)
        self._own = own

    def judge(
        self, batch: list[Sample], completed: tuple[Tensor, ...], weight: float
    ) -> tuple[Float[Tensor, ""], float]:
        """L_adv for the inpainter, and what D's own loss was; D's gradients of it, times `weight`, add up.

        completed: Fhat of every view of the batch, clip by clip.
        """
        return self.judge_images(*self._images(batch, completed), weight)

    def judge_images(
        self, truth: list[Tensor], made: list[Tensor], error: list[Tensor], weight: float
    ) -> tuple[Float[Tensor, ""], float]:
        """The same of F*, Fhat and E as the discriminator takes them."""
        own_loss = discriminator_objective(self.discriminator, truth, made, error, self.kind)
        (own_loss * weight).backward()
        return inpainter_objective(self.discriminator, made, error, self.kind), float(own_loss.detach())

    def step(self) -> None:
        """D learns from the gradients that all processes gathered."""
        for parameter in self.discriminator.parameters():
            if parameter.grad is not None:
                parameter.grad = self._own.mean(parameter.grad)
        self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)

    def _images(
        self, batch: list[Sample], completed: tuple[Tensor, ...]
    ) -> tuple[list[Tensor], list[Tensor], list[Tensor]]:
        """F*, Fhat and E as the discriminator takes them: of single views, or of clips."""
        made = iter(completed)
        rows = [
            [(true_image(s, self.background), next(made).float(), s.view.error) for s in last.clip] for last in batch
        ]
        if not self.of_clips:
            singles = [image for row in rows for image in row]
            return [t for t, _, _ in singles], [m for _, m, _ in singles], [e for _, _, e in singles]
        truth = [torch.stack([t for t, _, _ in row], 1) for row in rows]
        made = [torch.stack([m for _, m, _ in row], 1) for row in rows]
        return truth, made, [torch.stack([e for _, _, e in row]) for row in rows]
