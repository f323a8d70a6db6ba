"""All inpainters by name, for every command: entries of `METHODS`, baselines, classes in files, models' folders."""

import hashlib
import importlib
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import partial
from inspect import signature
from pathlib import Path
from typing import cast

import torch
from torch import Tensor, nn

from viewmend.inpainting.checkpoint import load_inpainter, shipped_models
from viewmend.inpainting.protocol import ViewInpainter
from viewmend.python_files import from_file

REFERENCE = "telea"
"""Tables show how much better than this one every other is."""
PRIVILEGED = ("rgvi",)
"""See more than others may: their rows say so."""


class MethodMissing(ValueError):  # noqa: N818
    """A known method whose weights are not here: its row is n/a, and this is the reason."""


METHODS: dict[str, str] = {
    "telea": "viewmend.baselines.classical:Telea",
    "navier-stokes": "viewmend.baselines.classical:NavierStokes",
    "nearest": "viewmend.baselines.classical:NearestColour",
    "smooth": "viewmend.inpainting.coarse_fill:SmoothFill",
    "reprojection": "viewmend.baselines.reprojection_fill:ReprojectionFill",
    "unfilled": "viewmend.baselines.classical:Unfilled",
    "rgvi": "viewmend.baselines.rgvi:make_rgvi",
}
"""MODULE:NAME of each, which is called with the device if it takes one; a module is imported when it is asked for."""
BASELINES = tuple(
    f"{network}-o-{framing}{weights}"
    for network in ("dstt", "fuseformer", "e2fgvi")
    for weights in ("", "-finetuned")
    for framing in ("def", "win", "mul")
)
"""The baselines of the paper's Table 1 in its order: pretrained, then fine-tuned. `baselines.published` knows more."""


def method_names(selection: str) -> tuple[str, ...]:
    """Names in a list with commas; "all" stands for the shipped models and all of `METHODS`, "baselines" for these.

    Raises:
        ValueError: no name is there.
    """
    groups = {"all": (*shipped_models(), *METHODS), "baselines": BASELINES}
    names = [
        name for part in selection.split(",") if part.strip() for name in groups.get(part.strip(), (part.strip(),))
    ]
    if not names:
        raise ValueError(f"expected --methods all, or names with commas, got '{selection}'")
    return tuple(dict.fromkeys(names))


def make_method(name: str, device: str = "cpu", precision: str = "auto") -> ViewInpainter:
    """The inpainter of this name: an entry of `METHODS`, a baseline, FILE.py:NAME, a shipped model, a model's folder.

    FILE.py:NAME is what NAME in that file, called with the device, returns.

    Raises:
        MethodMissing: its weights are not here.
        ValueError: there is none, or it cannot be loaded (`WeightsError`); no such precision.

    Examples:
        >>> from viewmend import make_method
        >>> type(make_method("telea")).__name__
        'Telea'
    """
    if name in METHODS:
        module, _, made = METHODS[name].partition(":")
        make = getattr(importlib.import_module(module), made)
        return make(device) if "device" in signature(make).parameters else make()
    if name in shipped_models() or Path(name).is_dir():
        return load_inpainter(name, device, precision)
    if ".py:" in name:
        make = cast(Callable[[str], ViewInpainter], from_file(name))
        try:
            signature(make).bind(device)
        except TypeError as error:
            raise ValueError(f"{name}: expected something to call with the device ('{device}'), got {error}") from error
        return make(device)
    from viewmend.baselines.published import is_baseline, make_baseline
    from viewmend.metrics.weights import MissingWeightsError

    if is_baseline(name):
        try:
            return make_baseline(name, device)
        except MissingWeightsError as error:
            raise MethodMissing(str(error)) from error
    known = ", ".join([*shipped_models(), *METHODS])
    raise ValueError(
        f"expected a method among {known}, a baseline like dstt-o-def, FILE.py:NAME, or a model's folder, got "
        f"'{name}'; see --methods"
    )


def default_method() -> str:
    """The model that is shipped, of several `views`, which mends whole views; where none is, OpenCV's Telea."""
    shipped = shipped_models()
    return next((name for name in ("views", "small", *shipped) if name in shipped), "telea")


def split_missing(names: tuple[str, ...], device: str = "cpu") -> tuple[tuple[str, ...], dict[str, str]]:
    """The methods that can be made, and why each of the others is n/a.

    Raises:
        ValueError: a method is unknown, or broken.
    """
    missing = {}
    for name in names:
        try:
            make_method(name, device)
        except MethodMissing as error:
            missing[name] = str(error)
    return tuple(name for name in names if name not in missing), missing


def identity(inpainter: object) -> str:
    """Class and parameters of an inpainter, weights as their SHA-256: equal for inpainters that fill alike.

    The code that computes with them is not in it.
    """
    if isinstance(inpainter, nn.Module):
        own = {
            name: value for name, value in vars(inpainter).items() if not name.startswith("_") and name != "training"
        }
        plain = {name: value for name, value in own.items() if not isinstance(value, nn.Module)}
        return f"{_class(inpainter)}({identity(dict(inpainter.state_dict()))}, {identity(plain)})"
    if isinstance(inpainter, Tensor):
        data = inpainter.detach().cpu().contiguous().flatten().view(torch.uint8).numpy().tobytes()
        return f"{inpainter.dtype}{tuple(inpainter.shape)}:{hashlib.sha256(data).hexdigest()}"
    if isinstance(inpainter, dict):
        text = ", ".join(
            f"{key}={identity(value)}" for key, value in sorted(inpainter.items(), key=lambda i: str(i[0]))
        )
        return hashlib.sha256(text.encode()).hexdigest() if len(text) > 1000 else f"{{{text}}}"
    if isinstance(inpainter, list | tuple):
        return f"[{', '.join(map(identity, inpainter))}]"
    if isinstance(inpainter, str | int | float | bool | Enum | Path | torch.dtype | None):
        return repr(inpainter)
    if isinstance(inpainter, partial):
        return f"partial({identity(inpainter.func)}, {identity(inpainter.args)}, {identity(inpainter.keywords)})"
    if is_dataclass(inpainter) and not isinstance(inpainter, type):
        return f"{_class(inpainter)}({identity({f.name: getattr(inpainter, f.name) for f in fields(inpainter)})})"
    if callable(inpainter) and hasattr(inpainter, "__qualname__"):
        return f"{getattr(inpainter, '__module__', '')}.{inpainter.__qualname__}"  # pyright: ignore
    return f"{_class(inpainter)}({identity(dict(vars(inpainter)) if hasattr(inpainter, '__dict__') else {})})"


def _class(value: object) -> str:
    return f"{type(value).__module__}.{type(value).__qualname__}"
