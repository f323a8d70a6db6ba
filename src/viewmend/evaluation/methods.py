"""The methods of an evaluation, by name: one entry each in `METHODS`; any other name is a model's."""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass
from enum import Enum
from functools import partial
from pathlib import Path

import torch
from torch import Tensor, nn

from viewmend.inpainting.checkpoint import load_inpainter, shipped_models
from viewmend.inpainting.classical import NavierStokes, NearestColour, SmoothFill, Telea, Unfilled
from viewmend.inpainting.protocol import ViewInpainter
from viewmend.inpainting.reprojection_fill import ReprojectionFill

REFERENCE = "telea"
"""Tables show how much better than this one every other is."""


@dataclass(frozen=True)
class Method:
    """How to make an inpainter."""

    name: str
    make: Callable[[str], ViewInpainter]
    """From the device. Import what is heavy in there."""


METHODS: tuple[Method, ...] = (
    Method("telea", lambda device: Telea()),
    Method("navier-stokes", lambda device: NavierStokes()),
    Method("nearest", lambda device: NearestColour()),
    Method("smooth", lambda device: SmoothFill()),
    Method("reprojection", lambda device: ReprojectionFill()),
    Method("unfilled", lambda device: Unfilled()),
)


def method_names(selection: str) -> tuple[str, ...]:
    """Names in a list with commas; "all" stands for the shipped models and all of `METHODS`.

    Raises:
        ValueError: no name is there.
    """
    names: list[str] = []
    for name in (part.strip() for part in selection.split(",")):
        names += [*shipped_models(), *(m.name for m in METHODS)] if name == "all" else [name] if name else []
    if not names:
        raise ValueError(f"expected --methods all, or names with commas, got '{selection}'")
    return tuple(dict.fromkeys(names))


def make_method(name: str, device: str = "cpu", precision: str = "float32") -> ViewInpainter:
    """The inpainter of this name: an entry of `METHODS`, a shipped model, or a model's folder.

    Raises:
        ValueError: there is none, or it cannot be loaded (`CheckpointError`); no such precision.
    """
    if precision not in ("float32", "bfloat16"):
        raise ValueError(f"expected --precision float32 or bfloat16, got '{precision}'")
    for method in METHODS:
        if method.name == name:
            return method.make(device)
    if name not in shipped_models() and not Path(name).is_dir():
        known = ", ".join([*shipped_models(), *(m.name for m in METHODS)])
        raise ValueError(f"expected a method among {known}, or a model's folder, got '{name}'; see --methods")
    inpainter = load_inpainter(name, device)
    inpainter.compute_dtype = torch.bfloat16 if precision == "bfloat16" else torch.float32
    return inpainter


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
