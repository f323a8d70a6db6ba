"""Calibrates cameras from the corners of a moving board: each camera by itself, then all together.

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
from scipy.sparse import csr_array, csr_matrix, diags, identity, lil_matrix
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

from viewmend.data.native_format import NativeCalibration, NativeCamera
from viewmend.geometry.cameras import Cameras
from viewmend.preprocess.calibration.board import Board, Corners
from viewmend.utils.contact_sheet import Tile, contact_sheet, in_rows

MIN_VIEWS = 5
"""Smallest number of images of the board that a camera needs."""
MAX_VIEWS = 40
"""Largest number of images for the first calibration of a camera; the bundle adjustment
uses all."""
CAMERA_PARAMETERS = 12
"""Number of parameters of a camera: fx, fy, cx, cy, k1, k2, rotation and translation."""
POSE_PARAMETERS = 6
"""Number of parameters of the board's pose in one frame: rotation and translation."""
OUTLIER_PX = 0.3
"""Residuals above this many pixels count less: corners of boards seen at a slant are found
less well."""
CENTRE_PX = 0.05
"""Standard deviation of the principal point from the middle of the image, as a fraction of its
size: a weak prior."""
STEPS = 60
TINY = 1e-10
"""Added to the diagonal of a scaled normal matrix, so that it can be inverted."""
MAD_TO_DEVIATION = 1.4826
"""Standard deviation of normally distributed numbers, in medians of their absolute values."""
MAX_FOCAL_DEVIATION = 0.05
"""A focal length is determined if its standard deviation is at most this share of it."""

Detections = Mapping[tuple[int, int], Corners]
"""Corners by index of the camera and of the frame."""
Size = tuple[int, int]
Matrix = Float64[np.ndarray, "3 3"]
Distortion = Float64[np.ndarray, "5"]
Pose = Float64[np.ndarray, "4 4"]
Image = UInt8[np.ndarray, "height width 3"]
RESIDUAL_SCALE = 100
"""Factor by which residuals are enlarged in the drawing."""
TILE_PX = 480


@dataclass(frozen=True)
class CalibratedCamera:
    """One calibrated camera, and its residuals."""

    K: Matrix
    """Pixels; the top-left pixel has its centre at (0.5, 0.5)."""
    dist: Distortion
    """Distortion coefficients k1 k2 0 0 0 (Brown-Conrady)."""
    camera_from_world: Pose
    corners: Float64[np.ndarray, "corner 2"]
    """Detected corners, pixels."""
    residuals_px: Float64[np.ndarray, "corner 2"]
    """Residuals in pixels: projections of the corners minus where they were found."""

    @property
    def rms_px(self) -> float:
        """Root mean square reprojection error, pixels."""
        return float(np.sqrt((self.residuals_px**2).sum(1).mean()))


def calibrate(
    detections: Detections, board: Board, names: Sequence[str], sizes: Sequence[Size]
) -> list[CalibratedCamera]:
    """Calibrate the cameras of these names and image sizes (width, height) from their views of the board.

    ValueError if a camera saw the board too seldom, never together with the others, or not tilted enough.
    """
    intrinsics = [
        _calibrate_alone(detections, board, view, name, sizes[view]) for view, name in enumerate(names)
    ]
    poses = {key: _board_pose(corners, board, *intrinsics[key[0]]) for key, corners in detections.items()}
    cameras = _chain_poses(poses, names)
    times = sorted({time for _, time in detections})
    start = [
        np.concatenate([K[[0, 1, 0, 1], [0, 1, 2, 2]], dist[:2], _vector(cameras[view])])
        for view, (K, dist) in enumerate(intrinsics)
    ]
    for time in times:
        view = max((v for v, t in detections if t == time), key=lambda v: len(detections[v, time].ids))
        start.append(_vector(np.linalg.inv(cameras[view]) @ poses[view, time]))
    problem = _Residuals(detections, board, sizes, times)
    found = least_squares(
        problem.residuals,
        np.concatenate(start),
        jac_sparsity=problem.sparsity(),
        x_scale="jac",
        loss="soft_l1",
        f_scale=OUTLIER_PX,
        max_nfev=STEPS,
    )
    deviations = problem.focal_deviations(found.x, found.jac)
    worst = int(np.argmax(deviations))
    if not deviations[worst] <= MAX_FOCAL_DEVIATION:
        raise ValueError(
            f"camera '{names[worst]}': expected images that determine its focal length, got it to within "
            f"{100 * deviations[worst]:.0f} % only, as the board is hardly tilted or moved; film it at several "
            "distances, tilted to all sides"
        )
    return problem.cameras(found.x)


def _calibrate_alone(
    detections: Detections, board: Board, view: int, name: str, size: Size
) -> tuple[Matrix, Distortion]:
    own = sorted((corners for (v, _), corners in detections.items() if v == view), key=lambda c: -len(c.ids))
    if len(own) < MIN_VIEWS:
        raise ValueError(
            f"camera '{name}': expected the board in {MIN_VIEWS} images or more, found it in {len(own)}; check "
            "--board and --dictionary, show it larger, sharper and tilted, or look at more frames (--every 1)"
        )
    own = own[:: max(1, len(own) // MAX_VIEWS)][:MAX_VIEWS]
    points = [board.corners_m[c.ids].astype(np.float32)[None] for c in own]
    pixels = [c.pixels.astype(np.float32)[None] for c in own]
    flags = cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K3
    _, K, dist, *_ = cv2.calibrateCamera(points, pixels, size, None, None, flags=flags)
    return np.asarray(K), np.asarray(dist).ravel()[:5]


def _board_pose(corners: Corners, board: Board, K: Matrix, dist: Distortion) -> Pose:
    """Estimate camera_from_board from one image."""
    _, turn, shift = cv2.solvePnP(
        board.corners_m[corners.ids], corners.pixels, K, dist, flags=cv2.SOLVEPNP_IPPE
    )
    return _matrix(np.concatenate([turn.ravel(), shift.ravel()]))


def _chain_poses(poses: Mapping[tuple[int, int], Pose], names: Sequence[str]) -> dict[int, Pose]:
    """Chain camera_from_world of all cameras, starting at the first one, whose frame is the world.

    Each camera is joined to the known one with which it shares most frames.
    """
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


class _Residuals:
    """The residuals of all corners, x and y of each, as a function of one parameter vector."""

    def __init__(self, detections: Detections, board: Board, sizes: Sequence[Size], times: Sequence[int]):
        keys = sorted(detections)
        self.views = len(sizes)
        self.times = len(times)
        self.size = np.array(sizes, float)
        self.pixels = np.concatenate([detections[key].pixels for key in keys])
        self.points = np.concatenate([board.corners_m[detections[key].ids] for key in keys])
        counts = [len(detections[key].ids) for key in keys]
        self.view = np.repeat([view for view, _ in keys], counts)
        self.time = np.repeat([times.index(time) for _, time in keys], counts)

    def residuals(self, x: Float64[np.ndarray, "parameter"]) -> Float64[np.ndarray, "residual"]:
        """Reprojection errors of all corners in pixels, followed by the residuals of the prior."""
        camera, pose = self._unpack(x)
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
        """The residuals that depend on each parameter; the first camera's pose is fixed."""
        corners = len(self.view)
        sparsity = lil_matrix(
            (2 * (corners + self.views), CAMERA_PARAMETERS * self.views + POSE_PARAMETERS * self.times),
            dtype=int,
        )
        rows = np.arange(corners)
        for axis in range(2):
            for n in range(CAMERA_PARAMETERS):
                moves = rows if n < 6 else rows[self.view > 0]
                sparsity[2 * moves + axis, CAMERA_PARAMETERS * self.view[moves] + n] = 1
            for n in range(POSE_PARAMETERS):
                sparsity[
                    2 * rows + axis, CAMERA_PARAMETERS * self.views + POSE_PARAMETERS * self.time + n
                ] = 1
            views = np.arange(self.views)
            sparsity[2 * (corners + views) + axis, CAMERA_PARAMETERS * views + 2 + axis] = 1
        return sparsity

    def focal_deviations(
        self, x: Float64[np.ndarray, "parameter"], jacobian: csr_array | csr_matrix
    ) -> Float64[np.ndarray, "view"]:
        """Standard deviation of each fx, relative to it, by the spread of the corners and the Jacobian."""
        normal = (jacobian.T @ jacobian).tocsc()
        scale = 1 / np.sqrt(np.maximum(normal.diagonal(), TINY))  # the first camera's pose has no residuals
        scaled = diags(scale) @ normal @ diags(scale) + TINY * identity(len(scale))
        focal = CAMERA_PARAMETERS * np.arange(self.views)
        units = np.zeros((len(scale), self.views))
        units[focal, np.arange(self.views)] = scale[focal]
        variance = (units * splu(scaled.tocsc()).solve(units)).sum(0)
        spread_px = MAD_TO_DEVIATION * np.median(np.abs(self.residuals(x)[: self.pixels.size]))
        return spread_px * np.sqrt(np.maximum(variance, 0)) / np.abs(x[focal])

    def cameras(self, x: Float64[np.ndarray, "parameter"]) -> list[CalibratedCamera]:
        """The cameras for these parameters."""
        residuals_px = self.residuals(x)[: self.pixels.size].reshape(-1, 2)
        camera = self._unpack(x)[0]
        found = []
        for view, (fx, fy, cx, cy, k1, k2) in enumerate(camera[:, :6]):
            own = self.view == view
            K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
            dist = np.array([k1, k2, 0, 0, 0])
            found.append(
                CalibratedCamera(K, dist, _matrix(camera[view, 6:]), self.pixels[own], residuals_px[own])
            )
        return found

    def _unpack(self, x: Float64[np.ndarray, "parameter"]) -> tuple[np.ndarray, np.ndarray]:
        end = CAMERA_PARAMETERS * self.views
        return x[:end].reshape(self.views, CAMERA_PARAMETERS), x[end:].reshape(self.times, POSE_PARAMETERS)


def with_cameras(calibration: NativeCalibration, cameras: Cameras) -> NativeCalibration:
    """Replace K and pose of the cameras in `cameras`; all others are unchanged."""
    changed = []
    for camera in calibration.cameras:
        if camera.name in cameras.names:
            own = cameras.select([camera.name])
            pose = own.camera_from_world[0].double().cpu().numpy()
            camera = replace(camera, K=own.K[0].double().cpu().numpy(), R=pose[:3, :3], t_m=pose[:3, 3])
        changed.append(camera)
    return replace(calibration, cameras=tuple(changed))


def draw_residuals(cameras: Sequence[NativeCamera], found: Sequence[CalibratedCamera]) -> Image:
    """Draw a tile per camera: a line from each corner, `RESIDUAL_SCALE` times as long as its residual."""
    tiles = [
        Tile(f"{camera.name}   {one.rms_px:.3f} px, {len(one.corners)} corners", _draw(camera, one))
        for camera, one in zip(cameras, found, strict=True)
    ]
    sheet = contact_sheet(in_rows(tiles, int(np.ceil(np.sqrt(len(tiles))))), TILE_PX)
    text = f"from where each corner was found to where the calibration has it, {RESIDUAL_SCALE} times as long"
    return np.concatenate([sheet, contact_sheet([[Tile(text, None)]], sheet.shape[1] - 8, tile_height=0)])


def _draw(camera: NativeCamera, found: CalibratedCamera) -> Image:
    scale = TILE_PX / camera.width
    image = np.full((max(1, round(camera.height * scale)), TILE_PX, 3), 32, np.uint8)
    for corner, residuals_px in zip(
        found.corners * scale, found.residuals_px * scale * RESIDUAL_SCALE, strict=True
    ):
        start, end = (
            np.clip(p, -2 * TILE_PX, 3 * TILE_PX).astype(int).tolist()
            for p in (corner, corner + residuals_px)
        )
        cv2.line(image, start, end, (255, 200, 60), 1, cv2.LINE_AA)
        cv2.circle(image, start, 1, (255, 255, 255), -1)
    return image
