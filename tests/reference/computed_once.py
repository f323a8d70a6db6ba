"""Pure functions that are computed once for equal arguments, because many tests begin with the same scenes."""

import hashlib
import math
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from functools import cache, lru_cache, wraps
from typing import Any

import numpy as np
import pytest
from torch import Tensor

from viewmend.data import prepare
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras
from viewmend.geometry.hull import HullConfig
from viewmend.geometry.proxy import GeometryProxy, reconstruct
from viewmend.studio import procedural
from viewmend.studio.performer import Performer
from viewmend.studio.stage import Studio
from viewmend.types import MultiViewFrame

CHECKS = ("diagnose", "shared_offset", "match_colours", "find_loose_masks")
"""The expensive functions of `viewmend.data.prepare`."""
CARVERS = (
    "frame_cache",
    "geometry.alignment",
    "data.colour_matching",
    "data.checks.calibration",
    "data.checks.colours",
    "data.checks.diagnosis",
    "data.checks.leave_one_out",
    "data.checks.synchronisation",
)
"""The modules of the package in which many tests call `reconstruct` for the same masks."""
SMALL_PX = 128
"""Masks of at most this many pixels along their longer side are small: a subject spans fewer than 100."""
SMALL_HULL = HullConfig(resolution=64)
"""A hull for small masks, whose voxels are about as large as a pixel."""
MAX_HULLS = 64
"""At most this many hulls are remembered; each takes up to three megabytes."""
MAX_SCENES = 16
"""At most this many procedural scenes are remembered; each takes some megabytes."""
MAX_DRAWN = 100
"""At most this many frames of the studio are remembered; five images of 96 x 96 pixels take 0.4 MB."""


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


def computed_once(function: Callable[..., Any], most: float = math.inf) -> Callable[..., Any]:
    """The function with a memory of its last results, at most this many, which must not be changed.

    Nothing is remembered for tensors of another class, such as those of an imitated device.
    """
    results: OrderedDict[Any, Any] = OrderedDict()

    @wraps(function)
    def remembered(*arguments: Any) -> Any:
        if any(isinstance(value, Tensor) and type(value) is not Tensor for value in arguments):
            return function(*arguments)
        key = content_of(arguments)
        if key not in results:
            results[key] = function(*arguments)
        results.move_to_end(key)
        if len(results) > most:
            results.popitem(last=False)
        return results[key]

    return remembered


def drawn_once() -> Callable[..., MultiViewFrame]:
    """`Studio._draw` with a memory of the last frames, of which every caller gets a copy."""
    draw = Studio._draw
    drawn: OrderedDict[Any, tuple[Performer, MultiViewFrame]] = OrderedDict()

    @wraps(draw)
    def remembered(studio: Studio, cameras: Cameras, time: int, behind: Tensor | None) -> MultiViewFrame:
        config = studio.config
        stage = (id(studio.performer), config.seed, config.fps, config.samples_per_side)
        key = (*stage, time, content_of(cameras), content_of(behind))
        if key not in drawn:
            drawn[key] = studio.performer, draw(studio, cameras, time, behind)
        drawn.move_to_end(key)
        if len(drawn) > MAX_DRAWN:
            drawn.popitem(last=False)
        _, frame = drawn[key]
        assert frame.mask is not None
        assert frame.depth is not None
        return replace(frame, rgb=frame.rgb.clone(), mask=frame.mask.clone(), depth=frame.depth.clone())

    return remembered


@cache
def remembering_functions() -> dict[str, Callable[..., Any]]:
    """Replacements of functions of the package, by their places, with one memory for all tests of this process."""
    checks = {f"viewmend.data.prepare.{name}": computed_once(getattr(prepare, name)) for name in CHECKS}
    scene = lru_cache(MAX_SCENES)(procedural.procedural_scene)
    places = ("viewmend.studio.procedural.procedural_scene", "viewmend.scenes.studio_scenes.procedural_scene")
    return checks | dict.fromkeys(places, scene) | {"viewmend.studio.stage.Studio._draw": drawn_once()}


@cache
def remembering_hulls() -> Callable[..., Any]:
    """`reconstruct`, with one memory for all tests of this process."""
    return computed_once(reconstruct, MAX_HULLS)


def carve_coarsely(
    mask: Tensor, cameras: Cameras, bounds: Bounds | None = None, config: HullConfig | None = None
) -> GeometryProxy:
    """`reconstruct` with a memory; by default, hulls of small masks have `SMALL_HULL`."""
    if config is None and max(mask.shape[1:]) <= SMALL_PX:
        config = SMALL_HULL
    return remembering_hulls()(mask, cameras, bounds, config)


def carve_once(patch: pytest.MonkeyPatch, coarsely: bool = False) -> None:
    """Let a test use the hulls that earlier ones carved of equal masks."""
    carve = carve_coarsely if coarsely else remembering_hulls()
    for module in CARVERS:
        patch.setattr(f"viewmend.{module}.reconstruct", carve)


def compute_once(patch: pytest.MonkeyPatch, coarsely: bool = False) -> None:
    """Let a test use what earlier ones computed of equal captures and scenes."""
    carve_once(patch, coarsely)
    for place, function in remembering_functions().items():
        patch.setattr(place, function)
