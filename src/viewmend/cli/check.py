"""`viewmend check`: checks and describes a capture."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

if TYPE_CHECKING:
    from viewmend.data.capture_folder import CaptureFolder
    from viewmend.data.checks.calibration import CalibrationCheck
    from viewmend.types import MultiViewFrame

FEW_CAMERAS = 6
"""Artefacts are expected with fewer cameras."""
WIDE_DEG = 60.0
"""Artefacts are expected if neighbouring cameras are farther apart than this angle, degrees."""
ADVISED_DEG = 45
"""Rigs with wider angles are advised to place neighbouring cameras this far apart, degrees."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """Check and describe a capture.

    Checks that all files exist, that masks, calibration and images of one frame agree, and that
    cameras and videos are synchronised.
    """

    capture: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="CAPTURE")]
    """A capture of any supported format."""
    format: str | None = None
    """Format of the capture (docs/formats.md); recognised by default."""
    out: Path | None = None
    """Write a picture of the calibration check to this file (.png or .jpg)."""
    frame: int | None = None
    """Index of the frame to check; by default the first one with a subject."""
    json: bool = False
    """Write one JSON object to standard output."""


def run(options: Options) -> int:
    """Run the command and return the exit code."""
    from viewmend.cli.console import print_json, show

    capture, check, changes = _check_capture(options)
    description = describe_capture(capture, check) | {"adjustments": list(changes)}
    if options.json:
        print_json(description)
    else:
        show(*_capture_as_text(description))
    return 0


def _check_capture(options: Options) -> "tuple[CaptureFolder, CalibrationCheck, tuple[str, ...]]":
    """The capture, what is wrong with it, and what `mend` would change."""
    from viewmend.cli.console import busy, say
    from viewmend.data.capture_folder import CaptureFolder
    from viewmend.data.checks.calibration import check_calibration, draw_check
    from viewmend.data.checks.diagnosis import find_wrong_unit
    from viewmend.data.checks.synchronisation import find_desynchronised_cameras
    from viewmend.data.errors import without_consequences
    from viewmend.data.images import check_image_name, write_image
    from viewmend.data.prepare import adjustments
    from viewmend.utils.atomic_writes import remove_partial_file

    capture = CaptureFolder(options.capture, format=options.format)
    if options.out is not None:
        check_image_name(options.out)
    frame = _frame(capture, options)
    with busy("computing the hull"):
        check = check_calibration(frame, capture.bounds)
        good = check.frame.without([issue.camera for issue in check.issues if issue.camera])
        fatal = any(issue.fatal for issue in check.issues)  # then nothing else can be judged
        late = () if fatal else find_desynchronised_cameras(capture, good, len(capture.frame_ids) - 1)
        found = (*capture.issues, *without_consequences(check.issues, late), *late)
        check = replace(check, issues=(*found, *find_wrong_unit(capture.cameras, found)))
        changes = () if fatal or len(good.cameras) < 2 else adjustments(capture, good, check.issues)
    if options.out is not None:
        remove_partial_file(options.out)
        with busy("drawing the picture"):
            write_image(options.out, draw_check(check, capture.up))
        say(f"wrote {options.out}")
    return capture, check, changes


def _frame(capture: "CaptureFolder", options: Options) -> "MultiViewFrame":
    """The frame to check; ValueError if there is no such frame, or no subject in it."""
    from viewmend.data.prepare import first_with_subject

    if options.frame is None:
        return first_with_subject(capture) or capture.read(0)
    if not 0 <= options.frame < len(capture.frame_ids):
        last = len(capture.frame_ids) - 1
        raise ValueError(
            f"{options.capture}: expected --frame of 0 to {last}, got {options.frame}; choose again"
        )
    frame = capture.read(options.frame)
    if capture.has_masks and not frame.has_subject:
        expected = f"foreground in the masks of frame '{capture.frame_ids[options.frame]}'"
        raise ValueError(f"{options.capture}: expected {expected}, got none; choose another --frame")
    return frame


def describe_capture(capture: "CaptureFolder", check: "CalibrationCheck") -> dict[str, Any]:
    """The `--json` output: properties of a capture and the results of the check. Lengths are in metres."""
    cameras = capture.cameras
    bounds = capture.bounds
    iou = list(check.iou.values())
    distance = (cameras.centers - check.bounds.center).norm(dim=-1)
    directions = (cameras.centers - check.bounds.center) / distance[:, None]
    apart = (directions @ directions.mT).clamp(-1, 1).fill_diagonal_(-1).acos().amin(1).median().rad2deg()
    hull = None if check.proxy is None or not len(check.proxy.mesh.vertices) else check.proxy.mesh.vertices
    return {
        "name": capture.name,
        "path": str(capture.folder),
        "frames": len(capture.frame_ids),
        "first_frame": capture.frame_ids[0],
        "last_frame": capture.frame_ids[-1],
        "fps": capture.fps,
        "metres_per_unit": capture.metres_per_unit,
        "origin_m": capture.origin_m.tolist(),
        "up": None if capture.up is None else capture.up.tolist(),
        "bounds_m": None if bounds is None else [bounds.low.tolist(), bounds.high.tolist()],
        "rig_extent_m": (cameras.centers.amax(0) - cameras.centers.amin(0)).tolist(),
        "camera_distance_m": [float(distance.min()), float(distance.max())],
        "camera_spacing_deg": float(apart),
        "masks": capture.has_masks,
        "depth": capture.has_depth,
        "gaps": capture.gaps,
        "checked_frame": capture.frame_ids[check.frame.time],
        "subject_extent_m": None if hull is None else (hull.amax(0) - hull.amin(0)).tolist(),
        "hull_iou_mean": sum(iou) / len(iou) if iou else None,
        "hull_iou_min": min(iou, default=None),
        "cameras": [_describe_camera(capture, check, view) for view in range(len(cameras))],
        "left_out": [issue.camera for issue in check.issues if issue.camera],
        "unused": list(capture.unmasked),
        "findings": [issue.text for issue in check.issues],
    }


def _describe_camera(capture: "CaptureFolder", check: "CalibrationCheck", view: int) -> dict[str, Any]:
    """A camera after undistortion. Its hull IoU is None without masks, and if it is absent from the checked frame."""
    camera = capture.cameras[view]
    (name,) = camera.names
    width, height = camera.max_size_px
    K = camera.K[0]
    return {
        "name": name,
        "width": width,
        "height": height,
        "focal_px": [float(K[0, 0]), float(K[1, 1])],
        "fov_x_deg": math.degrees(2 * math.atan(width / (2 * float(K[0, 0])))),
        "center_m": camera.centers[0].tolist(),
        "hull_iou": check.iou.get(name),
        "films": [] if capture.clock is None else capture.clock.describe(name),
    }


def _capture_as_text(capture: dict[str, Any]) -> list[str]:
    sizes = sorted({(camera["width"], camera["height"]) for camera in capture["cameras"]})
    fps = "unknown fps" if capture["fps"] is None else f"{capture['fps']:g} fps"
    bounds = capture["bounds_m"]
    iou = capture["hull_iou_mean"]
    near, far = capture["camera_distance_m"]
    frames = f"{capture['frames']}, '{capture['first_frame']}' to '{capture['last_frame']}', {fps}"
    if capture["frames"] == 1:
        frames = f"1 ('{capture['first_frame']}'), static"
    gaps = [f"{camera} at '{frame}'" for camera, frame in capture["gaps"]]
    count = f"{capture['frames']} frame{'s' if capture['frames'] > 1 else ''}"
    lines = [
        f"{capture['name']}: a capture with {len(capture['cameras'])} cameras, {count}",
        f"  images    {', '.join(f'{w} x {h}' for w, h in sizes)}",
        f"  frames    {frames}",
        f"  masks     {'yes' if capture['masks'] else 'none (viewmend masks makes them)'}",
        f"  depth     {'yes' if capture['depth'] else 'none'}",
        f"  gaps      {f'{len(gaps)}: ' if gaps else 'none'}{', '.join(gaps[:3])}{', ...' if len(gaps) > 3 else ''}",
        f"  unit      {capture['metres_per_unit']:g} m; all lengths below are in metres",
    ]
    if any(capture["origin_m"]):
        origin = _vector(capture["origin_m"])
        lines.append(f"  origin    {origin} m in the capture's files; its coordinates below are relative")
    lines += [
        f"  up        {'unknown' if capture['up'] is None else _vector(capture['up'], 3)}",
        f"  bounds    {'none' if bounds is None else f'{_vector(bounds[0])} to {_vector(bounds[1])}'}",
        f"  rig       {_extent(capture['rig_extent_m'])}; cameras {near:.3g} to {far:.3g} from the centre",
    ]
    lines.append(f"  angles    {_angles_as_text(capture)}")
    if iou is not None:
        subject = capture["subject_extent_m"]
        extent = "none: the masks have no point in common" if subject is None else _extent(subject)
        lines.append(f"  subject   {extent} (visual hull of frame '{capture['checked_frame']}')")
        lines.append(f"  hull IoU  mean {iou:.3f}, lowest {capture['hull_iou_min']:.3f}")
    lines.append("")
    width = max(len(camera["name"]) for camera in capture["cameras"])
    for camera in capture["cameras"]:
        iou = "" if camera["hull_iou"] is None else f"  IoU {camera['hull_iou']:.3f}"
        iou = "  left out" if camera["name"] in capture["left_out"] else iou
        size = f"{camera['width']} x {camera['height']}"
        lens = f"{size:<12} focal {camera['focal_px'][0]:7.1f} px  {camera['fov_x_deg']:5.1f} deg wide"
        lines.append(f"  {camera['name']:<{width}}  {lens}{iou}")
    for camera in capture["cameras"]:
        lines += [f"  {camera['name']:<{width}}  {_film_as_text(film)}" for film in camera["films"]]
    if capture["findings"]:
        lines += ["", "  issues:", *(f"  - {text}" for text in capture["findings"])]
    if capture["adjustments"]:
        lines += [
            "",
            "  mend, serve and evaluate change:",
            *(f"  - {text}" for text in capture["adjustments"]),
        ]
    return lines


def _angles_as_text(capture: dict[str, Any]) -> str:
    """The angle between neighbouring cameras, and advice to rigs of few or widely spaced ones."""
    used = len(capture["cameras"]) - len(capture["left_out"])
    spacing_deg = capture["camera_spacing_deg"]
    text = f"{spacing_deg:.0f} degrees between neighbours"
    if spacing_deg > WIDE_DEG:
        advice = f"neighbours at most {ADVISED_DEG} degrees apart avoid them"
    elif used < FEW_CAMERAS:
        advice = f"{used} cameras see it from few sides: more cameras, on the other sides, avoid them"
    else:
        return text
    return f"{text}; expect foggy bodies and doubled limbs; {advice}"


def _film_as_text(film: dict[str, Any]) -> str:
    """Rate, length, gaps and offset of a camera's images or masks, by the times in the film."""
    fps = "unknown fps" if film["fps"] is None else f"{film['fps']:.5g} fps"
    gaps = [f"{count} missing at {start_s:.2f} s" for start_s, count in film["gaps"]]
    more = f", and {len(gaps) - 3} more gaps" if len(gaps) > 3 else ""
    text = f"{film['frames']} {film['kind']}, {fps}, {film['start_s']:.2f} to {film['end_s']:.2f} s"
    return f"{text}, {', '.join(gaps[:3]) or 'no gaps'}{more}, offset {film['offset_ms']:g} ms"


def _vector(values: Sequence[float], digits: int = 2) -> str:
    return f"({', '.join(f'{value:.{digits}f}' for value in values)})"


def _extent(values: Sequence[float]) -> str:
    return " x ".join(f"{value:.3g}" for value in values)
