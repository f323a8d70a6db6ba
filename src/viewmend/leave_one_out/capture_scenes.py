"""Real captures as scenes: every camera is left out in turn, and seen from all the others or from a few."""

import hashlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from viewmend.capture.containers import container_of
from viewmend.capture.formats.recognition import read_any_calibration
from viewmend.capture.plain_format import CALIBRATION
from viewmend.capture.prepare import open_masked, prepare
from viewmend.geometry.cameras import Cameras
from viewmend.leave_one_out.scenes import LeaveOneOut, LeaveOneOutFrame, LeaveOneOutScene


@dataclass(frozen=True, kw_only=True)
class CaptureScene(LeaveOneOutScene):
    """One camera of a capture, left out; a shift that all images share is undone first, as `viewmend mend` does."""

    folder: Path
    inputs: tuple[str, ...]
    """Cameras that are looked at."""
    count: int
    """Frames from the first."""
    fingerprint: str
    """Hash of the capture's files."""
    kind: str | None = None
    """The capture's format, None to recognise it."""

    @property
    def definition(self) -> str:
        """The capture's fingerprint, which cameras, how many frames."""
        return repr((self.fingerprint, self.held, self.inputs, self.count))

    def frames(self, device: str) -> Iterator[LeaveOneOutFrame]:
        """Frames in which the camera that was left out, and at least two of the inputs, have images."""
        capture = prepare(open_masked(self.folder, (*self.inputs, self.held), held=1, kind=self.kind), self.inputs)
        bounds = None if capture.bounds is None else capture.bounds.to(device)
        for time in range(self.count):
            frame = capture.read(time).to(device)
            if self.held in frame.cameras.names and len(frame.cameras) >= 3:
                yield LeaveOneOut({time: frame}, bounds).frame(self.held, time)


def capture_set(
    folder: Path, inputs: str = "all", frames: int | None = None, kind: str | None = None
) -> tuple[CaptureScene, ...]:
    """Every camera of a capture left out in turn.

    Args:
        folder: of the capture.
        inputs: "all" the others are looked at, or a number of cameras, `evenly_around`; where the camera that is left
            out is one of these, the rest.
        frames: how many from the first; None for all.
        kind: the capture's format, None to recognise it.

    Raises:
        CaptureError: the capture cannot be read, has no masks, or too few cameras.
        ValueError: `inputs` or `frames` is no such number.
    """
    capture = open_masked(folder, held=1, kind=kind)
    names = capture.cameras.names
    if inputs != "all" and not (inputs.isdecimal() and 3 <= int(inputs) <= len(names)):
        raise ValueError(f"expected --inputs all or a number from 3 to {len(names)} for {folder}, got '{inputs}'")
    if frames is not None and frames < 1:
        raise ValueError(f"expected --frames of at least 1, got {frames}; leave it away for all")
    looking = names if inputs == "all" else evenly_around(capture.cameras, int(inputs))
    fingerprint, count = _fingerprint(folder, kind), min(frames or len(capture.frame_ids), len(capture.frame_ids))
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
            kind=kind,
        )
        for held in names
    )


def evenly_around(cameras: Cameras, count: int) -> tuple[str, ...]:
    """Names of this many cameras, evenly in the order in which they stand around; the first is the rig's first.

    Camera n of the ordered N is taken for n = floor(i N / count): for a ring, every so manieth.
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


def _fingerprint(folder: Path, kind: str | None) -> str:
    """Changes when the calibration does, or size or time of a file that it names: too many to read them all."""
    is_file = folder.name == CALIBRATION and folder.is_file()
    plain = read_any_calibration(folder.parent if is_file else folder, kind)
    folder = plain.folder
    named = {c.file(stream, frame) for c in plain.cameras for stream in c.streams for frame in plain.frames}
    files = sorted({container_of(folder / name) for name in named})
    stats = [(str(file.relative_to(folder)), file.stat()) for file in files if file.is_file()]
    listed = [(name, stat.st_size, stat.st_mtime_ns) for name, stat in stats]
    calibration = plain.file.read_bytes()
    if plain.file.name != CALIBRATION:  # there may be other files beside this one
        calibration = repr([(c.name, *(n.tolist() for n in (c.K, c.R, c.t_m, c.dist))) for c in plain.cameras]).encode()
    return hashlib.sha256(calibration + repr(listed).encode()).hexdigest()
