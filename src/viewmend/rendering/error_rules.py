"""E: which pixels of a rendered view must be inpainted. A rule is a function with a name."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from viewmend.python_files import from_file
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
"""From the evidence to E, floats in [0, 1]: 1 on the pixels of the proxy where the blend has no colour."""


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
    """The rule of this name: of `ERROR_RULES`, or FILE.py:NAME, a function in a file of one's own.

    Raises:
        ValueError: there is none.

    Examples:
        >>> from viewmend import error_rule
        >>> error_rule("unseen").__name__
        'unseen'
    """
    if ".py:" in name:
        return cast(ErrorRule, from_file(name))
    if name not in ERROR_RULES:
        raise ValueError(
            f"expected an error rule among {sorted(ERROR_RULES)}, got '{name}'; choose one of them, or name a function "
            "in a file of your own, FILE.py:NAME"
        )
    return ERROR_RULES[name]


def error_map(name: str, evidence: Evidence) -> Float[Tensor, "height width"]:
    """E by the rule of this name; what a rule that is not shipped gives is looked at.

    Raises:
        ValueError: the rule does not give E.
    """
    rule = error_rule(name)
    E = rule(evidence)
    if rule not in (unseen, all_covered) and (wrong := _what_is_wrong(E, evidence)):
        raise ValueError(
            f"error rule '{name}': expected E as floats of shape {tuple(evidence.mask.shape)} in [0, 1], 1 wherever "
            f"`unseen` is, got {wrong}; begin with torch.maximum(unseen(evidence), ...)"
        )
    return E


def _what_is_wrong(E: object, evidence: Evidence) -> str | None:
    if not isinstance(E, Tensor):
        return type(E).__name__
    if E.shape != evidence.mask.shape or not E.is_floating_point():
        return f"{E.dtype} of shape {tuple(E.shape)}"
    if not bool(((E >= 0) & (E <= 1)).all()):
        return f"values from {float(E.min()):.3g} to {float(E.max()):.3g}"
    left = int((unseen(evidence) > E).sum())
    return f"less on {left} pixels that no source view colours" if left else None
