"""E: which pixels of a rendered view must be inpainted. A rule is a function with a name."""

from collections.abc import Callable
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from viewmend.rendering.blending import Blend
from viewmend.views import RIM_PX

MIN_WEIGHT = 1e-5
"""Sum of raw weights below which a pixel has no colour (RIFTCast)."""


@dataclass(frozen=True)
class Evidence:
    """All that a rule may look at.

    Examples:
        >>> import torch
        >>> from viewmend import Evidence, error_rule
        >>> from viewmend.rendering.error_rules import Blend
        >>> blend = Blend(torch.zeros(3, 1, 2), torch.tensor([[[0.0, 0.7]]]), torch.zeros(1, 2))
        >>> error_rule("unseen")(Evidence(mask=torch.ones(1, 2), depth=torch.ones(1, 2), blend=blend))
        tensor([[1., 0.]])
    """

    mask: Float[Tensor, "height width"]
    """M: 1 where the geometry proxy covers the pixel."""
    depth: Float[Tensor, "height width"]
    """z-depth of the proxy, metres; 0 where there is none."""
    blend: Blend


ErrorRule = Callable[[Evidence], Float[Tensor, "height width"]]
"""From the evidence to E, in [0, 1]: 1 on the pixels of the proxy where the blend has no colour."""


def unseen(evidence: Evidence) -> Float[Tensor, "height width"]:
    """1 on the pixels of the proxy that no source view colours: the paper's E, by RIFTCast's threshold."""
    return (evidence.blend.weights.sum(0) < MIN_WEIGHT).to(evidence.mask) * evidence.mask


def all_covered(evidence: Evidence) -> Float[Tensor, "height width"]:
    """1 on the proxy and on a rim about it: for inpainters that keep what is right by themselves. Ours."""
    return F.max_pool2d(evidence.mask[None], 2 * RIM_PX + 1, 1, RIM_PX)[0]


ERROR_RULES: dict[str, ErrorRule] = {"unseen": unseen, "all": all_covered, "wrong": all_covered}
"""The rules by name. A new rule is a function, and a line here. `wrong` begins as `all`; `Stream`, which knows all
cameras and a model's `error_map`, leaves of it where most is to be gained."""


def error_rule(name: str) -> ErrorRule:
    """The rule of this name, of `ERROR_RULES`.

    Raises:
        ValueError: there is none.

    Examples:
        >>> from viewmend import error_rule
        >>> error_rule("unseen").__name__
        'unseen'
    """
    if name not in ERROR_RULES:
        raise ValueError(
            f"expected an error rule among {sorted(ERROR_RULES)}, got '{name}'; choose one of them, or name a method "
            "that brings its own"
        )
    return ERROR_RULES[name]
