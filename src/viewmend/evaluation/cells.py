"""The results of an evaluation on disk: one cell for each scene and method, whole or not there."""

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

from viewmend.atomic_writes import write_atomically, write_text
from viewmend.capture.errors import CaptureError
from viewmend.capture.images import read_rgb, write_image
from viewmend.evaluation.film import FILM_FRAMES, Picture, frames_of
from viewmend.evaluation.frame_scores import FrameScores
from viewmend.evaluation.provenance import Provenance
from viewmend.evaluation.scene_run import MethodRun, RunSettings, SceneRun
from viewmend.evaluation.scorers import FEATURES, KINDS, Features
from viewmend.json_input import typed
from viewmend.leave_one_out.scenes import LeaveOneOutScene
from viewmend.methods import identity, make_method
from viewmend.rendering.error_rules import error_rule

PROTOCOL = 3
"""Grows when studio, renderer or scores change so that old cells no longer stand beside new ones."""
DAMAGED = (OSError, ValueError, KeyError, TypeError, EOFError, BadZipFile, zlib.error, struct.error)
DAMAGED += (RuntimeError, MemoryError, SyntaxError, TokenError, OverflowError)  # NotImplementedError is a RuntimeError
"""What an .npz file that is not whole raises."""


@dataclass(frozen=True)
class CellKey:
    """Which cell: `digest` is of everything that its scores depend on, save code (`Provenance.commit` tells that)."""

    scene: str
    method: str
    digest: str
    scene_digest: str

    @property
    def stem(self) -> str:
        """How the names of the cell's files begin."""
        return f"{slug(self.scene)}--{slug(self.method)}--{self.digest}"

    @property
    def scene_stem(self) -> str:
        """How the names of the files begin that all methods of the scene share."""
        return f"{slug(self.scene)}--{self.scene_digest}"


@dataclass(frozen=True)
class Cell:
    """One method on one scene, as it is remembered."""

    key: CellKey
    set: str
    rig: str
    style: str
    identity: str
    """What the method is, by `methods.identity`."""
    frames: tuple[FrameScores, ...]
    error: str | None
    provenance: Provenance
    features: Features | None = field(default=None, repr=False, compare=False)
    """Features of the method's videos, in a file of their own."""
    true_features: Features | None = field(default=None, repr=False, compare=False)
    """Features of the true videos, in a file of their own."""


REMEMBERED = tuple(f.name for f in fields(Cell) if f.compare)
"""What the cell's file holds."""


@dataclass(frozen=True)
class CellPictures:
    """Pictures of the time of the largest hole."""

    rendered: Picture
    error: Picture
    truth: Picture


class CellStore:
    """A folder of cells."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    def load(self, key: CellKey) -> Cell | None:
        """The cell, None if it is not there, or cannot be read."""
        try:
            values = json.loads((self.folder / f"{key.stem}.json").read_text())
            if values["key"] != asdict(key):
                return None
            features, truth = (self._read_features(f"{stem}.npz") for stem in (key.stem, key.scene_stem))
            return replace(_cell(values), features=features, true_features=truth)
        except (OSError, ValueError, KeyError, TypeError, RecursionError, OverflowError):
            return None

    def save(self, cell: Cell, run: MethodRun) -> None:
        """Remember a cell: the picture and the features first, so that a cell that is there is whole."""
        if run.picture is not None:
            self._write_image(f"{cell.key.stem}.png", run.picture)
        if run.film is not None:
            self._write_image(f"{cell.key.stem}.jpg", run.film)
        if run.features is not None:
            self._write_features(f"{cell.key.stem}.npz", run.features)
        values = asdict(replace(cell, features=None, true_features=None))
        text = json.dumps({name: values[name] for name in REMEMBERED}, indent=1, allow_nan=False) + "\n"
        write_text(self.folder / f"{cell.key.stem}.json", text)

    def save_scene(self, key: CellKey, run: SceneRun) -> None:
        """Remember what all methods of a scene share: rendered view, E, truth, and its videos' features."""
        if run.pictures is not None:
            self._write_image(f"{key.scene_stem}.png", np.concatenate(run.pictures, 1))
        if run.film is not None:
            self._write_image(f"{key.scene_stem}.jpg", run.film)
        if run.features is not None:
            self._write_features(f"{key.scene_stem}.npz", run.features)

    def picture(self, key: CellKey) -> Picture | None:
        """The completed view of a cell; None if there is none."""
        return self._read_image(f"{key.stem}.png")

    def pictures(self, key: CellKey) -> CellPictures | None:
        """What all methods of the scene share; None if there is none."""
        strip = self._read_image(f"{key.scene_stem}.png")
        return None if strip is None else CellPictures(*(np.ascontiguousarray(p) for p in np.split(strip, 3, 1)))

    def film(self, cell: Cell) -> list[Picture]:
        """The first frames of a cell; () if there are none."""
        strip = self._read_image(f"{cell.key.stem}.jpg")
        return [] if strip is None or not cell.frames else frames_of(strip, min(FILM_FRAMES, len(cell.frames)))

    def scene_film(self, cell: Cell) -> tuple[list[Picture], list[Picture]]:
        """The first frames of the cell's scene: as rendered, and the truth."""
        strip = self._read_image(f"{cell.key.scene_stem}.jpg")
        if strip is None or not cell.frames:
            return [], []
        count = min(FILM_FRAMES, len(cell.frames))
        rendered, truth = (frames_of(part, count) for part in np.split(strip, 2, 1))
        return rendered, truth

    def _write_features(self, name: str, features: Features) -> None:
        def write(path: Path) -> None:
            with path.open("wb") as file:
                np.savez(file, **features)  # pyright: ignore[reportArgumentType]

        write_atomically(self.folder / name, write)

    def _read_features(self, name: str) -> Features | None:
        try:
            with (self.folder / name).open("rb") as file, np.load(file) as arrays:
                found = {kind: arrays[kind] for kind in KINDS}
            fit = all(a.ndim == 2 and a.shape[1] == FEATURES and a.dtype.kind == "f" for a in found.values())
            return found if fit else None
        except DAMAGED:  # without them there is no VFID, all else stands
            return None

    def _write_image(self, name: str, image: Picture) -> None:
        write_image(self.folder / name, image)

    def _read_image(self, name: str) -> Picture | None:
        path = self.folder / name
        try:
            return read_rgb(path, str(path)) if path.is_file() else None
        except CaptureError:  # damaged: the figures stand without it
            return None


def cell_keys(scene: LeaveOneOutScene, identities: dict[str, str], settings: RunSettings) -> tuple[CellKey, ...]:
    """The keys of one scene's cells, for methods by name and their identities."""
    rules = [PROTOCOL, scene.definition, settings.device.split(":")[0], repr(settings.stream), settings.ssim]
    rules += [] if settings.background == "black" else [settings.background]
    rules += [error_rule(settings.stream.render.error_rule or "unseen").__module__]  # has the hash of one's own file
    scene_digest = _digest([*rules, *settings.networks])
    return tuple(
        CellKey(scene.name, name, _digest([scene_digest, own, settings.precision]), scene_digest)
        for name, own in identities.items()
    )


def method_identities(names: tuple[str, ...], settings: RunSettings) -> dict[str, str]:
    """`identity` of each method; what cannot be made is found here, before any scene is run.

    Raises:
        ValueError: there is no such method, or it cannot be loaded.
    """
    return {name: identity(make_method(name, settings.device, settings.precision)) for name in names}


def to_cells(
    scene: LeaveOneOutScene,
    run: SceneRun,
    keys: tuple[CellKey, ...],
    identities: dict[str, str],
    provenance: Provenance,
) -> list[tuple[Cell, MethodRun]]:
    """What a scene's run leaves behind."""
    by_name = {key.method: key for key in keys}
    return [
        (
            Cell(
                by_name[one.method],
                scene.set,
                scene.rig,
                scene.style,
                identities[one.method],
                one.frames,
                one.error,
                provenance,
                one.features,
                run.features,
            ),
            one,
        )
        for one in run.runs
    ]


def slug(name: str) -> str:
    """A name as part of a file's name."""
    return re.sub(r"[^A-Za-z0-9._]+", "-", name).strip("-.")[-80:] or "x"


def _digest(parts: list[Any]) -> str:
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:16]


def _cell(values: dict[str, Any]) -> Cell:
    values = dict(values)
    if set(values) != set(REMEMBERED):
        raise ValueError(f"expected a cell with {sorted(REMEMBERED)}, got {sorted(values)}")
    values["key"] = typed(values["key"], CellKey)
    values["frames"] = tuple(typed(values["frames"], list[FrameScores]))
    values["provenance"] = typed(values["provenance"], Provenance)
    for name in ("set", "rig", "style", "identity"):
        typed(values[name], str)
    typed(values["error"], str | None)
    for frame in values["frames"]:
        if frame.image_px < 1 or not all(math.isfinite(n) for n in asdict(frame).values() if n is not None):
            raise ValueError("expected finite scores of pixels, got others")
    return Cell(**values)
