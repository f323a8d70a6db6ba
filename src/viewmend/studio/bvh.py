"""BVH motions: the skeleton's rest pose and its joints' rotations, frame by frame."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from viewmend.data.errors import CaptureError

CHANNELS = frozenset(f"{axis}{kind}" for axis in "xyz" for kind in ("position", "rotation"))
MAX_TRANSFORMS = 5_000_000
"""Frames x joints."""


@dataclass(frozen=True)
class Motion:
    """A skeleton in motion. Lengths are the file's; column vectors; all rotations are identity in the rest pose."""

    names: tuple[str, ...]
    parents: tuple[int, ...]
    """-1 for the root, which comes first; parents come before their children."""
    rest: Float[Tensor, "joint 3"]
    """Rest positions of the joints relative to the root."""
    rotations: Float[Tensor, "frame joint 3 3"]
    """Global rotations G."""
    root: Float[Tensor, "frame 3"]
    """World positions of the root."""
    seconds_per_frame: float

    @property
    def duration_s(self) -> float:
        """Time from the first frame to the last."""
        return (len(self.root) - 1) * self.seconds_per_frame


@dataclass
class _Joint:
    name: str
    parent: int
    offset: tuple[float, ...] = (0.0, 0.0, 0.0)
    channels: tuple[str, ...] = ()


def read_bvh(path: Path) -> Motion:
    """Read a BVH file: one skeleton, any channels in any order (position channels count at the root alone).

    Raises:
        CaptureError: missing, no BVH, or its numbers do not match its channels and frames.
    """
    try:
        text = path.read_text(errors="replace")
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    head, found, body = text.partition("MOTION")
    if not found or "HIERARCHY" not in head:
        raise CaptureError(f"{path}: expected a BVH file with HIERARCHY and MOTION; export the motion as BVH")
    joints = _hierarchy(path, head)
    step, values = _frames(path, body, sum(len(j.channels) for j in joints))
    if len(values) * len(joints) > MAX_TRANSFORMS:
        raise CaptureError(
            f"{path}: expected at most {MAX_TRANSFORMS} frames x joints, got {len(values)} x {len(joints)}; cut it"
        )
    return _motion(joints, step, values)


def _hierarchy(path: Path, text: str) -> list[_Joint]:
    joints: list[_Joint] = []
    inside = [-1]  # the joints whose braces are open
    tokens = iter(text.split())
    try:
        for token in tokens:
            match token.upper():
                case "ROOT" | "JOINT":
                    joints.append(_Joint(next(tokens), inside[-1]))
                case "END":
                    next(tokens)
                    joints.append(_Joint("", inside[-1]))
                case "{":
                    inside.append(len(joints) - 1)
                case "}":
                    inside.pop()
                case "OFFSET":
                    joints[-1].offset = tuple([float(next(tokens)) for _ in range(3)])
                case "CHANNELS":
                    count = int(next(tokens))
                    words = [next(tokens) for _ in range(count)]
                    joints[-1].channels = tuple(word.lower() for word in words)
                    if len(words) != count or not CHANNELS.issuperset(joints[-1].channels):
                        known = ", ".join(sorted(CHANNELS))
                        got = " ".join(words)[:80]
                        raise ValueError(f"expected {count} channels among {known}, got {got}")
    except (IndexError, ValueError, StopIteration) as error:
        reason = f"{error}" or "it is cut short"
        raise CaptureError(f"{path}: its HIERARCHY breaks off ({reason}); export it again") from error
    roots = sum(j.parent < 0 for j in joints)
    if roots != 1:
        raise CaptureError(f"{path}: expected one ROOT, found {roots}; export one skeleton")
    if not all(abs(x) < 1e9 for j in joints for x in j.offset):
        raise CaptureError(
            f"{path}: expected three finite numbers after each OFFSET, got others; export it again"
        )
    return joints


def _frames(path: Path, body: str, channels: int) -> tuple[float, np.ndarray]:
    """Seconds per frame and the table of channel values, (frame, channel)."""
    lines = body.strip().splitlines()
    try:
        count = int(lines[0].split(":")[1])
        step = float(lines[1].split(":")[1])
        values = np.array(" ".join(lines[2:]).split(), dtype=np.float64)
    except (IndexError, ValueError) as error:
        expected = f"expected 'Frames:', 'Frame Time:' and numbers ({error})"
        raise CaptureError(f"{path}: {expected}; export it again") from error
    fits = channels >= 1 and values.size == count * channels and bool((np.abs(values) < 1e9).all())
    if count < 1 or not 0 < step < 1e6 or not fits:
        raise CaptureError(
            f"{path}: expected {count} frames of {channels} finite numbers at a positive frame time, got "
            f"{values.size} numbers at {step} s; the file is cut short or damaged, export it again"
        )
    return step, values.reshape(count, channels)


def _motion(joints: list[_Joint], step: float, values: np.ndarray) -> Motion:
    frames = len(values)
    count = len(joints)
    rotations = np.zeros((frames, count, 3, 3))
    rest = np.zeros((count, 3))
    root = np.tile(np.array(joints[0].offset), (frames, 1))
    column = 0
    for n, joint in enumerate(joints):
        local = np.tile(np.eye(3), (frames, 1, 1))
        for channel in joint.channels:
            axis = "xyz".index(channel[0])
            if channel.endswith("rotation"):
                angle = np.deg2rad(values[:, column])
                a = (axis + 1) % 3
                b = (axis + 2) % 3
                turn = np.tile(np.eye(3), (frames, 1, 1))
                turn[:, a, a] = turn[:, b, b] = np.cos(angle)
                turn[:, b, a] = np.sin(angle)
                turn[:, a, b] = -turn[:, b, a]
                local = local @ turn
            elif n == 0:
                root[:, axis] = values[:, column]
            column += 1
        rotations[:, n] = local if joint.parent < 0 else rotations[:, joint.parent] @ local
        rest[n] = 0 if joint.parent < 0 else rest[joint.parent] + np.array(joint.offset)
    return Motion(
        tuple(j.name for j in joints),
        tuple(j.parent for j in joints),
        torch.from_numpy(rest.astype(np.float32)),
        torch.from_numpy(rotations.astype(np.float32)),
        torch.from_numpy(root.astype(np.float32)),
        step,
    )
