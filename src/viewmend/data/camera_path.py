"""Camera paths: reading poses from a JSON file, turntables, and pairing poses with frames."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import torch
from jaxtyping import Float64
from msgspec import Meta, Struct

from viewmend.geometry.cameras import ROUNDING, Cameras, is_intrinsics
from viewmend.geometry.rigid import invert_rigid, is_rotation
from viewmend.utils.untrusted_input import Number, Triple, bounded_bytes, one_of, read_json, shown, typed

Row4 = tuple[Number, Number, Number, Number]
Matrix4 = tuple[Row4, Row4, Row4, Row4]
Pixels = Annotated[int, Meta(ge=2, le=16384)]

STATIC_VIEWS = 60
"""A turntable has at least this many views by default."""
STATIC_FPS = 15.0
"""Turntables and scenes of a capture without a frame rate have this many frames per second."""


class PathFile(Struct, frozen=True):
    """A file of camera poses."""

    world_from_camera: Annotated[tuple[Matrix4, ...], Meta(min_length=1)]
    K: tuple[Triple, Triple, Triple] | None = None
    width: Pixels | None = None
    height: Pixels | None = None
    times: tuple[Annotated[int, Meta(ge=0)], ...] | None = None
    """Index of the capture's frame that each pose shows."""
    fps: Annotated[float, Meta(ge=1, le=240)] | None = None
    """Poses per second of the film."""

    def __post_init__(self) -> None:
        poses = torch.tensor(self.world_from_camera)
        good = is_rotation(poses[:, :3, :3]) & ((poses[:, 3] - torch.eye(4)[3]).abs() <= ROUNDING).all(-1)
        if not bool(good.all()):
            pose = int((~good).nonzero()[0])
            expected = "a rotation and translation with the last row 0 0 0 1"
            next_step = "write rigid motions world_from_camera"
            raise ValueError(f"pose {pose}: expected {expected}, got another matrix; {next_step}")
        if self.K is not None and not is_intrinsics(self.K):
            expected = "[[fx, skew, cx], [0, fy, cy], [0, 0, 1]] with fx and fy above 0"
            raise ValueError(f"expected 'K' as {expected}, got {shown(self.K)}; correct it")
        if (self.width is None) != (self.height is None):
            raise ValueError("expected both 'width' and 'height', got one of them; write both or neither")
        if self.times is not None and len(self.times) != len(self.world_from_camera):
            got = f"{len(self.times)} for {len(self.world_from_camera)} poses"
            raise ValueError(
                f"expected one of 'times' for each pose, got {got}; correct them or leave them out"
            )


@dataclass(frozen=True)
class CameraPath:
    """The cameras of a file of poses, with what the file says of frames and rate."""

    cameras: Cameras
    times: tuple[int, ...] | None
    """Index of the frame that each camera shows; None if the file does not say."""
    fps: float | None
    """Views per second of the film; None if the file does not say."""


def read_camera_path(
    file: Path,
    like: Cameras,
    origin_m: Float64[np.ndarray, "3"] | None = None,
    full_size_px: tuple[int, int] | None = None,
) -> CameraPath:
    """Read camera poses from a JSON file, with the intrinsics and image size of the first camera of `like`.

    The file holds a list of 4 x 4 matrices world_from_camera (metres, OpenCV axes), or an object with that
    list as "world_from_camera" and optionally "K" (3 x 3, pixels, first pixel centre at 0.5), "width" and
    "height", "times" (the frame of each pose) and "fps". `origin_m` is the origin of `like` in the
    coordinates of the capture's files (`origin_of`). Poses that are nearer to it than to 0 are taken to be
    in those coordinates. `full_size_px` is the size of the first camera's images if those of `like` are
    reduced: what the file says of intrinsics and size is for unreduced images, and views are reduced if it
    says no size. ValueError if the file has other content.
    """
    try:
        content = read_json(bounded_bytes(file))
        path: PathFile = typed(
            content if isinstance(content, dict) else {"world_from_camera": content}, PathFile
        )
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from None
    except OSError as error:
        raise ValueError(
            f"{file}: expected a file with camera poses, got: {error.strerror}; check --path"
        ) from error
    poses = torch.tensor(path.world_from_camera, dtype=torch.float64)
    positions = poses[:, :3, 3]
    if origin_m is not None:
        moved = positions - torch.from_numpy(origin_m)
        if float(moved.norm(dim=-1).mean()) < float(positions.norm(dim=-1).mean()):
            poses[:, :3, 3] = moved
    poses = poses.float()
    first = like[0]
    reduced = full_size_px is not None and (path.K is not None or path.width is not None)
    full = first.resized(*full_size_px) if full_size_px is not None and reduced else first
    count = len(poses)
    K = full.K.cpu() if path.K is None else torch.tensor([path.K])
    size = full.size_px.cpu() if path.width is None else torch.tensor([[path.width, path.height]])
    names = tuple(f"view{n:03d}" for n in range(count))
    cameras = Cameras(names, K.repeat(count, 1, 1), invert_rigid(poses), size.repeat(count, 1))
    if reduced and path.width is None:
        cameras = cameras.resized(*first.max_size_px)
    return CameraPath(cameras, path.times, path.fps)


class Turntable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How a view circles the subject."""

    arc: Annotated[float, Meta(ge=1, le=360)] | None = None
    """Degrees to swing over; 360 is a whole turn. None: what the rig covers."""
    seconds: Annotated[float, Meta(gt=0, le=600)] | None = None
    """None: as long as the motion, and `STATIC_VIEWS` views at least."""
    fps: Annotated[float, Meta(ge=1, le=240)] | None = None
    """None: the capture's."""
    loop: Annotated[str, one_of("bounce", "repeat")] = "bounce"
    """How a motion that is shorter than the turntable goes on: back and forth, or from its start."""
    size: Annotated[str, Meta(pattern=r"^[1-9]\d{1,3}x[1-9]\d{1,3}\Z")] | None = None
    """WIDTHxHEIGHT in pixels; None: the first camera's."""
    background: Literal["black", "white"] | None = None
    """None: the model's."""

    @property
    def size_px(self) -> tuple[int, int] | None:
        """Width and height."""
        width, _, height = (self.size or "").partition("x")
        return (int(width), int(height)) if width else None

    def times(self, recorded: Sequence[int], fps: float | None) -> list[int]:
        """The frame of each view, from those of a capture with this rate."""
        own_fps = fps or STATIC_FPS
        rate = self.fps or own_fps
        last = len(recorded) - 1
        views = max(STATIC_VIEWS, round(len(recorded) / own_fps * rate))
        if self.seconds is not None:
            views = max(1, round(self.seconds * rate))
        steps = [int(view * own_fps / rate + 1e-6) for view in range(views)]
        if self.loop == "repeat" or last == 0:
            return [recorded[step % (last + 1)] for step in steps]
        return [recorded[last - abs(last - step % (2 * last))] for step in steps]


def parse_turntable(text: str) -> Turntable | None:
    """A turntable from "orbit" or "orbit:arc=180,seconds=6"; None for other text. ValueError if a value is wrong."""
    word, _, values = text.partition(":")
    if word != "orbit":
        return None
    pairs = [pair.partition("=") for pair in values.split(",") if pair.strip()]
    given = {key.strip(): value.strip() for key, _, value in pairs}
    try:
        return typed(given, Turntable, "as in orbit:arc=180,seconds=6,fps=30,size=1280x720", strict=False)
    except ValueError as error:
        raise ValueError(f"--path {text}: {error}") from None


def pair_with_frames(path: CameraPath, times: Sequence[int]) -> list[tuple[int, Cameras]]:
    """The frame and the camera of each view of a film of the frames `times`.

    A single frame is shown from every pose. Of several, each pose shows the frame that the file says or, if
    it does not say, each frame is shown from its own pose or a single one. ValueError for other counts, or
    if the file names other frames.
    """
    cameras = path.cameras
    if len(times) == 1:
        return [(times[0], cameras[n]) for n in range(len(cameras))]
    if path.times is not None:
        others = sorted(set(path.times) - set(times))
        if others:
            expected = f"'times' of the path among {len(times)} frames ({times[0]} to {times[-1]})"
            raise ValueError(
                f"expected {expected}, got {others[0]}; choose frames with --frames, or a single one for all poses"
            )
        return [(time, cameras[n]) for n, time in enumerate(path.times)]
    if len(cameras) not in (1, len(times)):
        expected = f"one pose or one per frame ({len(times)} frames)"
        raise ValueError(f"expected {expected}, got {len(cameras)} poses; choose frames with --frames")
    return [(time, cameras[n if len(cameras) > 1 else 0]) for n, time in enumerate(times)]
