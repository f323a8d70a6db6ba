"""Pure functions that are computed once for equal arguments, because many tests begin with the same scenes."""

import hashlib
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from functools import cache, lru_cache, wraps
from typing import Any

import numpy as np
import pytest
from torch import Tensor

from viewmend.data import prepare
from viewmend.studio import procedural

CHECKS = ("diagnose", "shared_offset", "match_colours", "find_loose_masks")
"""The expensive functions of `viewmend.data.prepare`."""
MAX_SCENES = 16
"""At most this many procedural scenes are remembered; each takes some megabytes."""


def content_of(value: Any) -> Any:
    """A hashable summary, equal for arguments of equal content."""
    if isinstance(value, Tensor):
        data = np.ascontiguousarray(value.numpy(force=True))
        return str(value.dtype), tuple(value.shape), hashlib.sha256(data.tobytes()).digest()
    if is_dataclass(value) and not isinstance(value, type):
        return type(value), tuple(content_of(getattr(value, field.name)) for field in fields(value))
    if isinstance(value, list | tuple):
        return tuple(map(content_of, value))
    return value


def computed_once(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function with a memory of its results, which must not be changed."""
    results: dict[Any, Any] = {}

    @wraps(function)
    def remembered(*arguments: Any) -> Any:
        key = content_of(arguments)
        if key not in results:
            results[key] = function(*arguments)
        return results[key]

    return remembered


@cache
def remembering_functions() -> dict[str, Callable[..., Any]]:
    """Replacements of functions of the package, by their places, with one memory for all tests of this process."""
    checks = {f"viewmend.data.prepare.{name}": computed_once(getattr(prepare, name)) for name in CHECKS}
    scene = lru_cache(MAX_SCENES)(procedural.procedural_scene)
    places = ("viewmend.studio.procedural.procedural_scene", "viewmend.scenes.studio_scenes.procedural_scene")
    return checks | dict.fromkeys(places, scene)


def compute_once(patch: pytest.MonkeyPatch) -> None:
    """Let a test use what earlier ones computed of equal captures and scenes."""
    for place, function in remembering_functions().items():
        patch.setattr(place, function)
