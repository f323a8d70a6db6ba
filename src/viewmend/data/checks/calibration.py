"""Compares the silhouettes of the hull with the masks, and draws the calibration into the images."""

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from viewmend.data.checks.diagnosis import diagnose
from viewmend.data.errors import Issue
from viewmend.geometry.alignment import silhouette_iou
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import project
from viewmend.geometry.hull import FOREGROUND, bounds_from_cameras
from viewmend.geometry.proxy import GeometryProxy, reconstruct
from viewmend.types import MultiViewFrame
from viewmend.utils.contact_sheet import Tile, contact_sheet, in_rows, picture

Point = Float[Tensor, "3"]
Picture = UInt8[np.ndarray, "height width 3"]
MASK_ONLY = (255, 0, 255)
"""Pixels of the mask outside the hull have this colour, magenta."""
HULL_ONLY = (0, 255, 255)
"""Pixels of the hull outside the mask have this colour, cyan."""
BOX = (255, 255, 255)
"""The edges of the bounds have this colour, white."""
AXES = {"x": (255, 60, 60), "y": (60, 255, 60), "z": (90, 120, 255)}
"""The axes have these colours: red, green and blue."""
UP = (255, 220, 0)
"""The line that points up has this colour, yellow."""
LEGEND = (
    "white: bounds; red x, green y, blue z; yellow: up; magenta: mask without hull; cyan: hull without mask; "
    "with a good calibration and good masks both are thin seams"
)


@dataclass(frozen=True)
class CalibrationCheck:
    """One frame of a capture, its visual hull, and the agreement of the hull's silhouettes with the masks."""

    frame: MultiViewFrame
    bounds: Bounds
    """Those of the capture, else of the hull, else what all cameras see."""
    proxy: GeometryProxy | None
    """None for a capture without masks."""
    silhouettes: Float[Tensor, "view height width"] | None
    """1 where the hull covers a pixel."""
    iou: dict[str, float]
    """Intersection over union of silhouette and mask of each camera that is not left out; empty
    without masks."""
    issues: tuple[Issue, ...] = ()


def check_calibration(frame: MultiViewFrame, bounds: Bounds | None) -> CalibrationCheck:
    """The hull of a frame compared with the masks; `bounds` are those of the capture.

    Cameras that the diagnosis leaves out do not carve the hull.

    Raises:
        ValueError: there is one camera only, or the cameras look away from each other.
    """
    if frame.mask is None:
        return CalibrationCheck(frame, bounds or bounds_from_cameras(frame.cameras), None, None, {})
    issues = diagnose(frame, bounds)
    good = frame.without([issue.camera for issue in issues if issue.camera])
    good = good if len(good.cameras) >= 2 else frame
    assert good.mask is not None
    proxy = reconstruct(good.mask, good.cameras, bounds)
    covered = proxy.depth(frame.cameras) > 0
    iou = silhouette_iou(covered, frame.mask).nan_to_num(1.0).tolist()  # two empty silhouettes agree
    scores = {
        name: one for name, one in zip(frame.cameras.names, iou, strict=True) if name in good.cameras.names
    }
    return CalibrationCheck(frame, bounds or proxy.bounds, proxy, covered.float(), scores, issues)


def draw_check(check: CalibrationCheck, up: Point | None, tile_width: int = 400) -> Picture:
    """Draw all cameras with bounds, axes, up, and the disagreement of hull and mask; see `LEGEND`."""
    names = check.frame.cameras.names
    captions = [f"{name}   {_caption(check, name)}" for name in names]
    tiles = [Tile(caption, _draw(check, view, up)) for view, caption in enumerate(captions)]
    sheet = contact_sheet(in_rows(tiles, math.ceil(math.sqrt(1.25 * len(tiles)))), tile_width)
    return np.concatenate([sheet, contact_sheet([[Tile(LEGEND, None)]], sheet.shape[1] - 8, tile_height=0)])


def _caption(check: CalibrationCheck, name: str) -> str:
    """A camera's agreement with the hull, if there is one."""
    if not check.iou:
        return ""
    return f"IoU {check.iou[name]:.3f}" if name in check.iou else "left out"


def _draw(check: CalibrationCheck, view: int, up: Point | None) -> Picture:
    width, height = (int(n) for n in check.frame.cameras.size_px[view])
    image = picture(check.frame.rgb[view, :, :height, :width])
    if check.frame.mask is not None and check.silhouettes is not None:
        hull = check.silhouettes[view, :height, :width].cpu().numpy() > 0
        mask = check.frame.mask[view, :height, :width].cpu().numpy() > FOREGROUND
        image[~mask] //= 2  # darken the background, so that the mask is visible
        image[mask & ~hull] = MASK_ONLY
        image[hull & ~mask] = HULL_ONLY
    thickness = max(1, round(width / 400))
    for start, end, colour, label in _lines(check, up):
        pixels = _visible_pixels(check, view, start, end)
        for a, b in itertools.pairwise(pixels):
            if a is not None and b is not None:
                cv2.line(image, a, b, colour, thickness, cv2.LINE_AA)
        if label and pixels[-1] is not None:
            cv2.putText(
                image,
                label,
                pixels[-1],
                cv2.FONT_HERSHEY_SIMPLEX,
                width / 800,
                colour,
                thickness,
                cv2.LINE_AA,
            )
    return image


def _lines(
    check: CalibrationCheck, up: Point | None
) -> Iterator[tuple[Point, Point, tuple[int, int, int], str]]:
    """The edges of the bounds, and axes and up at the centre of the subject: both ends, colour and label."""
    low = check.bounds.low
    high = check.bounds.high
    for axis in range(3):
        for corner in range(4):
            bits = torch.tensor([corner & 1, corner >> 1])
            start = torch.where(torch.cat([bits[:axis], torch.zeros(1), bits[axis:]]).bool(), high, low)
            end = start.clone()
            end[axis] = high[axis]
            yield start, end, BOX, ""
    subject = check.proxy.bounds if check.proxy is not None else check.bounds
    length = float(subject.size_m.max()) / 3
    for axis, (label, colour) in enumerate(AXES.items()):
        yield subject.center, subject.center + length * torch.eye(3)[axis], colour, label
    if up is not None:
        yield subject.center, subject.center + 1.3 * length * up, UP, "up"


def _visible_pixels(
    check: CalibrationCheck, view: int, start: Point, end: Point
) -> list[tuple[int, int] | None]:
    """Pixels along a line in the world; None where it is behind the camera or far outside the image."""
    camera = check.frame.cameras[view]
    fractions = torch.linspace(0, 1, 65)[:, None]
    uv, z = project(start + fractions * (end - start), camera)
    near = 1e-3 * float((check.bounds.center - camera.centers[0]).norm())
    far = 4 * max(camera.max_size_px)
    visible = (z[0] > near) & (uv[0].abs() < far).all(-1)
    return [
        (int(u), int(v)) if ok else None for (u, v), ok in zip(uv[0].tolist(), visible.tolist(), strict=True)
    ]
