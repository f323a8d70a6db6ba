"""The results of an evaluation on disk: one cell for each scene and method, whole or not there."""

import hashlib
import json
import re
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from viewmend.capture.errors import CaptureError
from viewmend.capture.images import read_rgb, write_image
from viewmend.evaluation.frame_scores import FrameScores
from viewmend.evaluation.methods import identity, make_method
from viewmend.evaluation.provenance import Provenance
from viewmend.evaluation.scene_run import MethodRun, Picture, RunSettings, SceneRun
from viewmend.evaluation.scenes import EvaluationScene

PROTOCOL = 1
"""Grows when studio, renderer or scores change so that old cells no longer stand beside new ones."""


@dataclass(frozen=True)
class CellKey:
    """Which cell: `digest` is of everything that its scores depend on, save code (`Provenance.commit` tells that)."""

    scene: str
    method: str
    digest: str
    scene_digest: str

    @property
    def stem(self) -> str:
        """Of the cell's files."""
        return f"{slug(self.scene)}--{slug(self.method)}--{self.digest}"

    @property
    def scene_stem(self) -> str:
        """Of the files that all methods of the scene share."""
        return f"{slug(self.scene)}--{self.scene_digest}"


@dataclass(frozen=True)
class Cell:
    """One method on one scene, as it is remembered."""

    key: CellKey
    set: str
    rig: str
    style: str
    identity: str
    """Of the method, `methods.identity`."""
    frames: tuple[FrameScores, ...]
    error: str | None
    provenance: Provenance


@dataclass(frozen=True)
class CellPictures:
    """At the time of the largest hole."""

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
            return _cell(values) if values["key"] == asdict(key) else None
        except (OSError, ValueError, KeyError, TypeError):
            return None

    def save(self, cell: Cell, run: MethodRun) -> None:
        """Remember a cell: the picture first, so that a cell that is there is whole."""
        if run.picture is not None:
            self._write_image(f"{cell.key.stem}.png", run.picture)
        text = json.dumps(asdict(cell), indent=1, allow_nan=False) + "\n"
        _replace(self.folder / f"{cell.key.stem}.json", lambda path: path.write_text(text))

    def save_pictures(self, key: CellKey, pictures: tuple[Picture, Picture, Picture]) -> None:
        """Remember what all methods of a scene share: rendered view, E, truth."""
        self._write_image(f"{key.scene_stem}.png", np.concatenate(pictures, 1))

    def picture(self, key: CellKey) -> Picture | None:
        """The completed view of a cell; None if there is none."""
        return self._read_image(f"{key.stem}.png")

    def pictures(self, key: CellKey) -> CellPictures | None:
        """What all methods of the scene share; None if there is none."""
        strip = self._read_image(f"{key.scene_stem}.png")
        return None if strip is None else CellPictures(*(np.ascontiguousarray(p) for p in np.split(strip, 3, 1)))

    def _write_image(self, name: str, image: Picture) -> None:
        _replace(self.folder / name, lambda path: write_image(path, image))

    def _read_image(self, name: str) -> Picture | None:
        path = self.folder / name
        try:
            return read_rgb(path, str(path)) if path.is_file() else None
        except CaptureError:  # damaged: the figures stand without it
            return None


def cell_keys(scene: EvaluationScene, identities: dict[str, str], settings: RunSettings) -> tuple[CellKey, ...]:
    """The keys of one scene's cells, for methods by name and their identities."""
    rules = [PROTOCOL, scene.definition, settings.device.split(":")[0], repr(settings.pipeline), settings.ssim]
    scene_digest = _digest(rules)
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
    scene: EvaluationScene,
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
    known = {f.name for f in fields(Cell)}
    if set(values) != known:
        raise ValueError(f"expected a cell with {sorted(known)}, got {sorted(values)}")
    values["key"] = CellKey(**values["key"])
    values["frames"] = tuple(FrameScores(**frame) for frame in values["frames"])
    values["provenance"] = Provenance(**values["provenance"])
    return Cell(**values)


def _replace(path: Path, write: Callable[[Path], object]) -> None:
    """Write beside the place, then rename: nobody ever sees half a file."""
    beside = path.with_name(f".half-{path.name}")
    write(beside)
    beside.replace(path)
