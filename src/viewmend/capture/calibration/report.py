"""A calibration with other cameras, and a picture of what it misses."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import UInt8

from viewmend.capture.calibration.bundle import CalibratedCamera
from viewmend.capture.plain_format import PlainCalibration, PlainCamera
from viewmend.contact_sheet import Tile, contact_sheet, in_rows
from viewmend.geometry.cameras import Cameras

ENLARGED = 100
"""Residuals are drawn so many times as long."""
TILE_PX = 480


def with_cameras(calibration: PlainCalibration, cameras: Cameras) -> PlainCalibration:
    """The calibration with K and pose of these cameras; those that are not among them stay as they were."""
    changed = []
    for camera in calibration.cameras:
        if camera.name in cameras.names:
            own = cameras.select([camera.name])
            pose = own.camera_from_world[0].double().cpu().numpy()
            camera = replace(camera, K=own.K[0].double().cpu().numpy(), R=pose[:3, :3], t_m=pose[:3, 3])
        changed.append(camera)
    return replace(calibration, cameras=tuple(changed))


def residual_picture(
    cameras: Sequence[PlainCamera], found: Sequence[CalibratedCamera]
) -> UInt8[np.ndarray, "height width 3"]:
    """A tile a camera: a line from each of the board's corners, `ENLARGED` times as long as what is missed."""
    tiles = [
        Tile(f"{camera.name}   {one.rms_px:.3f} px, {len(one.corners)} corners", _draw(camera, one))
        for camera, one in zip(cameras, found, strict=True)
    ]
    sheet = contact_sheet(in_rows(tiles, int(np.ceil(np.sqrt(len(tiles))))), TILE_PX)
    text = f"from where each corner was found to where the calibration has it, {ENLARGED} times as long"
    legend = contact_sheet([[Tile(text, None)]], sheet.shape[1] - 8, tile_height=0)
    return np.concatenate([sheet, legend])


def _draw(camera: PlainCamera, found: CalibratedCamera) -> UInt8[np.ndarray, "height width 3"]:
    import cv2

    scale = TILE_PX / camera.width
    image = np.full((max(1, round(camera.height * scale)), TILE_PX, 3), 32, np.uint8)
    for corner, off in zip(found.corners * scale, found.off * scale * ENLARGED, strict=True):
        start, end = (np.clip(p, -2 * TILE_PX, 3 * TILE_PX).astype(int).tolist() for p in (corner, corner + off))
        cv2.line(image, start, end, (255, 200, 60), 1, cv2.LINE_AA)
        cv2.circle(image, start, 1, (255, 255, 255), -1)
    return image
