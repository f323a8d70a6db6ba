"""Where novel views are looked at from: orbits, and camera poses from a file."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import torch
from jaxtyping import Float
from msgspec import Meta, Struct
from torch import Tensor

from viewmend.geometry.cameras import Cameras, is_intrinsics
from viewmend.geometry.rigid import invert_rigid, is_rotation
from viewmend.geometry.upright import upright
from viewmend.json_input import Number, Triple, read_json, shown, typed
from viewmend.studio.rigs import orbit

FULL_TURN_GAP_RAD = math.radians(130)
"""A rig with a larger gap between neighbours does not stand all around: the orbit swings over what it sees."""
STATIC_VIEWS = 60
Row4 = tuple[Number, Number, Number, Number]
Matrix4 = tuple[Row4, Row4, Row4, Row4]
Pixels = Annotated[int, Meta(ge=1, le=16384)]
FRAMES_PER_TURN = 150


def orbit_around(
    center: Float[Tensor, "3"], cameras: Cameras, up: Float[Tensor, "3"] | None, views: int, frames_per_turn: int
) -> Cameras:
    """Novel cameras on a circle about `center`, as far and as high as the rig's cameras on average.

    A rig all around is circled once every `frames_per_turn` views; for a rig on one side the path swings from its one
    end to the other and back. Images are as large, and show as much, as the first camera's.

    Args:
        center: the subject's middle, metres.
        cameras: the rig.
        up: the world's up; by default the mean of the images' up directions or, where these disagree (images partly
            upside down), the normal of the plane that the cameras lie in.
        views: how many cameras to give.
        frames_per_turn: length of a whole turn, or of a swing there and back.
    """
    up = upright(cameras) if up is None else up.to(center) / up.norm()
    offsets = cameras.centers - center
    distance = offsets.norm(dim=-1)
    elevation = torch.asin((offsets @ up / distance).clamp(-1, 1)).mean()
    azimuths = _swing(_azimuths(offsets, up), views, frames_per_turn)
    width, height = (int(side) for side in cameras.size_px[0].tolist())
    visible_m = min(width, height) / float(cameras.K[0, 1, 1]) * float(distance.mean())
    return orbit(
        azimuths,
        (width, height),
        radius_m=float(distance.mean()),
        elevation_rad=float(elevation),
        center=center.cpu(),
        up=up.cpu(),
        visible_m=visible_m,
    )


def _azimuths(offsets: Float[Tensor, "view 3"], up: Float[Tensor, "3"]) -> list[float]:
    """Azimuths of the cameras as `orbit` counts them, radians."""
    axes = orbit([0.0, math.pi / 2], (2, 2), radius_m=1.0, elevation_rad=0.0, center=torch.zeros(3), up=up.cpu())
    front, side = axes.centers.to(offsets)
    return torch.atan2(offsets @ side, offsets @ front).tolist()


def _swing(azimuths: Sequence[float], views: int, frames_per_turn: int) -> list[float]:
    """Azimuths of a path over the rig's own, beginning in the middle of its widest gap's far end."""
    ordered = sorted(a % (2 * math.pi) for a in azimuths)
    gaps = [(after - before) % (2 * math.pi) for before, after in zip(ordered, [*ordered[1:], ordered[0]], strict=True)]
    widest = max(range(len(gaps)), key=lambda n: gaps[n])
    start = ordered[(widest + 1) % len(ordered)]
    phases = [view / frames_per_turn for view in range(views)]
    if len(ordered) > 1 and gaps[widest] < FULL_TURN_GAP_RAD:
        return [start + 2 * math.pi * phase for phase in phases]
    arc = (2 * math.pi - gaps[widest]) % (2 * math.pi) if len(ordered) > 1 else math.pi / 6
    return [start + arc * (0.5 - 0.5 * math.cos(2 * math.pi * phase)) for phase in phases]


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
        content = read_json(file.read_bytes())
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
