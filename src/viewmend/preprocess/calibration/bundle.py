"""Cameras from the corners of a board that was moved about: each camera by itself, then all together.

OpenCV calibrates each camera first; cameras are chained by the times at which two of them see the
board. The bundle adjustment then moves all cameras and all poses of the board until corners lie
where they were found (Triggs et al., "Bundle adjustment: a modern synthesis", 2000). World is the
first camera's frame.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float64, UInt8
from scipy.optimize import least_squares
from scipy.sparse import lil_matrix
from scipy.spatial.transform import Rotation

from viewmend.data.native_format import NativeCalibration, NativeCamera
from viewmend.geometry.cameras import Cameras
from viewmend.preprocess.calibration.board import Board, Corners
from viewmend.utils.contact_sheet import Tile, contact_sheet, in_rows

LEAST_VIEWS = 5
"""Images of the board that a camera needs."""
MOST_VIEWS = 40
"""Images used for the first calibration of a camera; the adjustment uses all."""
CAMERA = 12
"""A camera has this many parameters: fx, fy, cx, cy, k1, k2, rotation and translation."""
POSE = 6
"""The board's pose at one time has this many parameters: rotation and translation."""
OUTLIER_PX = 0.3
"""Residuals above this count less: corners of boards that are seen aslant are found less well."""
CENTRE_PX = 0.05
"""The principal point is expected in the middle, to this share of the image's size; a weak prior."""
STEPS = 60

Seen = Mapping[tuple[int, int], Corners]
"""What was found, by camera and time."""
Size = tuple[int, int]
Matrix = Float64[np.ndarray, "3 3"]
Distortion = Float64[np.ndarray, "5"]
Pose = Float64[np.ndarray, "4 4"]
Picture = UInt8[np.ndarray, "height width 3"]
ENLARGED = 100
"""Scale at which residuals are drawn."""
TILE_PX = 480


@dataclass(frozen=True)
class CalibratedCamera:
    """One camera, and what its calibration misses."""

    K: Matrix
    """Pixels; the top-left pixel has its centre at (0.5, 0.5)."""
    dist: Distortion
    """k1 k2 0 0 0 of Brown and Conrady."""
    camera_from_world: Pose
    corners: Float64[np.ndarray, "corner 2"]
    """Where corners were found, pixels."""
    off: Float64[np.ndarray, "corner 2"]
    """Residuals in pixels: projections of the corners minus where they were found."""

    @property
    def rms_px(self) -> float:
        """Root mean square distance of the corners."""
        return float(np.sqrt((self.off**2).sum(1).mean()))


def calibrate(
    seen: Seen, board: Board, names: Sequence[str], sizes: Sequence[Size]
) -> list[CalibratedCamera]:
    """The cameras of these names and image sizes (width, height) from what they saw of the board.

    ValueError if a camera saw the board too seldom, or never together with the others.
    """
    alone = [_alone(seen, board, view, name, sizes[view]) for view, name in enumerate(names)]
    poses = {key: _board_pose(corners, board, *alone[key[0]]) for key, corners in seen.items()}
    cameras = _chained(poses, names)
    times = sorted({time for _, time in seen})
    start = [
        np.concatenate([K[[0, 1, 0, 1], [0, 1, 2, 2]], dist[:2], _vector(cameras[view])])
        for view, (K, dist) in enumerate(alone)
    ]
    for time in times:
        view = max((v for v, t in seen if t == time), key=lambda v: len(seen[v, time].ids))
        start.append(_vector(np.linalg.inv(cameras[view]) @ poses[view, time]))
    rows = _Rows(seen, board, sizes, times)
    found = least_squares(
        rows.residuals,
        np.concatenate(start),
        jac_sparsity=rows.sparsity(),
        x_scale="jac",
        loss="soft_l1",
        f_scale=OUTLIER_PX,
        max_nfev=STEPS,
    )
    return rows.cameras(found.x)


def _alone(seen: Seen, board: Board, view: int, name: str, size: Size) -> tuple[Matrix, Distortion]:
    own = sorted((corners for (v, _), corners in seen.items() if v == view), key=lambda c: -len(c.ids))
    if len(own) < LEAST_VIEWS:
        raise ValueError(
            f"camera '{name}': expected the board in {LEAST_VIEWS} images or more, found it in {len(own)}; check "
            "--board and --dictionary, show it larger, sharper and tilted, or look at more frames (--every 1)"
        )
    own = own[:: max(1, len(own) // MOST_VIEWS)][:MOST_VIEWS]
    points = [board.corners_m[c.ids].astype(np.float32)[None] for c in own]
    pixels = [c.pixels.astype(np.float32)[None] for c in own]
    flags = cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K3
    _, K, dist, *_ = cv2.calibrateCamera(points, pixels, size, None, None, flags=flags)  # pyright: ignore
    return np.asarray(K), np.asarray(dist).ravel()[:5]


def _board_pose(corners: Corners, board: Board, K: Matrix, dist: Distortion) -> Pose:
    """camera_from_board by one image."""
    _, turn, shift = cv2.solvePnP(
        board.corners_m[corners.ids], corners.pixels, K, dist, flags=cv2.SOLVEPNP_IPPE
    )
    return _matrix(np.concatenate([turn.ravel(), shift.ravel()]))


def _chained(poses: Mapping[tuple[int, int], Pose], names: Sequence[str]) -> dict[int, Pose]:
    """camera_from_world of all, world being the first: each is joined to the known one with most times in common."""
    known = {0: np.eye(4)}
    times = [{time for v, time in poses if v == view} for view in range(len(names))]
    while len(known) < len(names):
        pairs = [(len(times[a] & times[b]), a, b) for a in known for b in range(len(names)) if b not in known]
        shared, a, b = max(pairs)
        if not shared:
            raise ValueError(
                f"camera '{names[b]}': expected the board in it and in another camera at the same time, got no such "
                "time; move it between the cameras, and check that all files begin at the same moment"
            )
        joins = [poses[b, time] @ np.linalg.inv(poses[a, time]) for time in sorted(times[a] & times[b])]
        apart = [sum(np.abs(join - other).sum() for other in joins) for join in joins]
        known[b] = joins[int(np.argmin(apart))] @ known[a]  # the one in the middle: some poses are mirrored
    return known


def _vector(pose: Pose) -> Float64[np.ndarray, "6"]:
    return np.concatenate([np.asarray(cv2.Rodrigues(pose[:3, :3])[0]).ravel(), pose[:3, 3]])


def _matrix(vector: Float64[np.ndarray, "6"]) -> Pose:
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(vector[:3])[0]
    pose[:3, 3] = vector[3:]
    return pose


class _Rows:
    """The residuals of all corners, x and y of each, as one vector of the parameters."""

    def __init__(self, seen: Seen, board: Board, sizes: Sequence[Size], times: Sequence[int]):
        keys = sorted(seen)
        self.views = len(sizes)
        self.times = len(times)
        self.size = np.array(sizes, float)
        self.pixels = np.concatenate([seen[key].pixels for key in keys])
        self.points = np.concatenate([board.corners_m[seen[key].ids] for key in keys])
        counts = [len(seen[key].ids) for key in keys]
        self.view = np.repeat([view for view, _ in keys], counts)
        self.time = np.repeat([times.index(time) for _, time in keys], counts)

    def residuals(self, x: Float64[np.ndarray, "parameter"]) -> Float64[np.ndarray, "residual"]:
        """Reprojection errors of all corners in pixels, followed by the residuals of the prior."""
        camera, pose = self._split(x)
        turns = Rotation.from_rotvec(pose[:, :3]).as_matrix()[self.time]
        world = np.einsum("pij,pj->pi", turns, self.points) + pose[self.time, 3:]
        of = camera[self.view]
        turns = Rotation.from_rotvec(camera[:, 6:9]).as_matrix()[self.view]
        seen = np.einsum("pij,pj->pi", turns, world) + of[:, 9:]
        at = seen[:, :2] / np.where(np.abs(seen[:, 2:]) < 1e-9, 1e-9, seen[:, 2:])
        square = (at**2).sum(1, keepdims=True)
        at = at * (1 + of[:, 4:5] * square + of[:, 5:6] * square**2)
        prior = (camera[:, 2:4] / self.size - 0.5) / CENTRE_PX
        return np.concatenate([(of[:, :2] * at + of[:, 2:4] - self.pixels).ravel(), prior.ravel()])

    def sparsity(self) -> object:
        """Which residual depends on which parameter; the first camera stays where it is."""
        corners = len(self.view)
        sparsity = lil_matrix(
            (2 * (corners + self.views), CAMERA * self.views + POSE * self.times), dtype=int
        )
        rows = np.arange(corners)
        for axis in range(2):
            for n in range(CAMERA):
                moves = rows if n < 6 else rows[self.view > 0]
                sparsity[2 * moves + axis, CAMERA * self.view[moves] + n] = 1
            for n in range(POSE):
                sparsity[2 * rows + axis, CAMERA * self.views + POSE * self.time + n] = 1
            views = np.arange(self.views)
            sparsity[2 * (corners + views) + axis, CAMERA * views + 2 + axis] = 1
        return sparsity

    def cameras(self, x: Float64[np.ndarray, "parameter"]) -> list[CalibratedCamera]:
        """The cameras that the parameters mean."""
        off = self.residuals(x)[: self.pixels.size].reshape(-1, 2)
        camera = self._split(x)[0]
        found = []
        for view, (fx, fy, cx, cy, k1, k2) in enumerate(camera[:, :6]):
            own = self.view == view
            K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
            dist = np.array([k1, k2, 0, 0, 0])
            found.append(CalibratedCamera(K, dist, _matrix(camera[view, 6:]), self.pixels[own], off[own]))
        return found

    def _split(self, x: Float64[np.ndarray, "parameter"]) -> tuple[np.ndarray, np.ndarray]:
        end = CAMERA * self.views
        return x[:end].reshape(self.views, CAMERA), x[end:].reshape(self.times, POSE)


def with_cameras(calibration: NativeCalibration, cameras: Cameras) -> NativeCalibration:
    """The calibration with K and pose of these cameras; those that are not among them stay as they were."""
    changed = []
    for camera in calibration.cameras:
        if camera.name in cameras.names:
            own = cameras.select([camera.name])
            pose = own.camera_from_world[0].double().cpu().numpy()
            camera = replace(camera, K=own.K[0].double().cpu().numpy(), R=pose[:3, :3], t_m=pose[:3, 3])
        changed.append(camera)
    return replace(calibration, cameras=tuple(changed))


def residual_picture(cameras: Sequence[NativeCamera], found: Sequence[CalibratedCamera]) -> Picture:
    """A tile a camera: a line from each of the board's corners, `ENLARGED` times as long as what is missed."""
    tiles = [
        Tile(f"{camera.name}   {one.rms_px:.3f} px, {len(one.corners)} corners", _draw(camera, one))
        for camera, one in zip(cameras, found, strict=True)
    ]
    sheet = contact_sheet(in_rows(tiles, int(np.ceil(np.sqrt(len(tiles))))), TILE_PX)
    text = f"from where each corner was found to where the calibration has it, {ENLARGED} times as long"
    return np.concatenate([sheet, contact_sheet([[Tile(text, None)]], sheet.shape[1] - 8, tile_height=0)])


def _draw(camera: NativeCamera, found: CalibratedCamera) -> Picture:
    scale = TILE_PX / camera.width
    image = np.full((max(1, round(camera.height * scale)), TILE_PX, 3), 32, np.uint8)
    for corner, off in zip(found.corners * scale, found.off * scale * ENLARGED, strict=True):
        start, end = (
            np.clip(p, -2 * TILE_PX, 3 * TILE_PX).astype(int).tolist() for p in (corner, corner + off)
        )
        cv2.line(image, start, end, (255, 200, 60), 1, cv2.LINE_AA)
        cv2.circle(image, start, 1, (255, 255, 255), -1)
    return image
