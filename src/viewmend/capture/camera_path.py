"""Camera poses from a file, and which frame is looked at from which."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import torch
from msgspec import Meta, Struct

from viewmend.foreign_input import bounded_bytes
from viewmend.geometry.cameras import Cameras, is_intrinsics
from viewmend.geometry.rigid import invert_rigid, is_rotation
from viewmend.json_input import Number, Triple, read_json, shown, typed

Row4 = tuple[Number, Number, Number, Number]
Matrix4 = tuple[Row4, Row4, Row4, Row4]
Pixels = Annotated[int, Meta(ge=1, le=16384)]


class PathFile(Struct, frozen=True):
    """A file of camera poses."""

    world_from_camera: Annotated[tuple[Matrix4, ...], Meta(min_length=1)]
    K: tuple[Triple, Triple, Triple] | None = None
    width: Pixels | None = None
    height: Pixels | None = None

    def __post_init__(self) -> None:
        poses = torch.tensor(self.world_from_camera)
        good = is_rotation(poses[:, :3, :3]) & (poses[:, 3] == torch.tensor([0.0, 0.0, 0.0, 1.0])).all(-1)
        if not bool(good.all()):
            raise ValueError(
                f"pose {int((~good).nonzero()[0])}: expected a rotation above a last row of 0 0 0 1, got another "
                "matrix; give rigid motions world_from_camera"
            )
        if self.K is not None and not bool(is_intrinsics(torch.tensor(self.K))):
            expected = "[[fx, skew, cx], [0, fy, cy], [0, 0, 1]] with fx and fy above 0"
            raise ValueError(f"expected 'K' as {expected}, got {shown(self.K)}; correct it")
        if (self.width is None) != (self.height is None):
            raise ValueError("expected 'width' and 'height', got one of them; give both sides or none")


def read_path(file: Path, like: Cameras) -> Cameras:
    """Camera poses from a JSON file, with the intrinsics and image size of the first camera of `like`.

    The file holds a list of 4x4 matrices world_from_camera (metres, OpenCV axes), or an object with that list as
    "world_from_camera" and, if wanted, "K" (3x3, pixels, the top-left pixel's centre at 0.5), "width" and "height".

    Raises:
        ValueError: the file does not hold that; says what and where.
    """
    try:
        content = read_json(bounded_bytes(file))
        given: PathFile = typed(content if isinstance(content, dict) else {"world_from_camera": content}, PathFile)
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from None
    except OSError as error:
        raise ValueError(f"{file}: expected a file with camera poses, got: {error.strerror}; check --path") from error
    poses, first, count = torch.tensor(given.world_from_camera), like[0], len(given.world_from_camera)
    K = first.K.cpu() if given.K is None else torch.tensor([given.K])
    size = first.size_px.cpu() if given.width is None else torch.tensor([[given.width, given.height]])
    names = tuple(f"view{n:03d}" for n in range(count))
    return Cameras(names, K.repeat(count, 1, 1), invert_rigid(poses), size.repeat(count, 1))


def paired(path: Cameras, times: Sequence[int]) -> list[tuple[int, Cameras]]:
    """Which time is looked at from where: one time from every pose, or every time from its own or the only pose.

    Raises:
        ValueError: several times and another number of poses.
    """
    if len(times) == 1:
        return [(times[0], path[n]) for n in range(len(path))]
    if len(path) not in (1, len(times)):
        raise ValueError(
            f"expected one pose or one for each of {len(times)} frames, got {len(path)}; choose frames with --frames"
        )
    return [(time, path[n if len(path) > 1 else 0]) for n, time in enumerate(times)]
