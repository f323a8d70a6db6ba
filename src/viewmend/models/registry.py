"""Inpainters by name, for all commands: `METHODS`, baselines, classes in files, and models' folders."""

import hashlib
import json
import logging
import re
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import partial
from inspect import signature
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from viewmend.models.base import Inpainter
from viewmend.models.checkpoint import CONFIG, load_inpainter, model_folder, shipped_models
from viewmend.utils.plugins import import_object, load_from_file
from viewmend.utils.weight_files import MissingWeightsError

REFERENCE = "telea"
"""Tables show the difference of every method from this one."""
ERROR_MODEL = "views"
"""The shipped model that predicts errors, depth and masks for inpainters that do not."""
PRIVILEGED = ("rgvi",)
"""Methods that use the ground truth; their table rows say so."""
METHODS: dict[str, str] = {
    "telea": "viewmend.models.classical:Telea",
    "navier-stokes": "viewmend.models.classical:NavierStokes",
    "nearest": "viewmend.models.classical:NearestColour",
    "smooth": "viewmend.models.smooth_fill:SmoothFill",
    "reprojection": "viewmend.models.classical:ReprojectionFill",
    "unfilled": "viewmend.models.classical:Unfilled",
    "rgvi": "viewmend.contrib.baselines.rgvi:make_rgvi",
}
"""MODULE:NAME of each method's factory, imported on demand, and called with the device if it takes one."""
FAMILIES = dict.fromkeys(
    ("dstt", "fuseformer", "e2fgvi"), "viewmend.contrib.baselines.published:make_baseline"
)
"""MODULE:NAME of the factory of all methods whose names start with this word; called with the name
and the device."""
BASELINES = tuple(
    f"{network}-o-{framing}{weights}"
    for network in ("dstt", "fuseformer", "e2fgvi")
    for weights in ("", "-finetuned")
    for framing in ("def", "win", "mul")
)
"""The baselines of the paper's Table 1, in its order: pretrained, then fine-tuned.
`baselines.published` has more."""


class MethodMissing(ValueError):  # noqa: N818
    """A known method whose weights are not installed; tables show n/a and this message."""


def method_names(selection: str) -> tuple[str, ...]:
    """The names in a comma-separated list; "all" stands for shipped models and `METHODS`, "baselines" for `BASELINES`.

    Raises:
        ValueError: the list is empty.
    """
    groups = {"all": (*shipped_models(), *METHODS), "baselines": BASELINES}
    parts = [part.strip() for part in selection.split(",") if part.strip()]
    names = [name for part in parts for name in groups.get(part, (part,))]
    if not names:
        raise ValueError(
            f"expected 'all' or names with commas, got '{selection}'; see viewmend evaluate --help"
        )
    return tuple(dict.fromkeys(names))


def make_method(name: str, device: str = "cpu", precision: str = "auto") -> Inpainter:
    """The inpainter of this name: an entry of `METHODS`, a baseline, FILE.py:NAME, a shipped model, a model's folder.

    For FILE.py:NAME, the file's NAME is called, with the device if it takes one; it must return a
    `viewmend.Inpainter`. Only models on disk use `precision`, as `load_inpainter`.

    Raises:
        MethodMissing: its weights are not installed.
        ValueError: the name or the precision is unknown, the method is not an `Inpainter`, or it
            cannot be loaded (`WeightsError`).

    Examples:
        >>> from viewmend import make_method
        >>> type(make_method("telea")).__name__
        'Telea'
    """
    made = _make(name, device, precision)
    if not isinstance(made, Inpainter):
        raise ValueError(
            f"{name}: expected an inpainter, got {type(made).__name__}; make its class a subclass of viewmend.Inpainter"
        )
    return made


def error_model_for(inpainter: Inpainter, device: str = "cpu", precision: str = "auto") -> Inpainter | None:
    """The model that predicts errors, depth and masks for `inpainter`: `views`; None if it does so itself."""
    predicts_all = inpainter.predicts_errors and inpainter.predicts_depth
    return None if predicts_all else load_inpainter(ERROR_MODEL, device, precision)


def own_background(name: str) -> str | None:
    """The background that a model was made for, by its config; None for one without, and for other methods."""
    try:
        found = json.loads((model_folder(name) / CONFIG).read_bytes())
    except (ValueError, OSError):
        return None
    return found.get("background") if isinstance(found, dict) else None


def _make(name: str, device: str, precision: str) -> object:
    if name in METHODS:
        return _call(import_object(METHODS[name]), name, device)
    if name in shipped_models() or Path(name).is_dir():
        return load_inpainter(name, device, precision)
    if ".py:" in name:
        return _call(load_from_file(name), name, device)
    family = re.split("[-@]", name)[0]
    if family in FAMILIES:
        try:
            return import_object(FAMILIES[family])(name, device)
        except MissingWeightsError as error:
            raise MethodMissing(str(error)) from error
    known = ", ".join([*shipped_models(), *METHODS])
    raise ValueError(
        f"expected a method among {known}, a baseline like dstt-o-def, FILE.py:NAME, or a model's folder, got "
        f"'{name}'; see viewmend evaluate --help"
    )


def _call(make: Callable[..., object], name: str, device: str) -> object:
    """Call a class or a factory: with the device if it has a parameter of that name, or needs exactly one argument."""
    takes = signature(make)
    named = {"device": device} if "device" in takes.parameters else {}
    for arguments in (partial(takes.bind, **named), partial(takes.bind, device)):
        try:
            bound = arguments()
        except TypeError:
            continue
        return make(*bound.args, **bound.kwargs)
    raise ValueError(
        f"{name}: expected a class or function that needs no argument but the device, got the parameters {takes}; give "
        "the others defaults"
    )


def default_method() -> str:
    """The shipped model, `views` if there are several; OpenCV's Telea if there is none."""
    shipped = shipped_models()
    return next((name for name in ("views", *shipped) if name in shipped), "telea")


def split_missing(names: tuple[str, ...], device: str = "cpu") -> tuple[tuple[str, ...], dict[str, str]]:
    """The methods whose weights are installed, and why others are missing; ValueError if one is unknown or broken."""
    missing = {}
    for name in names:
        try:
            make_method(name, device)
        except MethodMissing as error:
            missing[name] = str(error)
    return tuple(name for name in names if name not in missing), missing


def identity(inpainter: object) -> str:
    """Class, parameters and SHA-256 of the weights of an inpainter: a key of cached results. Code is not included."""
    if isinstance(inpainter, nn.Module):
        own = {name: value for name, value in vars(inpainter).items() if not isinstance(value, nn.Module)}
        plain = {
            name: value for name, value in own.items() if not name.startswith("_") and name != "training"
        }
        return f"{_class(inpainter)}({identity(dict(inpainter.state_dict()))}, {identity(plain)})"
    if isinstance(inpainter, Tensor):
        data = inpainter.detach().cpu().contiguous().flatten().view(torch.uint8).numpy().tobytes()
        return f"{inpainter.dtype}{tuple(inpainter.shape)}:{hashlib.sha256(data).hexdigest()}"
    if isinstance(inpainter, dict):
        items = sorted(inpainter.items(), key=lambda item: str(item[0]))
        text = ", ".join(f"{key}={identity(value)}" for key, value in items)
        return hashlib.sha256(text.encode()).hexdigest() if len(text) > 1000 else f"{{{text}}}"
    if isinstance(inpainter, list | tuple):
        return f"[{', '.join(map(identity, inpainter))}]"
    if isinstance(inpainter, str | int | float | bool | Enum | Path | torch.dtype | None):
        return repr(inpainter)
    if isinstance(inpainter, np.ndarray | np.generic):
        data = np.ascontiguousarray(inpainter).tobytes()
        return f"numpy.{inpainter.dtype}{inpainter.shape}:{hashlib.sha256(data).hexdigest()}"
    if isinstance(inpainter, bytes | bytearray):
        return f"bytes:{hashlib.sha256(inpainter).hexdigest()}"
    if isinstance(inpainter, set | frozenset):
        return f"[{', '.join(sorted(map(identity, inpainter)))}]"
    if isinstance(inpainter, logging.Logger):  # refers to all other loggers, and they to it
        return repr(inpainter.name)
    if isinstance(inpainter, partial):
        return (
            f"partial({identity(inpainter.func)}, {identity(inpainter.args)}, {identity(inpainter.keywords)})"
        )
    if is_dataclass(inpainter) and not isinstance(inpainter, type):
        return f"{_class(inpainter)}({identity({f.name: getattr(inpainter, f.name) for f in fields(inpainter)})})"
    if callable(inpainter) and hasattr(inpainter, "__qualname__"):
        return f"{getattr(inpainter, '__module__', '')}.{inpainter.__qualname__}"
    return f"{_class(inpainter)}({identity(dict(vars(inpainter)) if hasattr(inpainter, '__dict__') else {})})"


def _class(value: object) -> str:
    return f"{type(value).__module__}.{type(value).__qualname__}"
