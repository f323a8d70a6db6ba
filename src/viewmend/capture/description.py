"""A capture in figures."""

import math
from dataclasses import dataclass

from viewmend.capture.calibration_check import CalibrationCheck
from viewmend.capture.plain import PlainCapture


@dataclass(frozen=True)
class CameraDescription:
    """One camera, after undistortion."""

    name: str
    width: int
    height: int
    focal_px: tuple[float, float]
    fov_x_deg: float
    center_m: tuple[float, ...]
    hull_iou: float | None
    """Hull silhouette against mask; None without masks, or where the camera has a gap."""


@dataclass(frozen=True)
class CaptureDescription:
    """What `viewmend info` says of a capture; lengths in metres."""

    kind: str
    name: str
    path: str
    frames: int
    first_frame: str
    last_frame: str
    fps: float | None
    metres_per_unit: float
    up: tuple[float, ...] | None
    bounds_m: tuple[tuple[float, ...], tuple[float, ...]] | None
    rig_extent_m: tuple[float, ...]
    camera_distance_m: tuple[float, float]
    """Nearest and farthest camera from the middle of the bounds."""
    masks: bool
    depth: bool
    gaps: tuple[tuple[str, str], ...]
    """Camera and frame id of each."""
    checked_frame: str
    subject_extent_m: tuple[float, ...] | None
    """Edges of the visual hull's box; None without masks, or where the masks agree on nothing."""
    hull_iou_mean: float | None
    hull_iou_min: float | None
    cameras: tuple[CameraDescription, ...]
    findings: tuple[str, ...] = ()
    """What is wrong with masks and calibration, in words; () for a good capture."""


def describe_capture(capture: PlainCapture, check: CalibrationCheck) -> CaptureDescription:
    """The figures of a capture and of one frame's check."""
    cameras, bounds, iou = capture.cameras, capture.bounds, list(check.iou.values())
    distance = (cameras.centers - check.bounds.center).norm(dim=-1)
    return CaptureDescription(
        kind="capture",
        name=capture.name,
        path=str(capture.folder),
        frames=len(capture.frame_ids),
        first_frame=capture.frame_ids[0],
        last_frame=capture.frame_ids[-1],
        fps=capture.fps,
        metres_per_unit=capture.metres_per_unit,
        up=None if capture.up is None else tuple(capture.up.tolist()),
        bounds_m=None if bounds is None else (tuple(bounds.low.tolist()), tuple(bounds.high.tolist())),
        rig_extent_m=tuple((cameras.centers.amax(0) - cameras.centers.amin(0)).tolist()),
        camera_distance_m=(float(distance.min()), float(distance.max())),
        masks=capture.has_masks,
        depth=capture.has_depth,
        gaps=capture.gaps,
        checked_frame=capture.frame_ids[check.frame.time],
        subject_extent_m=_subject_extent(check),
        hull_iou_mean=sum(iou) / len(iou) if iou else None,
        hull_iou_min=min(iou, default=None),
        cameras=tuple(_describe_camera(capture, check, view) for view in range(len(cameras))),
        findings=tuple(finding.text for finding in check.findings),
    )


def _subject_extent(check: CalibrationCheck) -> tuple[float, ...] | None:
    if check.proxy is None or not len(check.proxy.mesh.vertices):
        return None
    vertices = check.proxy.mesh.vertices
    return tuple((vertices.amax(0) - vertices.amin(0)).tolist())


def _describe_camera(capture: PlainCapture, check: CalibrationCheck, view: int) -> CameraDescription:
    camera = capture.cameras[view]
    width, height = camera.max_size_px
    focal_px = float(camera.K[0, 0, 0]), float(camera.K[0, 1, 1])
    return CameraDescription(
        name=camera.names[0],
        width=width,
        height=height,
        focal_px=focal_px,
        fov_x_deg=math.degrees(2 * math.atan(width / (2 * focal_px[0]))),
        center_m=tuple(camera.centers[0].tolist()),
        hull_iou=check.iou.get(camera.names[0]),
    )
