"""A ChArUco board as known cameras see it: rays onto its plane, many to a pixel."""

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

RAYS = 3
"""Rays to a pixel, along each side, unless fewer suffice."""


def waved(count, size_m, seed=0, yaw_rad=np.pi, low=(-0.7, 0.25, -0.7), high=(0.7, 1.75, 0.7)):
    """World from board, of a board that is carried through the stage and turned hither and thither.

    `yaw_rad` is how far it is turned to either side of +z.
    """
    rng = np.random.default_rng(seed)
    for number in range(count):
        yaw = yaw_rad * (2 * (number * 0.618 % 1) - 1) + rng.normal(0, 0.1)
        turn = Rotation.from_euler("yxz", [yaw, *rng.uniform(-0.6, 0.6, 2)]).as_matrix() @ np.diag(
            [1.0, -1, -1]
        )
        pose = np.eye(4)
        pose[:3, :3] = turn
        pose[:3, 3] = rng.uniform(low, high) - turn @ np.array([*np.array(size_m) / 2, 0])
        yield pose


def photograph(board, K, dist, camera_from_board, size_px, grey=110, rays_per_side=RAYS):
    """The board's picture; None from behind or where it is out of sight."""
    width_m, height_m = board.columns * board.square_m, board.rows * board.square_m
    rim = np.array([[x, y, 0] for x in (0, width_m) for y in (0, height_m)], float)
    seen = rim @ camera_from_board[:3, :3].T + camera_from_board[:3, 3]
    facing = camera_from_board[:3, 2] @ (camera_from_board[:3, :3] @ rim.mean(0) + camera_from_board[:3, 3])
    if facing < 0 or seen[:, 2].min() < 0.1:
        return None
    projected = cv2.projectPoints(rim, camera_from_board[:3, :3], camera_from_board[:3, 3], K, dist)[0][:, 0]
    low = np.clip(np.floor(projected.min(0)) - 3, 0, size_px).astype(int)
    high = np.clip(np.ceil(projected.max(0)) + 3, 0, size_px).astype(int)
    image = np.full((size_px[1], size_px[0]), grey, np.uint8)
    if (high - low).min() < 4:
        return None
    fine = (
        np.mgrid[
            low[1] * rays_per_side : high[1] * rays_per_side, low[0] * rays_per_side : high[0] * rays_per_side
        ]
        + 0.5
    ) / rays_per_side
    rows, columns = fine.shape[1:]
    pixels = fine[::-1].reshape(2, -1).T
    if np.any(dist):
        rays = cv2.undistortPoints(pixels[:, None], K, dist)[:, 0]
    else:
        rays = (pixels - K[:2, 2]) / K[[0, 1], [0, 1]]
    rays = np.concatenate([rays, np.ones((len(rays), 1))], 1)
    normal, origin = camera_from_board[:3, 2], camera_from_board[:3, 3]
    hits = rays * ((normal @ origin) / (rays @ normal))[:, None] - origin
    texels = texels_per_m(K, camera_from_board)
    texture = drawn(board, texels, grey)
    at = (hits @ camera_from_board[:3, :2] + board.square_m) * texels - 0.5
    at = at.astype(np.float32).reshape(rows, columns, 2)
    fine = cv2.remap(texture, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(grey,))
    small = fine.reshape(rows // rays_per_side, rays_per_side, columns // rays_per_side, rays_per_side).mean(
        (1, 3)
    )
    image[low[1] : high[1], low[0] : high[0]] = np.rint(small)
    return image


def texels_per_m(K, camera_from_board):
    """About as fine as the rays, and whole texels to a millimetre's hundredth."""
    return 100 * max(4, round(RAYS * K[0, 0] / abs(camera_from_board[2, 3]) / 100))


_DRAWN = {}


def drawn(board, texels, grey):
    """The board's picture with a rim of one square."""
    key = (board, texels, grey)
    if key not in _DRAWN:
        rim = round(board.square_m * texels)
        size = (round(board.columns * board.square_m * texels), round(board.rows * board.square_m * texels))
        _DRAWN[key] = cv2.copyMakeBorder(
            board.opencv.generateImage(size), *[rim] * 4, cv2.BORDER_CONSTANT, value=grey
        )
    return _DRAWN[key]
