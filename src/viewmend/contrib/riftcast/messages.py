"""RIFTCast's messages (protocol 1.3) as bytes: lengths and counts are big-endian, heads and matrices little-endian.

A message is four bytes of length, then a head of 8 bytes: major and minor version and what it is about. Matrices are
OpenGL's, column by column: cameras look along -z, and depth is what a projection makes of it.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt16
from torch import Tensor

from viewmend.data.formats.riftcast import FLIP
from viewmend.geometry.cameras import Cameras
from viewmend.live.protocol import Camera, ProtocolError

MAJOR, MINOR = 1, 3
REQUEST_IMAGE, NO_UPDATE, UPDATE, CAMERA_DATA = 3, 4, 5, 10
HEAD = struct.Struct("<HHi")
LARGEST = 4096
"""Bytes of a message that a client may send; a request has 152."""
STEPS_PER_M = 5000
"""Depth is sent in fifths of a millimetre."""
BACKGROUND_M = 10.0
"""Depth of what shows no subject: farther than clients draw."""
NEAR_M, FAR_M = 0.01, 10.0
"""Projections that are sent reach from here to there."""


@dataclass(frozen=True)
class ImageRequest:
    """A picture that is asked for."""

    width: int
    height: int
    camera: Camera
    world_from_clip: bytes
    """The inverse of projection times view: goes back with the picture, so that its pixels find their places."""


def parse(message: bytes) -> ImageRequest | int:
    """What a client says: a request of a picture, or the number of another one without a body.

    Raises:
        ProtocolError: it is of another version, broken off, or asks for a view that is none.
    """
    if len(message) < HEAD.size:
        raise ProtocolError(f"expected a head of {HEAD.size} bytes, got {len(message)}")
    major, _, task = HEAD.unpack_from(message)
    if major != MAJOR:
        raise ProtocolError(f"expected RIFTCast's protocol {MAJOR}.{MINOR}, got version {major}; update the client")
    if task != REQUEST_IMAGE:
        return task
    body = message[HEAD.size :]
    if len(body) < 144:
        raise ProtocolError(f"expected a request of 144 bytes, got {len(body)}")
    width, height, view_bytes = struct.unpack_from(">III", body)
    (projection_bytes,) = struct.unpack_from(">I", body, 76)
    if (view_bytes, projection_bytes) != (64, 64):
        raise ProtocolError(f"expected two matrices of 64 bytes, got {view_bytes} and {projection_bytes}")
    with np.errstate(all="ignore"):  # what comes of odd numbers is looked at
        view, projection = (np.frombuffer(body, "<f4", 16, at).reshape(4, 4).T.astype(float) for at in (12, 80))
        camera = camera_of(view, projection, width, height)
        return ImageRequest(width, height, camera, _inverse(projection @ view))


def camera_of(view: Float[np.ndarray, "4 4"], projection: Float[np.ndarray, "4 4"], width: int, height: int) -> Camera:
    """OpenGL's matrices as a camera of ours, for pictures of this size.

    Raises:
        ProtocolError: they are not finite, the view is no rigid motion, or the projection no perspective.
    """
    if not (np.isfinite(view).all() and np.isfinite(projection).all() and np.abs(view).max() < 1e4):
        raise ProtocolError("expected matrices of finite numbers, got others")
    pose, P = FLIP @ view, projection
    fx, fy = float(P[0, 0] * width / 2), float(P[1, 1] * height / 2)
    if P[3, 2] != -1 or not (1 <= fx <= 1e6 and 1 <= fy <= 1e6):
        raise ProtocolError("expected a perspective projection, got another; see docs/guide/riftcast.md")
    cx, cy = float((1 - P[0, 2]) * width / 2), float((1 + P[1, 2]) * height / 2)
    if max(abs(cx), abs(cy)) > 1e5:
        raise ProtocolError("expected a frustum around the viewing direction, got one far off axis")
    R, T = tuple(pose[:3, :3].flatten().tolist()), tuple(pose[:3, 3].tolist())
    return Camera(R=R, T=T, fx=fx, fy=fy, cx=cx, cy=cy)


def _inverse(matrix: Float[np.ndarray, "4 4"]) -> bytes:
    try:
        inverse = np.linalg.inv(matrix).astype("<f4")
    except np.linalg.LinAlgError:
        inverse = np.full((4, 4), np.nan)
    if not np.isfinite(inverse).all():
        raise ProtocolError("expected a projection that can be undone, got another")
    return inverse.T.tobytes()


def update(request: ImageRequest, jpeg: bytes, depth: Float[Tensor, "height width"]) -> bytes:
    """A picture that was asked for, upright, and its depth, bottom-up and packed by Zstandard.

    Args:
        request: which it answers.
        jpeg: the picture.
        depth: z-depth, metres; 0 where nothing is shown.
    """
    import zstandard

    packed = zstandard.ZstdCompressor(level=1).compress(depth_steps(depth).tobytes())
    return _head(UPDATE) + b"".join(struct.pack(">I", len(p)) + p for p in (request.world_from_clip, jpeg, packed))


def depth_steps(depth: Float[Tensor, "height width"]) -> UInt16[np.ndarray, "height width"]:
    """Depth in steps, the bottom row first; clients take numbers from 32768 on for nothing."""
    z = depth.double().cpu().numpy()[::-1]
    steps = np.rint(np.where(z > 0, np.minimum(z, BACKGROUND_M), BACKGROUND_M) * STEPS_PER_M)
    return np.ascontiguousarray(steps, dtype="<u2")


def no_update() -> bytes:
    """There is no new picture yet."""
    return _head(NO_UPDATE)


def camera_data(cameras: Cameras) -> bytes:
    """The rig: all views' matrices, then all projections'."""
    views = [_columns(FLIP @ pose.double().cpu().numpy()) for pose in cameras.camera_from_world]
    projections = [
        _columns(_projection(K.double().cpu().numpy(), *size))
        for K, size in zip(cameras.K, cameras.size_px.tolist(), strict=True)
    ]
    return _head(CAMERA_DATA) + _blob(views) + _blob(projections)


def _projection(K: Float[np.ndarray, "3 3"], width: int, height: int) -> Float[np.ndarray, "4 4"]:
    P = np.zeros((4, 4))
    P[0, 0], P[1, 1] = 2 * K[0, 0] / width, 2 * K[1, 1] / height
    P[0, 1] = -2 * K[0, 1] / width
    P[0, 2], P[1, 2] = 1 - 2 * K[0, 2] / width, 2 * K[1, 2] / height - 1
    P[2, 2], P[2, 3] = (FAR_M + NEAR_M) / (NEAR_M - FAR_M), 2 * FAR_M * NEAR_M / (NEAR_M - FAR_M)
    P[3, 2] = -1
    return P


def _columns(matrix: Float[np.ndarray, "4 4"]) -> bytes:
    return matrix.T.astype("<f4").tobytes()


def _blob(parts: Sequence[bytes]) -> bytes:
    return struct.pack(">I", sum(map(len, parts))) + b"".join(parts)


def _head(task: int) -> bytes:
    return HEAD.pack(MAJOR, MINOR, task)


def framed(message: bytes) -> bytes:
    """The message with its length before it."""
    return struct.pack(">I", len(message)) + message
