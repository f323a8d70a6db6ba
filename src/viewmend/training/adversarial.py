"""The adversarial term of section 8, L_adv = E log D(F*) + E log(1 - D(Fhat)), on Fhat, after the blend.

D is the sigmoid of a discriminator's logits. It maximises L_adv, the inpainter minimises it; here each gets a number
that it minimises. The mean is over the logits of an image, then over the images of the batch. A view in which nothing
is missing counts 0, as in L_in, and teaches neither of the two anything.
"""

from collections.abc import Sequence
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torch.func import functional_call
from torch.nn.functional import softplus

from viewmend.training.discriminator import Discriminator

Objective = Literal["gan", "hinge"]
"""The paper's, and the hinge (Miyato et al. 2018), with which the baselines were trained."""


def discriminator_loss(
    real_logits: Sequence[Float[Tensor, "..."]],
    fake_logits: Sequence[Float[Tensor, "..."]],
    objective: Objective = "gan",
    counted: Float[Tensor, "image"] | None = None,
) -> Float[Tensor, ""]:
    """What the discriminator minimises: -E log D(F*) - E log(1 - D(Fhat)), or the hinge's two halves.

    counted: a weight for each image; None counts each as 1.
    """
    pairs = [(real.float(), fake.float()) for real, fake in zip(real_logits, fake_logits, strict=True)]
    if objective == "hinge":
        parts = [(1 - real).relu().mean() + (1 + fake).relu().mean() for real, fake in pairs]
    else:
        # log sigmoid(x) = -softplus(-x) and log(1 - sigmoid(x)) = -softplus(x), finite for any logit.
        parts = [softplus(-real).mean() + softplus(fake).mean() for real, fake in pairs]
    return _mean(parts, counted)


def generator_loss(
    fake_logits: Sequence[Float[Tensor, "..."]],
    objective: Objective = "gan",
    counted: Float[Tensor, "image"] | None = None,
) -> Float[Tensor, ""]:
    """What the inpainter minimises: E log(1 - D(Fhat)), or the hinge's -E of the logits.

    counted: a weight for each image; None counts each as 1.
    """
    if objective == "hinge":
        parts = [-f.float().mean() for f in fake_logits]
    else:
        parts = [-softplus(f.float()).mean() for f in fake_logits]
    return _mean(parts, counted)


def discriminator_objective(
    discriminator: Discriminator,
    truth: Sequence[Float[Tensor, "3 ..."]],
    completed: Sequence[Float[Tensor, "3 ..."]],
    error: Sequence[Float[Tensor, "..."]],
    objective: Objective = "gan",
) -> Float[Tensor, ""]:
    """`discriminator_loss` of a batch of F* and Fhat, images or clips; nothing of it reaches the inpainter.

    error: E of each image (height width) or clip (time height width).
    """
    judged = discriminator([*truth, *(image.detach() for image in completed)])
    return discriminator_loss(judged[: len(truth)], judged[len(truth) :], objective, _missing(error))


def inpainter_objective(
    discriminator: Discriminator,
    completed: Sequence[Float[Tensor, "3 ..."]],
    error: Sequence[Float[Tensor, "..."]],
    objective: Objective = "gan",
) -> Float[Tensor, ""]:
    """`generator_loss` of a batch of Fhat, images or clips; the discriminator's weights get no gradient from it.

    error: E of each image (height width) or clip (time height width).
    """
    fixed = {name: weight.detach() for name, weight in discriminator.named_parameters()}
    judged = functional_call(discriminator, fixed, (completed,))
    return generator_loss(judged, objective, _missing(error))


def _missing(error: Sequence[Tensor]) -> Float[Tensor, "image"]:
    """1 for each image in which anything is missing, else 0. A weight, not a choice: no wait for the device."""
    return torch.stack([(E > 0).any() for E in error]).float()


def _mean(parts: Sequence[Tensor], counted: Tensor | None) -> Float[Tensor, ""]:
    """Mean over the whole batch, also over images that count nothing: so halves of a batch average to the batch."""
    losses = torch.stack(list(parts))
    return (losses if counted is None else losses * counted).mean()
