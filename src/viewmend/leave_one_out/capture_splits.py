"""The paper's protocol for captures, in a file: who trains and who tests, and which camera is left out (section 8)."""

import hashlib
import json
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import torch
from msgspec import Meta, Struct, structs

from viewmend.capture.formats.recognition import read_any_calibration
from viewmend.capture.plain import PlainCapture, open_capture
from viewmend.capture.prepare import open_masked
from viewmend.foreign_input import bounded_bytes
from viewmend.geometry.cameras import Cameras
from viewmend.json_input import read_json, typed
from viewmend.leave_one_out.capture_scenes import CaptureScene, capture_set
from viewmend.rendering.selection import select_closest

FORMAT = "viewmend-splits/1"
CLOSEST = 3
MOST_BYTES = 2**26


class SplitScene(Struct, frozen=True, kw_only=True):
    """One capture of the file's `scenes`."""

    name: str
    path: Annotated[str, Meta(min_length=1)]
    """Where the capture is, relative to the file's folder."""
    kind: str | None = None
    subject: str
    split: Literal["training", "test"]
    left_out: str
    closest: tuple[str, ...]
    """The three others closest to it, in angle at the point that all cameras look at, nearest first."""
    calibration_sha256: str
    """Hash of names, lenses and poses: another calibration is another scene."""


class SplitFile(Struct, frozen=True, kw_only=True):
    """All of the file."""

    format: Literal["viewmend-splits/1"]
    seed: int
    scenes: Annotated[tuple[SplitScene, ...], Meta(min_length=1)]


def make_splits(
    captures: Sequence[Path],
    base: Path,
    *,
    seed: int = 0,
    test_fraction: float = 0.1,
    subject: str = "(.*)",
    kind: str | None = None,
) -> SplitFile:
    """Split captures so that no subject is in both parts, and choose the camera that each leaves out.

    The order of subjects and the cameras follow from hashes of their names and the seed alone: the same on every
    machine, and another capture changes nobody's camera.

    Args:
        captures: folders, or files that stand for them.
        base: the folder that paths are relative to.
        seed: chooses subjects and cameras.
        test_fraction: at least this part of the scenes is for tests; at least one subject.
        subject: a regular expression, whose first group in a capture's name is its subject.
        kind: the captures' format, None to recognise it.

    Raises:
        ValueError: fewer than two subjects, a name without a subject, two scenes of one name, or fewer than 4 cameras.
    """
    scenes = [_scene(path, base, seed, subject, kind) for path in captures]
    names = [scene.name for scene in scenes]
    twice = sorted({name for name in names if names.count(name) > 1})
    subjects = sorted({scene.subject for scene in scenes}, key=lambda one: _hash(seed, "subject", one))
    if twice or len(subjects) < 2:
        got = f"{twice[:3]} twice" if twice else f"the subjects {subjects}"
        raise ValueError(f"expected captures of different names and of two subjects or more, got {got}; see --subject")
    tested: set[str] = set()
    for one in subjects[:-1]:
        if tested and sum(scene.subject in tested for scene in scenes) >= test_fraction * len(scenes):
            break
        tested.add(one)
    split = [structs.replace(s, split="test" if s.subject in tested else "training") for s in scenes]
    return SplitFile(format=FORMAT, seed=seed, scenes=tuple(sorted(split, key=lambda s: (s.split, s.subject, s.name))))


def splits_json(splits: SplitFile) -> str:
    """The file's text."""
    told = structs.asdict(splits) | {"scenes": [structs.asdict(scene) for scene in splits.scenes]}
    return json.dumps({"format": FORMAT, "protocol": _PROTOCOL, **told}, indent=1) + "\n"


def is_splits(file: Path) -> bool:
    """Whether this is a file of splits, by its beginning."""
    if not file.is_file() or file.suffix != ".json":
        return False
    with file.open("rb") as stream:
        return FORMAT.encode() in stream.read(2048)


def read_splits(file: Path) -> SplitFile:
    """A file that `make_splits` made.

    Raises:
        ValueError: it is none.
        OSError: it cannot be read.
    """
    if file.stat().st_size > MOST_BYTES:
        raise ValueError(f"{file}: expected splits, got {file.stat().st_size} bytes; is it the right file?")
    try:
        return typed(read_json(bounded_bytes(file)), SplitFile, "see viewmend splits --help")
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from None


def split_scenes(file: Path, frames: int | None = None) -> tuple[CaptureScene, ...]:
    """The test scenes of a file: each capture without the camera that it leaves out, all others being looked at.

    Raises:
        ValueError: it is none, or a capture is absent or was calibrated anew.
    """
    found = []
    for scene, path in _scenes_of(file, "test"):
        held = next(one for one in capture_set(path, frames=frames, kind=scene.kind) if one.held == scene.left_out)
        found.append(replace(held, name=f"{scene.name}-{scene.left_out}", set=file.stem))
    if not found:
        raise ValueError(f"{file}: expected a scene for tests, got none; make splits of two subjects or more")
    return tuple(found)


def training_captures(file: Path) -> tuple[tuple[PlainCapture, str], ...]:
    """The captures of a file that are for training, each with the camera that it leaves out, the truth.

    Raises:
        ValueError: it is none, or a capture is absent, cannot be used, or was calibrated anew.
    """
    found = tuple(
        (open_masked(path, held=1, kind=scene.kind), scene.left_out) for scene, path in _scenes_of(file, "training")
    )
    if not found:
        raise ValueError(f"{file}: expected a scene for training, got none; make splits of two subjects or more")
    return found


def _scenes_of(file: Path, split: Literal["training", "test"]) -> Iterator[tuple[SplitScene, Path]]:
    """One part of a file, and where its captures are; ValueError for one that is absent or was calibrated anew."""
    for scene in read_splits(file).scenes:
        if scene.split != split:
            continue
        path = file.parent / scene.path
        if not path.exists():
            raise ValueError(f"{file}: expected the capture {path}, got none; put the file where its paths hold")
        if (now := _calibration_sha256(path, scene.kind)) != scene.calibration_sha256:
            raise ValueError(
                f"{path}: expected the calibration that {file.name} was made with, {scene.calibration_sha256[:12]}, "
                f"got another, {now[:12]}; take that version of the data, or make splits of your own"
            )
        yield scene, path


_PROTOCOL = (
    "No subject is in both splits. Of each scene one camera, left_out, is used for nothing but the truth. "
    "Its view is coloured by the 3 others that are closest in angle at the subject; the hull is of all others."
)


def _scene(path: Path, base: Path, seed: int, subject: str, kind: str | None) -> SplitScene:
    capture = open_capture(path, kind=kind)
    names = capture.cameras.names
    matched = re.search(subject, capture.name)
    if matched is None or not matched.groups() or not matched[1]:
        raise ValueError(
            f"expected a subject by --subject '{subject}' in '{capture.name}', got none; (..) is its group"
        )
    if len(names) < CLOSEST + 1:
        raise ValueError(f"{path}: expected {CLOSEST + 1} cameras or more, got {len(names)}; leave the capture out")
    held = names[_hash(seed, "camera", capture.name) % len(names)]
    others = capture.cameras.select([name for name in names if name != held])
    closest = select_closest(capture.cameras.select([held]), others, _looked_at(capture.cameras), CLOSEST)
    return SplitScene(
        name=capture.name,
        path=os.path.relpath(path.resolve(), base.resolve()),
        kind=kind,
        subject=matched[1],
        split="training",
        left_out=held,
        closest=closest,
        calibration_sha256=_calibration_sha256(path, kind),
    )


def _hash(seed: int, what: str, name: str) -> int:
    return int.from_bytes(hashlib.sha256(f"{seed} {what} {name}".encode()).digest())


def _looked_at(cameras: Cameras) -> torch.Tensor:
    """The point that is nearest to all optical axes, metres."""
    forward = cameras.world_from_camera[:, :3, 2].double()
    across = torch.eye(3, dtype=torch.float64) - forward[:, :, None] * forward[:, None]
    point = torch.linalg.lstsq(across.sum(0), (across @ cameras.centers.double()[:, :, None]).sum(0)).solution
    return point[:, 0].float()


def _calibration_sha256(path: Path, kind: str | None) -> str:
    cameras = read_any_calibration(path, kind).cameras
    told = [[c.name, c.width, c.height, *(n.round(6).tolist() for n in (c.K, c.R, c.t_m, c.dist))] for c in cameras]
    return hashlib.sha256(json.dumps(told).encode()).hexdigest()
