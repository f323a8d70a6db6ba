"""Real captures as scenes with one held-out camera each, seen from all other cameras or from a few; and split files."""

import hashlib
import json
import math
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import torch
from msgspec import Meta, Struct, structs

from viewmend.data.capture_folder import CaptureFolder, open_capture, with_frames
from viewmend.data.containers import container_of
from viewmend.data.formats import read_any_calibration
from viewmend.data.native_format import CALIBRATION
from viewmend.data.prepare import open_masked, prepare
from viewmend.geometry.cameras import Cameras
from viewmend.rendering.view import select_closest
from viewmend.scenes.held_out import LeaveOneOut, LeaveOneOutFrame, LeaveOneOutScene
from viewmend.utils.untrusted_input import bounded_bytes, read_json, typed

FORMAT = "viewmend-splits/1"
"""Name and version of the file of splits."""
CLOSEST = 3
"""Number of source cameras that colour the view of a held-out camera."""
_PROTOCOL = (
    "No subject is in both splits. Of each scene one camera, left_out, is used for nothing but the truth. "
    "Its view is coloured by the 3 others that are closest in angle at the subject; the hull is of all others."
)
"""Explains the file of splits to those who read it without this program."""


@dataclass(frozen=True, kw_only=True)
class CaptureScene(LeaveOneOutScene):
    """One held-out camera of a capture, which is prepared as in `viewmend mend`."""

    folder: Path
    inputs: tuple[str, ...]
    count: int
    """Frames from the first."""
    fingerprint: str
    """Hash of the capture's files."""
    format: str | None = None
    """The capture's format, None to recognise it."""
    align: bool = True
    """Whether a common shift of all images is undone (`prepare`)."""
    match_colours: bool = True
    """Whether the cameras' colours are matched (`prepare`)."""
    tighten_masks: bool = True
    """Whether loose masks of the input cameras are tightened (`prepare`)."""

    @property
    def definition(self) -> str:
        """The capture's fingerprint, which cameras, how many frames, and how they are prepared."""
        prepared = [name for name in ("align", "match_colours") if not getattr(self, name)]
        if self.tighten_masks:
            prepared.append("tighten_masks")
        return repr((self.fingerprint, self.held, self.inputs, self.count, *prepared))

    def frames(self) -> Iterator[LeaveOneOutFrame]:
        """Frames with a subject in which the camera that was left out, and at least two of the inputs, have images."""
        opened = open_masked(self.folder, (*self.inputs, self.held), held=1, format=self.format)
        capture = prepare(
            opened,
            self.inputs,
            align=self.align,
            match_colours=self.match_colours,
            tighten_masks=self.tighten_masks,
        )
        for time in range(self.count):
            frame = capture.read(time)
            if self.held in frame.cameras.names and len(frame.cameras) >= 3 and frame.has_subject:
                yield LeaveOneOut({time: frame}, capture.bounds).frame(self.held, time)


def capture_set(
    folder: Path, inputs: str = "all", frames: int | None = None, format: str | None = None
) -> tuple[CaptureScene, ...]:
    """Every camera of a capture left out in turn.

    `inputs` are "all" others, or a number of cameras, chosen by `evenly_around`, without the
    held-out one. `frames` is how many from the first, `format` the capture's, None to recognise it.
    CaptureError if the capture cannot be read, or has no masks or too few cameras; ValueError if
    `inputs` or `frames` is no such number.
    """
    capture = open_masked(folder, held=1, format=format)
    names = capture.cameras.names
    if inputs != "all" and not (inputs.isdecimal() and 3 <= int(inputs) <= len(names)):
        raise ValueError(
            f"expected --inputs all or a number from 3 to {len(names)} for {folder}, got '{inputs}'"
        )
    if frames is not None and frames < 1:
        raise ValueError(f"expected --frames of at least 1, got {frames}; omit it for all")
    looking = names if inputs == "all" else evenly_around(capture.cameras, int(inputs))
    fingerprint = _fingerprint(folder, format)
    count = min(frames or len(capture.frame_ids), len(capture.frame_ids))
    return tuple(
        CaptureScene(
            name=f"{capture.name}-{held}-from-{inputs}",
            set=f"{capture.name} from {inputs}",
            rig=f"{inputs} of {len(names)}",
            style="capture",
            folder=folder,
            held=held,
            inputs=tuple(name for name in looking if name != held),
            count=count,
            fingerprint=fingerprint,
            format=format,
        )
        for held in names
    )


def evenly_around(cameras: Cameras, count: int) -> tuple[str, ...]:
    """Names of this many cameras, evenly in the order in which they stand around; the first is the rig's first.

    Camera n of the ordered N is taken for n = floor(i N / count): for a ring, every k-th.
    """
    eyes = (cameras.centers - cameras.centers.mean(0)).double()
    first, second = torch.linalg.svd(eyes, full_matrices=False).Vh[:2]  # the plane that the cameras stand in
    turn = 2 * math.pi
    angle = torch.atan2(eyes @ second, eyes @ first)
    around = (angle - angle[0]) % turn
    if float(around[1]) > turn / 2:  # the way around in which names go up
        around = (turn - around) % turn
    order: Sequence[int] = around.argsort(stable=True).tolist()
    return tuple(cameras.names[order[i * len(order) // count]] for i in range(count))


def _fingerprint(folder: Path, format: str | None) -> str:
    """Changes when the calibration does, or size or time of a file that it names: too many to read them all."""
    plain = read_any_calibration(folder, format)
    plain = with_frames(plain, plain.cameras)
    folder = plain.folder
    named = {
        c.file(stream, frame) for c in plain.cameras for stream in c.file_kinds for frame in plain.frames
    }
    files = sorted({container_of(folder / name) for name in named})
    stats = [(str(file.relative_to(folder)), file.stat()) for file in files if file.is_file()]
    listed = [(name, stat.st_size, stat.st_mtime_ns) for name, stat in stats]
    calibration = plain.file.read_bytes()
    if plain.file.name != CALIBRATION:  # there may be other files in the folder
        arrays = [plain.bounds_m, plain.origin_m]
        arrays += [value for c in plain.cameras for value in (c.K, c.R, c.t_m, c.dist, c.colour)]
        plain_values = [None if value is None else np.asarray(value).tolist() for value in arrays]
        cameras = [(c.name, c.width, c.height, c.mask_labels, c.offset_ms) for c in plain.cameras]
        calibration = repr((plain_values, cameras)).encode()
    return hashlib.sha256(calibration + repr(listed).encode()).hexdigest()


class SplitScene(Struct, frozen=True, kw_only=True):
    """One capture of the file's `scenes`."""

    name: str
    path: Annotated[str, Meta(min_length=1)]
    """Where the capture is, relative to the file's folder."""
    format: str | None = None
    subject: str
    split: Literal["training", "test"]
    left_out: str
    closest: tuple[str, ...]
    """The three others closest to it, in angle at the point that all cameras look at, nearest first.

    Indicative: the renderer chooses again in each frame, by the angle at the hull's centre.
    """
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
    test_fraction: float = 7 / 79,
    scenes: int | None = None,
    subject: str = "(.*)",
    format: str | None = None,
) -> SplitFile:
    """Split captures so that no subject is in both parts, and choose the camera that each leaves out.

    The order of subjects and the cameras follow from hashes of their names and the seed alone: the
    same on every machine, and adding a capture does not change the cameras of the others.
    ValueError for fewer than two subjects, a name without a subject, two scenes of one name, or
    fewer than 4 cameras.
    """
    made = [_scene(path, base, seed, subject, format) for path in captures]
    names = [scene.name for scene in made]
    twice = sorted({name for name in names if names.count(name) > 1})
    if scenes is not None and scenes > len(made):
        raise ValueError(
            f"expected at least the {scenes} captures of --scenes, got {len(made)}; name more captures"
        )
    made = sorted(made, key=lambda one: _hash(seed, "scene", one.name))[:scenes]
    subjects = sorted({scene.subject for scene in made}, key=lambda one: _hash(seed, "subject", one))
    if twice or len(subjects) < 2:
        got = f"{twice[:3]} twice" if twice else f"the subjects {subjects}"
        raise ValueError(
            f"expected captures of different names and of two subjects or more, got {got}; see --subject"
        )
    tested: set[str] = set()
    for one in subjects[:-1]:
        if tested and sum(scene.subject in tested for scene in made) >= test_fraction * len(made) - 1e-9:
            break
        tested.add(one)
    split = [structs.replace(s, split="test" if s.subject in tested else "training") for s in made]
    return SplitFile(
        format=FORMAT, seed=seed, scenes=tuple(sorted(split, key=lambda s: (s.split, s.subject, s.name)))
    )


def splits_json(splits: SplitFile) -> str:
    """The file's text."""
    values = structs.asdict(splits) | {"scenes": [structs.asdict(scene) for scene in splits.scenes]}
    return json.dumps({"format": FORMAT, "protocol": _PROTOCOL, **values}, indent=1) + "\n"


def is_splits(file: Path) -> bool:
    """Whether this is a file of splits, by its beginning."""
    if not file.is_file() or file.suffix != ".json":
        return False
    with file.open("rb") as stream:
        return FORMAT.encode() in stream.read(2048)


def read_splits(file: Path) -> SplitFile:
    """A file that `make_splits` made; ValueError for another, OSError for one that cannot be read."""
    try:
        return typed(read_json(bounded_bytes(file)), SplitFile, "see viewmend splits --help")
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from None


def split_scenes(file: Path, frames: int | None = None) -> tuple[CaptureScene, ...]:
    """Test scenes of a file, with all cameras but one as inputs; ValueError if a capture has changed or is absent."""
    found = []
    for scene, path in _scenes_of(file, "test"):
        held = next(
            one for one in capture_set(path, frames=frames, format=scene.format) if one.held == scene.left_out
        )
        found.append(replace(held, name=f"{scene.name}-{scene.left_out}", set=file.stem))
    return tuple(found)


def training_captures(file: Path) -> tuple[tuple[CaptureFolder, str], ...]:
    """The captures of a file that are for training, each with the camera that it leaves out, the truth.

    ValueError if it is none, or a capture is absent, cannot be used, or was recalibrated.
    """
    scenes = _scenes_of(file, "training")
    return tuple((open_masked(path, held=1, format=scene.format), scene.left_out) for scene, path in scenes)


def _scenes_of(file: Path, split: Literal["training", "test"]) -> Iterator[tuple[SplitScene, Path]]:
    """One part of a file, and where its captures are; ValueError for one that is absent or was recalibrated."""
    scenes = [scene for scene in read_splits(file).scenes if scene.split == split]
    if not scenes:
        raise ValueError(
            f"{file}: expected a scene for {split}, got none; make splits of two subjects or more"
        )
    for scene in scenes:
        path = file.parent / scene.path
        if not path.exists():
            raise ValueError(
                f"{file}: expected the capture {path}, got none; put the file where its paths hold"
            )
        now = _calibration_sha256(path, scene.format)
        if now != scene.calibration_sha256:
            raise ValueError(
                f"{path}: expected the calibration that {file.name} was made with, {scene.calibration_sha256[:12]}, "
                f"got another, {now[:12]}; take that version of the data, or make splits of your own"
            )
        yield scene, path


def _scene(path: Path, base: Path, seed: int, subject: str, format: str | None) -> SplitScene:
    capture = open_capture(path, format=format)
    names = capture.cameras.names
    matched = re.search(subject, capture.name)
    if matched is None or not matched.groups() or not matched[1]:
        expected = f"a subject by --subject '{subject}' in '{capture.name}'"
        raise ValueError(f"expected {expected}, got none; (..) is its group")
    if len(names) < CLOSEST + 1:
        raise ValueError(
            f"{path}: expected {CLOSEST + 1} cameras or more, got {len(names)}; leave the capture out"
        )
    held = names[_hash(seed, "camera", capture.name) % len(names)]
    others = capture.cameras.select([name for name in names if name != held])
    closest = select_closest(capture.cameras.select([held]), others, _looked_at(capture.cameras), CLOSEST)
    return SplitScene(
        name=capture.name,
        path=os.path.relpath(path.resolve(), base.resolve()),
        format=format,
        subject=matched[1],
        split="training",
        left_out=held,
        closest=closest,
        calibration_sha256=_calibration_sha256(path, format),
    )


def _hash(seed: int, what: str, name: str) -> int:
    return int.from_bytes(hashlib.sha256(f"{seed} {what} {name}".encode()).digest())


def _looked_at(cameras: Cameras) -> torch.Tensor:
    """The point that is nearest to all optical axes, metres."""
    forward = cameras.world_from_camera[:, :3, 2].double()
    across = torch.eye(3, dtype=torch.float64) - forward[:, :, None] * forward[:, None]
    point = torch.linalg.lstsq(across.sum(0), (across @ cameras.centers.double()[:, :, None]).sum(0)).solution
    return point[:, 0].float()


def _calibration_sha256(path: Path, format: str | None) -> str:
    cameras = read_any_calibration(path, format).cameras
    values = [
        [c.name, c.width, c.height, *(n.round(6).tolist() for n in (c.K, c.R, c.t_m, c.dist))]
        for c in cameras
    ]
    return hashlib.sha256(json.dumps(values).encode()).hexdigest()
