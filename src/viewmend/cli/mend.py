"""`viewmend mend`: render and inpaint novel views of a capture, and score them against a held-out camera."""

from dataclasses import asdict, dataclass, field
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from viewmend.cli.checks import Geometry, Precision, PreparationOptions, ViewOptions, check_least
from viewmend.utils.options import FLAT

if TYPE_CHECKING:
    from viewmend.data.camera_path import CameraPath, Turntable
    from viewmend.data.capture_folder import CaptureFolder
    from viewmend.data.prepare import PreparedCapture
    from viewmend.data.source import CaptureSource
    from viewmend.geometry.bounds import Bounds
    from viewmend.geometry.cameras import Cameras
    from viewmend.mending import Mender, MendSummary
    from viewmend.models.base import Inpainter
    from viewmend.rendering.view import RenderConfig
    from viewmend.scenes.held_out import Protocol


LARGE_PX = 1000
"""Images with more pixels than this on their longer side take long; `--scale` is then recommended."""
KEPT_MB = 300.0
"""Memory for earlier frames, in MB, if the model does not use them: they are kept because an orbit may show
a frame again."""
LARGE_BUFFER_BYTES = 32_000_000
"""Larger buffers get their own memory mappings. 32 MB is the largest threshold that glibc chooses by itself;
with the 8 MB of the live server, a video of 1080 x 1920 pixels takes a quarter longer."""
NO_INPUTS = (
    "expected a frame with two usable input cameras, got none; see the warnings, or choose other --frames"
)
"""The error message if no frame can be used."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """Render novel views of a capture and inpaint them.

    OUT gets the completed views (completed.mp4, or completed/*.png for a single view), the views as
    rendered (rendered/*.png), the error mask (holes/*.png, white where a pixel was to be
    completed), the true image of a held-out camera (true/*.png), rendered, completed and true views
    side by side (compared.mp4), and contact_sheet.png.

    With --leave-out, that camera's view is rendered without its image and mask, and then scored
    against them. PSNR, in dB, is given for the whole image, for the subject (inside the true mask),
    for pixels that a camera colours ("valid"), for holes, and for holes inside the true mask
    ("fg"). For comparison, it is also given for the whole image as rendered, and for holes that
    OpenCV's Telea fills. LPIPS (AlexNet) is given for the whole image and for the subject; with
    --json, also SSIM for the whole image, and the IoU of alpha and the true mask. All scores are
    means over frames. A score of holes skips frames in which it covers fewer than 50 pixels, unless
    all frames have fewer. hole_fraction is the fraction of the hull's pixels that are holes,
    completed_fraction the fraction that is completed.

    Images are composited on black for output and scores, or on white if the model was trained on
    white (paper-small).
    """

    capture: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="CAPTURE")]
    """A capture with masks, in any supported format."""
    out: Path
    """Folder for the results; created if missing. Results of an earlier run in it are replaced,
    other files kept."""
    leave_out: str | None = None
    """Name of a camera to hold out; its view is rendered from the others. Give either this or --path."""
    path: str | None = None
    """'orbit' circles the subject with its whole motion in view; options may follow, as in
    orbit:arc=180,seconds=6,fps=30,size=1280x720,loop=repeat,background=white. Or a JSON
    file with a list of 4x4 world_from_camera matrices (metres, OpenCV axes), or with an
    object of "world_from_camera" and optionally "K", "width", "height", "times" (the frame
    of each pose) and "fps", as the live page saves it. Without "times", one pose per
    frame, or one for all. A single frame (--frames 0:1) is shown from all poses."""
    cameras: tuple[str, ...] = ()
    """Names of the input cameras; all by default."""
    format: str | None = None
    """Format of the capture (docs/formats.md); recognised by default."""
    protocol: Literal["strict", "predicted-mask", "target-mask", "hull-with-target-mask"] | None = None
    """How the mask of the --leave-out camera is used. 'strict': not at all. 'predicted-mask': not at
    all, and the alpha that 'views' predicts replaces it. 'target-mask': to cut out and composite
    the view, as in the paper. 'hull-with-target-mask': only to carve the hull. By default
    'predicted-mask' for the paper's model, 'strict' for others."""
    view: Annotated[ViewOptions, FLAT] = field(default_factory=ViewOptions)
    model: str | None = None
    """A shipped model's name, a model's folder, or any method of `viewmend evaluate` ('telea',
    'reprojection', 'dstt-o-mul', FILE.py:NAME). By default 'views'."""
    top_k: int | None = None
    """Number of context tokens that the paper's model keeps when pruning; by default the model's
    own. Fewer is faster."""
    frames: str | None = None
    """Frames to use, as FIRST:END by index; all by default."""
    scale: float = 1.0
    """Factor by which width and height of the images are reduced, above 0 and up to 1. Output views
    are reduced, too, unless --path states their size. 0.5 takes about a quarter of the time, and less memory."""
    preparation: Annotated[PreparationOptions, FLAT] = field(default_factory=PreparationOptions)
    alpha: bool = False
    """Also write the subject as a cut-out: cutout/*.png with straight alpha, and cutout.webm (VP9
    with alpha) if videos are written. Alpha is the hull's mask if the model predicts none."""
    depth: bool = False
    """Also write z-depth, depth/*.png: 16 bit, millimetres, 0 where there is no subject, 65535 for
    65.535 m and more. It is the hull's depth if the model predicts none."""
    device: str = "cpu"
    """Device to compute on: cpu or cuda."""
    geometry: Geometry = "hull"
    """Geometry proxy: the visual 'hull' of the masks, or 'fused', the hull tightened by depth that
    the model 'views' predicts all around the subject. Fusing adds 3 to 7 seconds to each
    frame."""
    precision: Precision = "auto"
    """Number format of viewmend's own networks. 'auto' is bfloat16 if the model was
    trained in it and the device computes in it natively, otherwise float32."""
    json: bool = False
    """Write the scores to standard output as one JSON object, and nothing else."""

    @property
    def held(self) -> tuple[str, ...]:
        """The name of the --leave-out camera; empty without one."""
        return () if self.leave_out is None else (self.leave_out,)


def run(options: Options) -> int:
    """Run the command; returns the exit code."""
    _check(options)
    from viewmend.cli.checks import chosen_times, load_named
    from viewmend.data.camera_path import STATIC_FPS, pair_with_frames, parse_turntable
    from viewmend.mending import MendSummary, default_protocol
    from viewmend.utils.heap import configure_allocator

    configure_allocator(LARGE_BUFFER_BYTES)

    # Open and prepare the capture. Options, and a file of poses, are checked before any frame is read.
    render = options.view.config()
    turntable = parse_turntable(options.path or "")
    held = options.held
    opened = _open(options, held)
    times = chosen_times(options.frames, len(opened.frame_ids))
    usable = _find_usable_frames(opened, times, held)
    full_size_px = opened.cameras[0].max_size_px
    if options.path is not None and turntable is None:
        pair_with_frames(_read_path(options, opened, full_size_px), times)
    inpainter = load_named(options.model, options.device, options.precision)
    protocol = options.protocol or default_protocol(inpainter)
    capture = _prepare(options, opened, held, usable)

    # Render, complete and score the views
    mender = _make_mender(options, render, inpainter, capture.bounds, held, protocol)
    if turntable is not None and turntable.background:
        mender.background = turntable.background
    plan, planned_fps = _plan(options, capture, times, usable, turntable, full_size_px)
    fps = planned_fps or capture.fps or STATIC_FPS
    summary = MendSummary(protocol)
    _mend_views(options, mender, capture, plan, fps, summary)
    _report(options, capture, plan, summary)
    return 0


def _mend_views(
    options: Options,
    mender: "Mender",
    capture: "PreparedCapture",
    plan: "list[tuple[int, Cameras]]",
    fps: float,
    summary: "MendSummary",
) -> None:
    """Complete and write all views, and add them to the summary."""
    from viewmend.cli.console import announce_duration, say, track
    from viewmend.cli.mend_output import MendOutput
    from viewmend.data.source import prefetch
    from viewmend.utils.heap import HeapTrimmer

    held = options.held
    plan_times = [time for time, _ in plan]
    # Successive views of one frame share it, so it is read once.
    frames = prefetch(capture, [time for time, _ in groupby(plan_times)])
    frame = None
    skipped: set[int] = set()
    num_unseen = 0
    trimmer = HeapTrimmer()
    with MendOutput(options.out, fps, options.alpha, options.depth) as output:
        if output.replaces:
            say(f"{options.out}: the results of an earlier run will be replaced")
        views = announce_duration(plan, "views", _speed_advice(options, capture.cameras))
        for time, target in track(views, "inpainting", total=len(plan)):
            if frame is None or frame.time != time:
                frame = next(frames).to(options.device)
            inputs = frame.without(held)
            if len(inputs.cameras) < 2:  # preparation has left out cameras with unusable images or masks
                skipped.add(time)
                continue
            has_truth = any(name in frame.cameras.names for name in held)
            truth = frame.select(held) if has_truth else None
            num_unseen += bool(held) and truth is None
            step = mender.mend(inputs, target.to(options.device), truth)
            summary.add(step)
            output.add(step)
            trimmer.trim_if_due(idle=False)
        if not summary.frames:
            raise ValueError(f"{capture.name}: {NO_INPUTS}")
    if skipped:
        count = f"{len(skipped)} of {len(set(plan_times))} frames"
        first = capture.frame_ids[min(skipped)]
        say(f"{count} have fewer than two usable input cameras and were skipped; the first is '{first}'")
    if num_unseen:
        count = f"{num_unseen} of {summary.frames} views"
        say(f"{count} have no usable image of '{held[0]}': they are made without its mask, and not scored")


def _report(
    options: Options,
    capture: "PreparedCapture",
    plan: "list[tuple[int, Cameras]]",
    summary: "MendSummary",
) -> None:
    """Print where the results are, which frames were empty, and the scores."""
    from viewmend.cli.checks import without_subject
    from viewmend.cli.console import print_json, say, show
    from viewmend.cli.mend_output import as_text

    say(f"wrote {options.out}")
    if summary.empty:
        num_frames = len({time for time, _ in plan})
        empty_frames = without_subject(capture, summary.empty, num_frames)
        say(f"{empty_frames}; they show the background")
    if options.json:
        print_json(summary.as_json())
    else:
        show(*as_text(summary))


def _check(options: Options) -> None:
    """Raise a ValueError for options that contradict each other or are out of range."""
    if (options.leave_out is None) == (options.path is None):
        raise ValueError(
            "expected either --leave-out CAMERA or --path orbit|FILE, got both or neither; give one of them"
        )
    if options.leave_out is None and options.protocol not in (None, "strict", "predicted-mask"):
        raise ValueError(
            f"expected --leave-out with --protocol {options.protocol}, got --path; omit --protocol"
        )
    if options.out.exists() and not options.out.is_dir():
        raise ValueError(
            f"{options.out}: expected a folder for the results, got a file; choose another --out"
        )
    check_least(options, top_k=1)
    if not 0 < options.scale <= 1:
        raise ValueError(f"expected --scale above 0 and up to 1, got {options.scale}; for example 0.5")


def _speed_advice(options: Options, cameras: "Cameras") -> str:
    """Advice that shortens a long run; "" for images that are small already."""
    size_px = max(cameras.max_size_px)
    if options.scale < 1 or size_px <= LARGE_PX:
        return ""
    tenths = max(1, 10 * LARGE_PX // size_px)
    return f"images have {size_px} pixels along their longer side, and --scale {tenths / 10} is faster"


def _open(options: Options, held: tuple[str, ...]) -> "CaptureFolder":
    """Open the capture with the input cameras and the held-out one.

    Raises:
        CaptureError: it cannot be used, or does not have these cameras.
    """
    from viewmend.data.errors import CaptureError
    from viewmend.data.prepare import open_masked

    names = None
    if options.cameras:
        names = list(dict.fromkeys([*options.cameras, *held]))  # without duplicates
    capture = open_masked(options.capture, names, held=len(held), format=options.format)
    if not set(held) <= set(capture.cameras.names):
        known = list(capture.cameras.names)
        got = options.leave_out
        raise CaptureError(f"{options.capture}: expected --leave-out among {known}, got '{got}'")
    return capture


def _prepare(
    options: Options, opened: "CaptureFolder", held: tuple[str, ...], usable: list[int]
) -> "PreparedCapture":
    """The capture at the requested scale, aligned and checked by its input cameras."""
    from viewmend.cli.checks import log_preparation
    from viewmend.data.prepare import prepare
    from viewmend.data.source import CaptureSubset

    inputs = [name for name in opened.cameras.names if name not in held]
    source = opened
    if options.scale < 1:
        source = CaptureSubset(opened, range(len(opened.frame_ids)), options.scale)
    capture = prepare(source, inputs, **asdict(options.preparation), first=usable[0], last=usable[-1])
    log_preparation(capture)
    return capture


def _make_mender(
    options: Options,
    render: "RenderConfig",
    inpainter: "Inpainter",
    bounds: "Bounds | None",
    held: tuple[str, ...],
    protocol: "Protocol",
) -> "Mender":
    """Create the pipeline, with a model that predicts errors if the options need one."""
    from viewmend.mending import Mender
    from viewmend.models.base import RenderQuality
    from viewmend.models.registry import error_model_for
    from viewmend.stream import StreamConfig

    error_model = None
    if render.error_rule == "predicted" or options.geometry == "fused" or protocol == "predicted-mask":
        error_model = error_model_for(inpainter, options.device, options.precision)
    memory_mb = None if inpainter.window_frames else KEPT_MB
    config = StreamConfig(geometry=options.geometry, render=render, memory_mb=memory_mb)
    quality = RenderQuality(top_k=options.top_k)
    return Mender(inpainter, config, bounds, held, quality, error_model, protocol)


def _find_usable_frames(capture: "CaptureFolder", times: range, held: tuple[str, ...]) -> list[int]:
    """The frames with images of two or more input cameras; reports the others, which are skipped.

    Raises:
        ValueError: there is no such frame.
    """
    from viewmend.cli.console import say

    inputs = [view for view, name in enumerate(capture.cameras.names) if name not in held]
    usable = [time for time in times if capture.present[inputs, time].sum() >= 2]
    left_out = [capture.frame_ids[time] for time in times if time not in usable]
    if not usable:
        raise ValueError(
            f"{capture.name}: expected a frame with two input cameras, got none; choose other --frames"
        )
    if left_out:
        count = f"{len(left_out)} of {len(times)} frames"
        say(
            f"{count} have fewer than two input cameras and are skipped, which shortens the result; "
            f"the first is '{left_out[0]}'"
        )
    return usable


def _plan(
    options: Options,
    capture: "CaptureSource",
    times: range,
    usable: list[int],
    turntable: "Turntable | None",
    full_size_px: tuple[int, int],
) -> "tuple[list[tuple[int, Cameras]], float | None]":
    """The frame and the camera of each view, in order, and the views per second that --path asks for, if any.

    Views of frames that are not usable are left out.
    """
    from viewmend.data.camera_path import pair_with_frames

    if options.leave_out is not None:
        return [(time, capture.cameras.select([options.leave_out])) for time in usable], None
    if turntable is not None:
        return _circle(turntable, capture, usable), turntable.fps
    path = _read_path(options, capture, full_size_px)
    return [(time, camera) for time, camera in pair_with_frames(path, times) if time in usable], path.fps


def _read_path(options: Options, capture: "CaptureSource", full_size_px: tuple[int, int]) -> "CameraPath":
    """Read the file of --path; `full_size_px` is the first camera's, before --scale.

    Raises:
        ValueError: the file has other content.
    """
    from viewmend.data.camera_path import read_camera_path
    from viewmend.data.capture_folder import origin_of

    return read_camera_path(Path(str(options.path)), capture.cameras, origin_of(capture), full_size_px)


def _circle(
    turntable: "Turntable", capture: "CaptureSource", usable: list[int]
) -> "list[tuple[int, Cameras]]":
    """The frame and the camera of each view of a turntable; each image has room for the whole motion."""
    import math

    import torch

    from viewmend.geometry.orbit import coarse_surface, fit_to, orbit_around, thinned

    # Find what the subject covers in the frames that are shown, or a sample of them.
    times = turntable.times(usable, capture.fps)
    points = []
    for time in thinned(sorted(set(times))):
        frame = capture.read(time)
        assert frame.mask is not None, "captures without masks are refused"
        if len(frame.cameras) >= 2:
            points.append(coarse_surface(frame.mask, frame.cameras, capture.bounds))
    if not points:
        raise ValueError(f"{capture.name}: {NO_INPUTS}")
    extent = torch.cat(points)
    if not len(extent):
        raise ValueError(
            f"{capture.name}: expected a subject to circle, got none in these frames; choose other --frames"
        )

    # Circle the middle of what the subject covers.
    center = (extent.amin(0) + extent.amax(0)) / 2
    orbit = orbit_around(
        center,
        capture.cameras,
        capture.up,
        views=len(times),
        frames_per_turn=len(times),
        arc_rad=None if turntable.arc is None else math.radians(turntable.arc),
        size_px=turntable.size_px,
    )
    path = fit_to(orbit, extent)
    return [(time, path[view]) for view, time in enumerate(times)]
