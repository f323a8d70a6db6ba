"""A capture in figures, for programs, and in words."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from viewmend.capture.plain import PlainCapture
from viewmend.cli.calibration_check import CalibrationCheck

DOUBTFUL_IOU = 0.8
"""Below this, a calibration or a mask is wrong more often than not."""


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
    """Of the visual hull; None without masks or where the masks agree on nothing."""
    hull_iou_mean: float | None
    hull_iou_min: float | None
    cameras: tuple[CameraDescription, ...]


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


def in_words(capture: CaptureDescription) -> list[str]:
    """The same for people, line by line."""
    sizes = sorted({(camera.width, camera.height) for camera in capture.cameras})
    fps = "unknown fps" if capture.fps is None else f"{capture.fps:g} fps"
    bounds, iou = capture.bounds_m, capture.hull_iou_mean
    lines = [
        f"{capture.name}: a capture of {len(capture.cameras)} cameras",
        f"  images    {', '.join(f'{w} x {h}' for w, h in sizes)}",
        f"  frames    {_frames(capture)}{'' if capture.frames == 1 else ', ' + fps}",
        f"  masks     {'yes' if capture.masks else 'none'}; depth {'yes' if capture.depth else 'none'}",
        f"  gaps      {_gaps(capture)}",
        f"  unit      {capture.metres_per_unit:g} m; all lengths below are metres",
        f"  up        {'unknown' if capture.up is None else _numbers(capture.up, 3)}",
        f"  bounds    {'none given' if bounds is None else f'{_numbers(bounds[0])} to {_numbers(bounds[1])}'}",
        f"  rig       {_extent(capture.rig_extent_m)}; cameras at {capture.camera_distance_m[0]:.3g} to "
        f"{capture.camera_distance_m[1]:.3g} from the middle",
    ]
    if iou is not None:
        subject = capture.subject_extent_m
        found = "nothing: the masks agree on no point of space" if subject is None else _extent(subject)
        lines.append(f"  subject   {found} (visual hull of frame '{capture.checked_frame}')")
        lines.append(f"  hull IoU  mean {iou:.3f}, lowest {capture.hull_iou_min:.3f}{_verdict(iou)}")
    lines.append("")
    names = max(len(camera.name) for camera in capture.cameras)
    lines += [f"  {camera.name:<{names}}  {_camera(camera)}" for camera in capture.cameras]
    return lines


def _frames(capture: CaptureDescription) -> str:
    if capture.frames == 1:
        return f"1 ('{capture.first_frame}'), static"
    return f"{capture.frames}, '{capture.first_frame}' to '{capture.last_frame}'"


def _gaps(capture: CaptureDescription) -> str:
    if not capture.gaps:
        return "none"
    first = ", ".join(f"{camera} at '{frame}'" for camera, frame in capture.gaps[:3])
    return f"{len(capture.gaps)}: {first}{', ...' if len(capture.gaps) > 3 else ''}"


def _verdict(iou: float) -> str:
    if iou >= DOUBTFUL_IOU:
        return ""
    return "; low: check axes, units, K, distortion and the masks in the picture of --out"


def _camera(camera: CameraDescription) -> str:
    iou = "" if camera.hull_iou is None else f"  IoU {camera.hull_iou:.3f}"
    size = f"{camera.width} x {camera.height}"
    return f"{size:<12} focal {camera.focal_px[0]:7.1f} px  {camera.fov_x_deg:5.1f} deg wide{iou}"


def _numbers(values: Sequence[float], digits: int = 2) -> str:
    return f"({', '.join(f'{value:.{digits}f}' for value in values)})"


def _extent(values: Sequence[float]) -> str:
    return " x ".join(f"{value:.3g}" for value in values)
