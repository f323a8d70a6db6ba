"""`viewmend mend`: novel views of a capture, rendered and mended, and scored against a camera that was left out."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

if TYPE_CHECKING:
    from viewmend.capture.source import CaptureSource
    from viewmend.evaluation.mending import MendSummary, Metric
    from viewmend.geometry.cameras import Cameras


@dataclass(frozen=True, kw_only=True)
class Options:
    """Render novel views of a capture and fill their holes.

    OUT gets the mended views (mended.mp4, or mended/*.png for one view or without PyAV), the views as they were
    rendered (rendered/*.png), E (holes/*.png, white where a pixel was to be mended), the truth of a camera that is
    left out (truth/*.png), all beside each other (compared.mp4) and contact_sheet.png.

    With --leave-out the view is that of a camera whose image and mask are used for nothing else, and is scored against
    it: PSNR in dB of the whole image (also as it was rendered, and with nothing but the holes mended: unseen), of the
    subject (inside the true mask), of the pixels that a camera coloured (valid), and of those that none did (holes; fg:
    those inside the true mask), these also for OpenCV's Telea fill; SSIM of the whole image; the IoU of alpha with the
    true mask. PSNRs are means over frames, in the holes over frames with at least 50 such pixels (if there are any);
    hole_fraction is the holes' share of the hull's pixels, mended_fraction that of those with E > 0.

    All is shown and scored upon black; upon white by a model that paints upon white (paper-small, as the paper's).
    """

    capture: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="CAPTURE")]
    """A capture of any format that is read, with masks."""
    out: Path
    """Folder for the results; it is made if it is not there."""
    leave_out: str | None = None
    """Name of the camera to leave out, whose view is rendered. Either this or --path."""
    path: str | None = None
    """'orbit', or a JSON file: a list of 4x4 world_from_camera matrices (metres, OpenCV axes), or an object with
    "world_from_camera" and, if wanted, "K", "width" and "height". One pose per frame, or one for all."""
    use_cameras: str | None = None
    """Names of the input cameras, with commas; all by default."""
    kind: str | None = None
    """The capture's format, as docs/formats.md names it; by default it is recognised."""
    context: int = 3
    """How many cameras colour a view and are the inpainter's context."""
    error_rule: str | None = None
    """What is mended: 'unseen', the pixels that no camera colours; 'all' of the subject, for models that keep by
    themselves what is right; 'wrong', what a model takes for wrong; or a rule of your own, FILE.py:NAME. By default
    what the model is made for."""
    wrong_fraction: float = 0.15
    """Error rule 'wrong': at most this part of the subject is mended, beside what no camera colours."""
    model: str | None = None
    """What fills the holes: a shipped model's name or a model's folder, or any method that `viewmend evaluate` takes
    ('telea', 'reprojection', 'dstt-o-mul', FILE.py:NAME)."""
    top_k: int | None = None
    """Context tokens that survive pruning: fewer is faster. All by default."""
    frames: str | None = None
    """Which frames, first:end, counted from 0; all by default."""
    align: bool = True
    """Take the calibration as it is. By default a shift of all images against it (a wrong convention for pixel
    centres, say) is looked for in the masks of the input cameras' first frame, and undone where they then agree."""
    match_colours: bool = True
    """Leave the cameras' colours as they are. By default those of the input cameras are matched to one another, by the
    first frame, where they then agree better on surface that nothing was fitted to."""
    alpha: bool = False
    """Also cut the subject out: cutout/*.png, RGB and alpha (colours not multiplied by it), and cutout.webm, VP9 with
    alpha, where a film is written. Alpha is the proxy's mask where the model does not tell."""
    depth: bool = False
    """Also write z-depth, depth/*.png: 16 bit, millimetres, 0 where there is no subject, 65535 for 65.535 m and
    farther. It is the proxy's where the model tells none of its own."""
    device: str = "cpu"
    """Where to compute: cpu, or cuda."""
    json: bool = False
    """Write the scores as one JSON object to standard output and nothing else there."""


STATIC_VIEWS = 60
"""Views of an orbit around a capture of one frame."""
FRAMES_PER_TURN = 150


def run(options: Options) -> int:
    """Run the command; the exit code."""
    if (options.leave_out is None) == (options.path is None):
        raise ValueError("expected either --leave-out CAMERA or --path orbit|FILE, got both or none; give one of them")
    if options.context < 1:
        raise ValueError(f"expected --context of at least 1 camera, got {options.context}; the paper uses 3")
    if options.out.exists() and not options.out.is_dir():
        raise ValueError(f"{options.out}: expected a folder for the results, got a file; choose another --out")
    from viewmend.capture.prefetch import prefetch
    from viewmend.capture.prepare import prepare
    from viewmend.cli.checks import load_named
    from viewmend.cli.console import print_json, say, show, track
    from viewmend.cli.mend_output import MendOutput
    from viewmend.cli.prepared import say_prepared
    from viewmend.evaluation.mending import Mender, MendSummary
    from viewmend.inpainting.protocol import RenderQuality
    from viewmend.rendering.view import RenderConfig

    render = RenderConfig(cameras=options.context, error_rule=options.error_rule, wrong_fraction=options.wrong_fraction)
    held = () if options.leave_out is None else (options.leave_out,)
    opened = _open(options, held)
    times = _times(options.frames, len(opened.frame_ids))
    if options.top_k is not None and options.top_k < 1:
        raise ValueError(f"expected --top-k of at least 1 token, got {options.top_k}; leave it away to keep all")
    inpainter = load_named(options.model, options.device)
    inputs = [name for name in opened.cameras.names if name not in held]
    capture = prepare(opened, inputs, align=options.align, match_colours=options.match_colours, first=times[0])
    say_prepared(capture)
    mender = Mender(inpainter, render, capture.bounds, held, RenderQuality(top_k=options.top_k))
    summary = MendSummary()
    plan, frames, frame = _plan(options, capture, times), prefetch(capture, times), None
    with MendOutput(options.out, capture.fps or 15.0, options.alpha, options.depth) as output:
        for time, target in track(plan, "mending"):
            if frame is None or frame.time != time:
                frame = next(frames).to(options.device)
            truth = frame.select(held) if set(held) & set(frame.cameras.names) else None
            step = mender.mend(frame.without(held), target.to(options.device), truth)
            summary.add(step)
            output.add(step)
    say(f"wrote {options.out}")
    if options.json:
        print_json(summary.as_json())
    else:
        show(*_in_words(summary))
    return 0


def _in_words(summary: "MendSummary") -> list[str]:
    from viewmend.cli.console import in_db

    iou = [value for values in summary.hull_iou.values() for value in values]
    lines = [
        f"{summary.frames} view{'s' if summary.frames != 1 else ''}; holes {100 * (summary.hole_fraction or 0):.2f} % "
        f"of the hull's pixels, {100 * (summary.mended_fraction or 0):.2f} % asked to be mended; "
        f"hull IoU {sum(iou) / len(iou):.3f}, lowest {min(iou):.3f}",
        "a frame takes " + ", ".join(f"{name} {ms:.1f} ms" for name, ms in summary.stage_ms().items()),
    ]
    if summary.mean("ours", "psnr_whole") is None:
        return lines
    whole = [in_db(summary.mean(fill, "psnr_whole")) for fill in ("ours", "unfilled", "unseen")]
    lines += [
        f"PSNR upon {summary.background}, dB",
        f"  whole image           {whole[0]}   rendered {whole[1]}   holes alone mended {whole[2]}",
    ]
    lines.append(f"  subject               {in_db(summary.mean('ours', 'psnr_subject'))}")
    lines.append(f"  coloured pixels       {in_db(summary.mean('ours', 'psnr_valid'))}")
    holes: dict[str, Metric] = {"holes": "psnr_holes", "holes on the subject": "psnr_holes_fg"}
    for kind, metric in holes.items():
        ours, telea = summary.mean("ours", metric), summary.mean("telea", metric)
        lines.append(f"  {kind:<20}  {in_db(ours)}   Telea {in_db(telea)}")
    return lines


def _open(options: Options, held: tuple[str, ...]) -> "CaptureSource":
    from viewmend.capture.errors import CaptureError
    from viewmend.capture.prepare import open_masked

    names = None
    if options.use_cameras is not None:
        names = [name.strip() for name in options.use_cameras.split(",") if name.strip()]
        names = list(dict.fromkeys([*names, *held]))
    capture = open_masked(options.capture, names, held=len(held), kind=options.kind)
    if not set(held) <= set(capture.cameras.names):
        known, got = list(capture.cameras.names), options.leave_out
        raise CaptureError(f"{options.capture}: expected --leave-out among {known}, got '{got}'")
    return capture


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


def _plan(options: Options, capture: "CaptureSource", times: range) -> "list[tuple[int, Cameras]]":
    """Which time is looked at from where, in order of time."""
    from viewmend.capture.camera_path import paired, read_path

    if options.leave_out is not None:
        return [(time, capture.cameras.select([options.leave_out])) for time in times]
    if options.path == "orbit":
        return paired(_orbit(capture, times), times)
    return paired(read_path(Path(str(options.path)), capture.cameras), times)


def _orbit(capture: "CaptureSource", times: range) -> "Cameras":
    from viewmend.geometry.orbit import orbit_around
    from viewmend.geometry.proxy import reconstruct

    first = capture.read(times[0])
    assert first.mask is not None, "captures without masks are refused"
    center = reconstruct(first.mask, first.cameras, capture.bounds).mesh.vertices.mean(0)
    views, turn = (STATIC_VIEWS, STATIC_VIEWS) if len(times) == 1 else (len(times), FRAMES_PER_TURN)
    return orbit_around(center, capture.cameras, capture.up, views, turn)
