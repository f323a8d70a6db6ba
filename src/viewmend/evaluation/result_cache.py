"""The results of an evaluation on disk: one cell per scene and method, complete or absent."""

import hashlib
import json
import math
import re
import struct
import zlib
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from tokenize import TokenError
from typing import Any
from zipfile import BadZipFile

import numpy as np

from viewmend.data.errors import CaptureError
from viewmend.data.images import read_rgb, write_image
from viewmend.evaluation.provenance import Provenance
from viewmend.evaluation.scene_run import RunSettings, SceneRun
from viewmend.evaluation.scores import FEATURES, KINDS, Features, ViewScores
from viewmend.models.classical import Unfilled
from viewmend.models.registry import error_model_for, identity, make_method
from viewmend.rendering.error_mask import error_rule
from viewmend.scenes.held_out import LeaveOneOutScene
from viewmend.utils.atomic_writes import write_atomically, write_text
from viewmend.utils.contact_sheet import Picture
from viewmend.utils.untrusted_input import typed

PROTOCOL = 6
"""Increased whenever synthetic scenes, renderer or scores change, so that old cells are not mixed
with new ones."""
DAMAGED = (OSError, ValueError, KeyError, TypeError, EOFError, BadZipFile, zlib.error, struct.error)
DAMAGED += (
    RuntimeError,
    MemoryError,
    SyntaxError,
    TokenError,
    OverflowError,
)  # NotImplementedError is a RuntimeError
"""Exceptions that a damaged .npz file raises."""


@dataclass(frozen=True)
class CellKey:
    """The key of a cell: `digest` covers everything that its scores depend on, except code (see `Provenance`)."""

    scene: str
    method: str
    digest: str
    scene_digest: str

    @property
    def stem(self) -> str:
        """Start of the names of the cell's files."""
        return f"{slug(self.scene)}--{slug(self.method)}--{self.digest}"

    @property
    def scene_stem(self) -> str:
        """Start of the names of the files that all methods of the scene share."""
        return f"{slug(self.scene)}--{self.scene_digest}"


@dataclass(frozen=True)
class Cell:
    """The result of one method on one scene."""

    key: CellKey
    set: str
    rig: str
    style: str
    identity: str
    """Class, parameters and hash of the weights of the method (`registry.identity`)."""
    frames: tuple[ViewScores, ...]
    step_ms: tuple[float, ...]
    """Milliseconds of the inpainter's step, for each frame."""
    error: str | None
    provenance: Provenance
    features: Features | None = field(default=None, repr=False, compare=False)
    """Features of the method's videos, stored in a separate file."""
    true_features: Features | None = field(default=None, repr=False, compare=False)
    """Features of the true videos, stored in a separate file."""


@dataclass(frozen=True)
class SceneImages:
    """Images of the frame with the largest hole, shared by all methods."""

    rendered: Picture
    error: Picture
    truth: Picture


class CellStore:
    """A folder of cells."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    def load(self, key: CellKey) -> Cell | None:
        """The cell; None if it is absent or damaged."""
        try:
            values = json.loads((self.folder / f"{key.stem}.json").read_text(encoding="utf-8"))
            if values["key"] != asdict(key):
                return None
            features, truth = (self._read_features(f"{stem}.npz") for stem in (key.stem, key.scene_stem))
            return replace(_cell(values), features=features, true_features=truth)
        except (OSError, ValueError, KeyError, TypeError, RecursionError, OverflowError):
            return None

    def save(self, cell: Cell, image: Picture | None) -> None:
        """Store a cell with its image; its JSON file comes last, so that a cell that is there is complete."""
        self._write(cell.key.stem, image, cell.features)
        values = asdict(replace(cell, features=None, true_features=None))
        stored = {field.name: values[field.name] for field in fields(Cell) if field.compare}
        text = json.dumps(stored, indent=1, allow_nan=False) + "\n"
        write_text(self.folder / f"{cell.key.stem}.json", text)

    def save_scene(self, key: CellKey, run: SceneRun) -> None:
        """Store what all methods of a scene share: rendered view, E, truth, and the features of the true videos."""
        image = None if run.images is None else np.concatenate(run.images, 1)
        self._write(key.scene_stem, image, run.features)

    def image(self, key: CellKey) -> Picture | None:
        """The completed view of a cell; None if there is none."""
        return self._read_image(f"{key.stem}.png")

    def scene_images(self, key: CellKey) -> SceneImages | None:
        """The images shared by all methods of the scene; None if there are none."""
        joined = self._read_image(f"{key.scene_stem}.png")
        return (
            None
            if joined is None
            else SceneImages(*(np.ascontiguousarray(p) for p in np.split(joined, 3, 1)))
        )

    def _write(self, stem: str, image: Picture | None, features: Features | None) -> None:
        if image is not None:
            write_image(self.folder / f"{stem}.png", image)
        if features is not None:

            def write(path: Path) -> None:
                with path.open("wb") as file:
                    np.savez(file, **features)  # pyrefly: ignore[bad-argument-type]

            write_atomically(self.folder / f"{stem}.npz", write)

    def _read_features(self, name: str) -> Features | None:
        try:
            with (self.folder / name).open("rb") as file, np.load(file) as arrays:
                found = {kind: arrays[kind] for kind in KINDS}
            fit = all(a.ndim == 2 and a.shape[1] == FEATURES and a.dtype.kind == "f" for a in found.values())
            return found if fit else None
        except DAMAGED:  # only VFID needs them
            return None

    def _read_image(self, name: str) -> Picture | None:
        path = self.folder / name
        try:
            return read_rgb(path, str(path)) if path.is_file() else None
        except CaptureError:  # damaged: the scores are valid without it
            return None


def cell_keys(
    scene: LeaveOneOutScene, identities: dict[str, str], settings: RunSettings, shared_model: str = ""
) -> tuple[CellKey, ...]:
    """The keys of one scene's cells, for methods by name and their identities, and `shared_model_identity`."""
    rules = [PROTOCOL, scene.definition, settings.device.split(":")[0], repr(settings.stream), settings.ssim]
    rules += [value for value in (settings.background, settings.protocol) if value not in ("black", "strict")]
    # A user's rule has a module whose name contains the hash of its file
    rules += [error_rule(settings.stream.render.error_rule or "holes").__module__]
    rules += [shared_model] if shared_model else []
    scene_digest = _digest([*rules, *settings.networks])
    of_methods = [settings.precision]
    if settings.top_k is not None:
        of_methods.append(f"top_k {settings.top_k}")
    return tuple(
        CellKey(scene.name, name, _digest([scene_digest, own, *of_methods]), scene_digest)
        for name, own in identities.items()
    )


def method_identities(names: tuple[str, ...], settings: RunSettings) -> dict[str, str]:
    """`identity` of each method; making them here reports errors before any scene is run.

    Raises:
        ValueError: a method is unknown or cannot be loaded, or its attributes refer to each other.
    """
    found = {}
    for name in names:
        try:
            found[name] = identity(make_method(name, settings.device, settings.precision))
        except RecursionError:
            raise ValueError(
                f"{name}: expected attributes that identify the method, got some that refer back to each other; keep "
                "these in variables of the module"
            ) from None
    return found


def shared_model_identity(settings: RunSettings) -> str:
    """`identity` of the model that predicts depth, masks or errors for all methods; "" if the settings need none."""
    config = settings.stream
    needed = (config.geometry, settings.protocol, config.render.error_rule)
    if not {"fused", "predicted-mask", "predicted"} & set(needed):
        return ""
    return identity(error_model_for(Unfilled(), settings.device, settings.precision))


def to_cells(
    scene: LeaveOneOutScene,
    run: SceneRun,
    keys: tuple[CellKey, ...],
    identities: dict[str, str],
    origin: Provenance,
) -> list[Cell]:
    """The cells of a scene's run, in the order of its methods."""
    by_name = {key.method: key for key in keys}
    return [
        Cell(
            *(by_name[one.method], scene.set, scene.rig, scene.style, identities[one.method]),
            *(one.frames, one.step_ms, one.error, origin, one.features, run.features),
        )
        for one in run.runs
    ]


def slug(name: str) -> str:
    """A name as part of a file name."""
    return re.sub(r"[^A-Za-z0-9._]+", "-", name).strip("-.")[-80:] or "x"


def _digest(parts: list[Any]) -> str:
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:16]


def _cell(values: dict[str, Any]) -> Cell:
    cell: Cell = typed(values, Cell)
    numbers = [n for frame in cell.frames for n in asdict(frame).values() if n is not None]
    if len(cell.step_ms) != len(cell.frames) or not all(map(math.isfinite, [*numbers, *cell.step_ms])):
        raise ValueError("expected finite scores and a duration for each frame")
    if any(frame.image_px < 1 for frame in cell.frames):
        raise ValueError("expected scores of at least one pixel")
    return cell
