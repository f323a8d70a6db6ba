"""The adversarial loss of section 8, with its patch discriminators.

L_adv = E log D(F*) + E log(1 - D(Fhat)), on Fhat, after the blend. D maximises it and the inpainter
minimises it; the functions here return what each of the two minimises. The mean is over the logits
of an image, then over the images of the batch. A view without a hole contributes 0, as in L_in, and
trains neither network.

The paper does not state the discriminator. Here it is T-PatchGAN (Chang et al. 2019) for clips, and
the same network without the time axis for images: strided convolutions with spectral normalisation
(Miyato et al. 2018).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.func import functional_call
from torch.nn.functional import softplus
from torch.nn.utils import parametrize
from torch.nn.utils.parametrizations import spectral_norm

SLOPE = 0.2
"""Negative slope of the LeakyReLU between the convolutions."""
MIN_SIZE_PX = 3
"""Smallest image side: the first convolution of a clip is padded by only 1."""
BETAS = (0.0, 0.99)
"""Adam's betas for the discriminator, as in the training of the baselines."""


class Discriminator(nn.Module):
    """Convolutions from images in [0, 1] to a map of logits, without any layer that mixes images of a batch."""

    def __init__(self, kind: Literal["image", "clip"] = "image", width: int = 32, layers: int = 4) -> None:
        """Make a discriminator.

        Args:
            kind: single images, with 5 x 5 kernels; or clips of consecutive frames, with
                T-PatchGAN's 3 x 5 x 5.
            width: channels after the first convolution; doubled twice by later ones.
            layers: convolutions, each halving height and width; the receptive field of a logit is
                61 pixels with 4, 253 with 6.
        """
        super().__init__()
        C = (3, *(width * 2 ** min(layer, 2) for layer in range(layers)))
        last = layers - 1
        if kind == "image":
            convolutions = [nn.Conv2d(C[i], C[i + 1], 5, 2, 2, bias=i == last) for i in range(layers)]
        else:
            # The first is padded by 1 in every dimension, as in the published network.
            padding = [(1, 1, 1), *[(1, 2, 2)] * last]
            convolutions = [
                nn.Conv3d(C[i], C[i + 1], (3, 5, 5), (1, 2, 2), padding[i], bias=i == last)
                for i in range(layers)
            ]
        self.convolutions = nn.ModuleList(
            [*(spectral_norm(layer) for layer in convolutions[:-1]), convolutions[-1]]
        )

    def forward(self, images: Sequence[Float[Tensor, "3 ... _h _w"]]) -> list[Float[Tensor, "logit ..."]]:
        """Logits of images, or of clips of any length, with values in [0, 1]; ValueError below 3 x 3 pixels.

        Images of one size are processed as one batch. In training mode each call makes one step of
        power iteration, so pass real and completed images in the same call.
        """
        small = [tuple(image.shape) for image in images if min(image.shape[-2:]) < MIN_SIZE_PX]
        if small:
            raise ValueError(
                f"expected images of at least {MIN_SIZE_PX} x {MIN_SIZE_PX} pixels, got shapes {small}; leave them out"
            )
        maps: list[Tensor] = [images[0]] * len(images)
        # Weights are normalised once per call, and outside autocast: power iteration needs float32.
        with parametrize.cached():
            with torch.autocast(images[0].device.type, enabled=False):
                [layer.weight for layer in self.convolutions]
            for shape in dict.fromkeys(image.shape for image in images):
                indices = [index for index, image in enumerate(images) if image.shape == shape]
                x = 2 * torch.stack([images[index] for index in indices]) - 1
                for number, layer in enumerate(self.convolutions):
                    x = layer(x if number == 0 else nn.functional.leaky_relu(x, SLOPE))
                for index, own in zip(indices, x, strict=True):
                    maps[index] = own
        return maps


@dataclass(frozen=True)
class AdversarialLoss:
    """The terms that the two networks minimise, as functions of logits."""

    real: Callable[[Tensor], Tensor]
    """The discriminator's term for F*."""
    fake: Callable[[Tensor], Tensor]
    """The discriminator's term for Fhat."""
    generator: Callable[[Tensor], Tensor]
    """The inpainter's term for Fhat."""


# log sigmoid(x) = -softplus(-x) and log(1 - sigmoid(x)) = -softplus(x), finite for any logit.
GAN = AdversarialLoss(lambda x: softplus(-x), softplus, lambda x: -softplus(x))
"""The paper's loss."""
HINGE = AdversarialLoss(lambda x: (1 - x).relu(), lambda x: (1 + x).relu(), torch.neg)
"""The hinge loss (Miyato et al. 2018), with which the baselines were trained."""


@dataclass(frozen=True)
class Judged:
    """A batch as the discriminator receives it: images (3 height width), or clips (3 time height width)."""

    truth: Sequence[Float[Tensor, "3 ..."]]
    """F*."""
    completed: Sequence[Float[Tensor, "3 ..."]]
    """Fhat."""
    error: Sequence[Float[Tensor, "..."]]
    """E, without the channel axis."""


def discriminator_objective(
    net: Discriminator, batch: Judged, loss: AdversarialLoss = GAN
) -> Float[Tensor, ""]:
    """The discriminator's loss; no gradient reaches the inpainter."""
    logits = [own.float() for own in net([*batch.truth, *(image.detach() for image in batch.completed)])]
    pairs = zip(logits[: len(batch.truth)], logits[len(batch.truth) :], strict=True)
    return _mean([loss.real(real).mean() + loss.fake(fake).mean() for real, fake in pairs], batch)


def inpainter_objective(net: Discriminator, batch: Judged, loss: AdversarialLoss = GAN) -> Float[Tensor, ""]:
    """The inpainter's loss; the discriminator's weights get no gradient from it."""
    fixed = {name: weight.detach() for name, weight in net.named_parameters()}
    logits = functional_call(net, fixed, (list(batch.completed),))
    return _mean([loss.generator(own.float()).mean() for own in logits], batch)


def _mean(losses: list[Tensor], batch: Judged) -> Float[Tensor, ""]:
    """Mean over all images, where those without a hole count as 0, so halves of a batch average to the whole."""
    # A weight for each image, since a choice of images would have to wait for the device.
    return (torch.stack(losses) * torch.stack([(E > 0).any() for E in batch.error]).float()).mean()


class Adversary:
    """A discriminator with its loss and optimiser, trained alongside the model."""

    def __init__(
        self, net: Discriminator, loss: AdversarialLoss, weight: float, learning_rate: float
    ) -> None:
        """`weight` is lambda_adv, the weight of the loss in the model's total."""
        self.discriminator = net
        self.loss = loss
        self.weight = weight
        self.optimizer = torch.optim.Adam(self.discriminator.parameters(), lr=learning_rate, betas=BETAS)

    def losses(self, batch: Judged, share: float) -> tuple[Float[Tensor, ""], float]:
        """L_adv for the inpainter, and the value of the discriminator's own loss.

        The gradients of the latter, times `share`, are accumulated in the discriminator.
        """
        own_loss = discriminator_objective(self.discriminator, batch, self.loss)
        (own_loss * share).backward()
        return inpainter_objective(self.discriminator, batch, self.loss), float(own_loss.detach())

    def step(self, mean: Callable[[Tensor], Tensor]) -> None:
        """Update the discriminator by its accumulated gradients, averaged over all processes by `mean`."""
        for parameter in self.discriminator.parameters():
            if parameter.grad is not None:
                parameter.grad = mean(parameter.grad)
        self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)
