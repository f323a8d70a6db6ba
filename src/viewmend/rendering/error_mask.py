"""The error mask E of a view: which of its pixels must be inpainted.

`decide_error_mask` is called once per view, between rendering and inpainting. An error rule marks
pixels from what the renderer knows; then, if only a fraction of them may be re-synthesised, a model
predicts where that gains most.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from inspect import signature
from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from viewmend.geometry.rim import RIM_PX
from viewmend.models.base import ContextProvider, ErrorMap, Inpainter
from viewmend.rendering.blending import Blend
from viewmend.types import IncompleteView
from viewmend.utils.plugins import load_from_file

ErrorRule = Callable[["Evidence"], Float[Tensor, "height width"]]
"""Computes E from the evidence, floats in [0, 1]: 1 on all pixels of the proxy where the
blend has no colour."""
ERROR_RULES = ("holes", "all", "predicted")
"""The names of the rules that `error_rule` knows."""
MIN_WEIGHT = 1e-5
"""A pixel has no colour if the sum of its raw weights is below this (RIFTCast)."""
MIN_GAIN = 0.01**2
"""A pixel is never selected if its predicted gain, the squared change of its colour, is below this."""
MIN_FADE = 0.02
"""A pixel is not attenuated if its predicted background fraction is below this."""


@dataclass(frozen=True)
class Evidence:
    """What an error rule decides from.

    Examples:
        >>> import torch
        >>> from viewmend import Evidence, error_rule
        >>> from viewmend.rendering.blending import Blend
        >>> blend = Blend(torch.zeros(3, 1, 2), torch.tensor([[[0.0, 0.7]]]), torch.zeros(1, 2))
        >>> error_rule("holes")(Evidence(mask=torch.ones(1, 2), depth=torch.ones(1, 2), blend=blend))
        tensor([[1., 0.]])
    """

    mask: Float[Tensor, "height width"]
    """M: 1 where the geometry proxy covers the pixel."""
    depth: Float[Tensor, "height width"]
    """z-depth of the proxy, metres; 0 where there is none."""
    blend: Blend


def holes(evidence: Evidence) -> Float[Tensor, "height width"]:
    """1 on the pixels of the proxy that no source view colours: the paper's E, with RIFTCast's threshold."""
    return evidence.mask * (evidence.blend.total_weight < MIN_WEIGHT)


def all_covered(evidence: Evidence) -> Float[Tensor, "height width"]:
    """1 on the proxy and a rim of `RIM_PX` around it, for inpainters that keep correct pixels themselves."""
    return with_rim(evidence.mask)


def with_rim(mask: Float[Tensor, "height width"]) -> Float[Tensor, "height width"]:
    """A mask that is larger by `RIM_PX` on all sides."""
    return F.max_pool2d(mask[None], 2 * RIM_PX + 1, 1, RIM_PX)[0]


def error_rule(name: str) -> ErrorRule:
    """The rule of this name: one of `ERROR_RULES`, or FILE.py:NAME, a function in a file of your own.

    `predicted` starts from all covered pixels; `decide_error_mask` keeps those with the highest
    predicted gain.

    Raises:
        ValueError: there is no such rule.

    Examples:
        >>> from viewmend import error_rule
        >>> error_rule("holes").__name__
        'holes'
    """
    if ".py:" in name:
        return cast(ErrorRule, load_from_file(name))
    rules: dict[str, ErrorRule] = {"holes": holes, "all": all_covered, "predicted": all_covered}
    if name not in rules:
        raise ValueError(
            f"expected an error rule among {sorted(ERROR_RULES)}, got '{name}'; choose one of them, or name a function "
            "in a file of your own, FILE.py:NAME"
        )
    return rules[name]


def decide_error_mask(
    view: IncompleteView,
    evidence: Evidence | None,
    rule: str,
    fraction: float | None,
    inpainter: Inpainter,
    context: ContextProvider,
    error_model: Inpainter | None = None,
) -> IncompleteView:
    """The view with its final error mask.

    If `inpainter` predicts errors itself, E becomes soft where `fraction` limits it: 1 where a
    pixel is to be re-synthesised, and elsewhere the predicted background fraction, by which the
    pixel is attenuated (`view.fade`). For other inpainters the mask stays binary.

    Args:
        view: the view as rendered.
        evidence: what the error rule decides from; None keeps the view's own E.
        rule: name of the error rule.
        fraction: re-synthesise this fraction of the proxy's pixels, all holes first; None: all of E.
        inpainter: the inpainter that will complete the view.
        context: the cameras.
        error_model: predicts errors for inpainters that do not.

    Raises:
        ValueError: the rule does not return a valid E, or `fraction` limits E and no model predicts errors.
    """
    if evidence is not None and rule != "holes":  # a rendered view has the holes as E
        view = replace(view, error=_apply_rule(rule, evidence))
    if fraction is None or not bool(((view.error > 0) & ~view.holes).any()):
        return view
    predictor = inpainter if inpainter.predicts_errors else error_model
    if predictor is None:
        raise ValueError(
            f"expected a model that predicts errors, which a refine_fraction of {fraction:g} needs, got "
            f"{type(inpainter).__name__} without an error_model; pass "
            "Stream(..., error_model=load_inpainter('views')), or use the error rule 'holes' or 'all'"
        )
    found = predictor.predict_errors(view, context)
    if found is None:
        return view
    if predictor is inpainter:
        return attenuate_background(view, found, fraction)
    return replace(view, error=torch.minimum(view.error, select_by_gain(view, found.gain, fraction)))


def select_by_gain(
    view: IncompleteView, gain: Float[Tensor, "height width"], fraction: float
) -> Float[Tensor, "height width"]:
    """1 on holes and on the pixels of highest gain, up to `fraction` of the proxy's pixels, holes included."""
    priority = (gain + view.holes).flatten()
    count = min(int(fraction * int((view.mask > 0).sum())), int((priority > MIN_GAIN).sum()))
    chosen = torch.zeros_like(priority).index_fill(0, priority.topk(count).indices, 1.0).view_as(view.mask)
    return torch.where(view.holes, 1.0, chosen)


def attenuate_background(view: IncompleteView, found: ErrorMap, fraction: float) -> IncompleteView:
    """The view with a soft E: 1 where a pixel is to be re-synthesised, elsewhere its predicted background fraction."""
    chosen = torch.minimum(select_by_gain(view, found.rest, fraction), (view.error > 0).to(view.error))
    background = torch.where((chosen == 0) & (view.mask > 0), torch.minimum(1 - found.alpha, view.error), 0.0)
    fade = torch.where(background > MIN_FADE, background, 0.0)
    return replace(view, error=torch.where(chosen > 0, view.error, fade), fade=fade)


def _apply_rule(name: str, evidence: Evidence) -> Float[Tensor, "height width"]:
    """E by the rule of this name, as float32; a custom rule's parameters and result are checked."""
    rule = error_rule(name)
    if rule in (holes, all_covered):
        return rule(evidence)
    takes = signature(rule)
    try:
        takes.bind(evidence)
    except TypeError as error:
        raise ValueError(
            f"error rule '{name}': expected a function of one argument, the evidence, got parameters {takes}; write "
            "def NAME(evidence)"
        ) from error
    E = rule(evidence)
    fault = _fault(E, evidence)
    if fault is not None:
        raise ValueError(
            f"error rule '{name}': expected E as floats of shape {tuple(evidence.mask.shape)} in [0, 1], 1 in all "
            f'holes, got {fault}; begin with torch.maximum(error_rule("holes")(evidence), ...)'
        )
    return E.float()


def _fault(E: object, evidence: Evidence) -> str | None:
    if not isinstance(E, Tensor):
        return type(E).__name__
    if E.shape != evidence.mask.shape or not E.is_floating_point():
        return f"{E.dtype} of shape {tuple(E.shape)}"
    if not bool(((E >= 0) & (E <= 1)).all()):
        return f"values from {float(E.min()):.3g} to {float(E.max()):.3g}"
    lower = int((holes(evidence) > E).sum())
    return f"less on {lower} pixels of holes" if lower else None
