"""`viewmend mend`: novel views of a capture, rendered and mended, and scored against a camera that was left out."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

if TYPE_CHECKING:
    from viewmend.capture.plain import PlainCapture
    from viewmend.geometry.cameras import Cameras
    from viewmend.views import MultiViewFrame


@dataclass(frozen=True, kw_only=True)
class Options:
    """Render novel views of a capture and fill their holes.

    OUT gets the mended views (mended.mp4, or mended/*.png for one view or without PyAV), E (holes/*.png, white where
    a pixel was missing) and contact_sheet.png. With --leave-out the view is that of a camera whose image and mask are
    used for nothing else, and is scored against it, black background: PSNR in dB of the whole image, of the pixels
    that were rendered (valid), and of those that were missing (holes; fg: those inside the true mask), the latter
    also for OpenCV's Telea fill. PSNRs are means over frames, in the holes over frames with at least 50 such pixels
    (if there are any); hole_fraction is the holes' share of the hull's pixels.
    """

    capture: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="CAPTURE")]
    """A capture folder (with cameras.json and masks)."""
    out: Path
    """Folder for the results; it is made if it is not there."""
    leave_out: str | None = None
    """Name of the camera to leave out, whose view is rendered. Either this or --path."""
    path: str | None = None
    """'orbit', or a JSON file: a list of 4x4 world_from_camera matrices (metres, OpenCV axes), or an object with
    "world_from_camera" and, if wanted, "K", "width" and "height". One pose per frame, or one for all."""
    use_cameras: str | None = None
    """Names of the input cameras, with commas; all by default."""
    context: int = 3
    """How many cameras colour a view and are the inpainter's context."""
    model: str | None = None
    """A shipped model's name or a model's folder; 'telea' and 'nearest' are the classical fills."""
    top_k: int | None = None
    """Context tokens that survive pruning: fewer is faster. All by default."""
    frames: str | None = None
    """Which frames, first:end, counted from 0; all by default."""
    align: bool = True
    """Take the calibration as it is. By default a shift of all images against it (a wrong convention for pixel
    centres, say) is looked for in the masks of the input cameras' first frame, and undone where they then agree."""
    device: str = "cpu"
    """Where to compute: cpu, or cuda."""
    json: bool = False
    """Write the scores as one JSON object to standard output and nothing else there."""


def run(options: Options) -> int:
    """Run the command; the exit code."""
    if (options.leave_out is None) == (options.path is None):
        raise ValueError("expected either --leave-out CAMERA or --path orbit|FILE, got both or none; give one of them")
    if options.context < 1:
        raise ValueError(f"expected --context of at least 1 camera, got {options.context}; the paper uses 3")
    if options.out.exists() and not options.out.is_dir():
        raise ValueError(f"{options.out}: expected a folder for the results, got a file; choose another --out")
    from viewmend.cli.console import print_json, say, track
    from viewmend.cli.mend_output import MendOutput
    from viewmend.cli.mend_summary import MendSummary
    from viewmend.cli.mending import Mender, load_named

    capture = _open(options)
    times = _times(options.frames, len(capture.frame_ids))
    inpainter = load_named(options.model, options.top_k, options.device)
    held = () if options.leave_out is None else (options.leave_out,)
    mender = Mender(inpainter, options.context, capture.bounds, held)
    summary = MendSummary()
    offset_px = _offset(options, capture, times[0]) if options.align else (0.0, 0.0)
    views = _views(options, capture, times, offset_px)
    with MendOutput(options.out, fps=capture.fps or 15.0) as output:
        for frame, target in track(views, "mending", _count(options, capture, times)):
            truth = frame.select(held) if set(held) & set(frame.cameras.names) else None
            step = mender.mend(frame.without(held), target, truth)
            summary.add(step)
            output.add(step)
    say(f"wrote {options.out}")
    if options.json:
        print_json(summary.as_json())
    else:
        print("\n".join(summary.in_words()))
    return 0


def _open(options: Options) -> "PlainCapture":
    from viewmend.capture.errors import CaptureError
    from viewmend.capture.plain import open_capture

    held = options.leave_out
    names = None
    if options.use_cameras is not None:
        names = [name.strip() for name in options.use_cameras.split(",") if name.strip()]
        names = list(dict.fromkeys(names + ([held] if held else [])))
    capture = open_capture(options.capture, names)
    if held is not None and held not in capture.cameras.names:
        raise CaptureError(f"{options.capture}: expected --leave-out among {list(capture.cameras.names)}, got '{held}'")
    if not capture.has_masks:
        raise CaptureError(
            f"{options.capture}: expected a 'mask' for every camera, got none: the visual hull is carved from them; "
            "segment the foreground and name the files in cameras.json"
        )
    inputs = len(capture.cameras) - (held is not None)
    if inputs < 2:
        raise CaptureError(f"{options.capture}: expected at least 2 input cameras, got {inputs}; use more cameras")
    return capture


def _offset(options: Options, capture: "PlainCapture", time: int) -> tuple[float, float]:
    """The shift of the calibration that the input cameras' masks ask for; it is said if there is one."""
    from viewmend.cli.console import say
    from viewmend.geometry.alignment import LEAST_IOU, shared_offset

    frame = capture.read(time).without([options.leave_out] if options.leave_out else [])
    if frame.mask is None or len(frame.cameras) < 2 or not bool((frame.mask > 0).any()):
        return (0.0, 0.0)
    found = shared_offset(frame.mask, frame.cameras, capture.bounds)
    if found.offset_px != (0.0, 0.0):
        x, y = found.offset_px
        say(
            f"all principal points moved by ({x:+.2f}, {y:+.2f}) pixels: hull and masks then agree better, IoU "
            f"{found.iou_before:.3f} -> {found.iou_after:.3f}; check first_pixel_center, or use --no-align"
        )
    if found.iou_after < LEAST_IOU:
        say(
            f"the hull hardly agrees with the masks of frame {time}, IoU {found.iou_after:.3f}: a mask or a camera is "
            "wrong; look at it with viewmend info --out"
        )
    return found.offset_px


def _times(frames: str | None, count: int) -> range:
    if frames is None:
        return range(count)
    first, colon, end = frames.partition(":")
    try:
        wanted = range(count)[slice(int(first) if first else None, int(end) if end else None)] if colon else range(0)
    except ValueError:
        wanted = range(0)
    if not len(wanted):
        raise ValueError(f"expected --frames first:end within 0:{count}, got '{frames}'; for example 0:{count}")
    return wanted


def _count(options: Options, capture: "PlainCapture", times: range) -> int:
    from viewmend.cli.novel_paths import STATIC_VIEWS

    return STATIC_VIEWS if options.path == "orbit" and len(capture.frame_ids) == 1 else len(times)


def _views(
    options: Options, capture: "PlainCapture", times: range, offset_px: tuple[float, float]
) -> "Iterator[tuple[MultiViewFrame, Cameras]]":
    """Each frame with the novel view's camera, in order of time; the rig's principal points are moved."""
    from viewmend.capture.prefetch import prefetch
    from viewmend.cli.novel_paths import paired, read_path

    if options.leave_out is not None:
        plan = [(time, capture.cameras.select([options.leave_out]).moved(*offset_px)) for time in times]
    elif options.path == "orbit":
        plan = _orbit(capture, times)
    else:
        plan = paired(read_path(Path(str(options.path)), capture.cameras), times)
    frames = prefetch(capture, times)
    frame = None
    for time, target in plan:
        if frame is None or frame.time != time:
            frame = next(frames)
            frame = replace(frame, cameras=frame.cameras.moved(*offset_px)).to(options.device)
        yield frame, target.to(options.device)


def _orbit(capture: "PlainCapture", times: range) -> "list[tuple[int, Cameras]]":
    from viewmend.cli.novel_paths import FRAMES_PER_TURN, STATIC_VIEWS, orbit_around, paired
    from viewmend.geometry.proxy import reconstruct

    first = capture.read(times[0])
    assert first.mask is not None, "captures without masks are refused"
    center = reconstruct(first.mask, first.cameras, capture.bounds).mesh.vertices.mean(0)
    views, turn = (STATIC_VIEWS, STATIC_VIEWS) if len(times) == 1 else (len(times), FRAMES_PER_TURN)
    return paired(orbit_around(center, capture.cameras, capture.up, views, turn), times)
