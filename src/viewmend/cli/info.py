"""`viewmend info`: what a capture or a model is, and whether a calibration is right."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

if TYPE_CHECKING:
    from viewmend.capture.description import CameraDescription, CaptureDescription
    from viewmend.inpainting.description import ModelDescription

DOUBTFUL_IOU = 0.8
"""Below this, a calibration or a mask is wrong more often than not."""
TRIED_PX = 64
"""Width and height of what a model is tried on."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """Say what a capture or a model is; for a capture, also draw a picture that checks its calibration.

    A model mends a small view: one whose weights make no finite colours is refused.
    """

    target: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="CAPTURE|MODEL")]
    """A capture of any format that is read, or a model: a name or a folder with config.json and model.safetensors."""
    kind: str | None = None
    """The capture's format, as docs/formats.md names it; by default it is recognised."""
    out: Path | None = None
    """Where to write the check picture of a capture (.png or .jpg)."""
    time: int = 0
    """Index of the frame to look at."""
    json: bool = False
    """Write one JSON object to standard output and nothing else there."""


def run(options: Options) -> int:
    """Run the command; the exit code."""
    from dataclasses import asdict

    from viewmend.cli.console import print_json, show
    from viewmend.inpainting.description import describe_model

    if _is_model(options.target):
        if options.out is not None:
            raise ValueError(f"expected --out with a capture, got the model {options.target}; leave --out away")
        model = describe_model(options.target)
        _try_out(options.target)
        description, lines = asdict(model), _model_in_words(model)
    else:
        capture = _look_at_capture(options)
        description, lines = asdict(capture), _capture_in_words(capture)
    if options.json:
        print_json(description)
    else:
        show(*lines)
    return 0


def _is_model(target: str) -> bool:
    from viewmend.inpainting.checkpoint import CONFIG, WEIGHTS, shipped_models

    folder = Path(target)
    if not folder.exists() and target not in shipped_models():
        raise ValueError(
            f"expected a capture folder (with cameras.json), a model's folder or one of the models "
            f"{list(shipped_models())}, got '{target}', which is none; check the path"
        )
    if (folder / "cameras.json").exists():
        return False
    return not folder.exists() or any((folder / name).exists() for name in (CONFIG, WEIGHTS))


def _try_out(model: str) -> None:
    """Have a model mend a small view, so that weights that make no finite colours show.

    Raises:
        ValueError: they do.
    """
    from viewmend.cli.console import busy
    from viewmend.inpainting.checkpoint import load_inpainter
    from viewmend.stream import Stream
    from viewmend.studio.rigs import orbit
    from viewmend.studio.stage import Studio, StudioConfig

    with busy("trying the model out"):
        stream = Stream(load_inpainter(model))
        stream.push(Studio(StudioConfig(cameras=4, frames=1, size_px=TRIED_PX)).read(0))
        stream.view(orbit([0.4], (TRIED_PX, TRIED_PX), elevation_rad=0.2))


def _look_at_capture(options: Options) -> "CaptureDescription":
    from viewmend.atomic_writes import remove_half_of
    from viewmend.capture.calibration_check import check_calibration, check_picture
    from viewmend.capture.description import describe_capture
    from viewmend.capture.images import write_image
    from viewmend.capture.plain import open_capture
    from viewmend.cli.console import busy, say

    capture = open_capture(options.target, kind=options.kind)
    if not 0 <= options.time < len(capture.frame_ids):
        last = len(capture.frame_ids) - 1
        raise ValueError(f"{options.target}: expected --time of 0 to {last}, got {options.time}; choose again")
    with busy("carving the subject"):
        check = check_calibration(capture.read(options.time), capture.bounds)
    if options.out is not None:
        remove_half_of(options.out)
        with busy("drawing the check picture"):
            write_image(options.out, check_picture(check, capture.up))
        say(f"wrote {options.out}")
    return describe_capture(capture, check)


def _model_in_words(model: "ModelDescription") -> list[str]:
    width = max(len(key) for key in model.config)
    lines = [f"{model.path}: an inpainting model of {model.parameters / 1e6:.2f} million parameters", ""]
    lines += [f"  {key:<{width}}  {value}" for key, value in model.config.items()]
    card = model.card.strip() if model.card else "There is no model card: what trained it is not known."
    return [*lines, "", *card.split("\n")]


def _capture_in_words(capture: "CaptureDescription") -> list[str]:
    sizes = sorted({(camera.width, camera.height) for camera in capture.cameras})
    fps = "unknown fps" if capture.fps is None else f"{capture.fps:g} fps"
    bounds, iou = capture.bounds_m, capture.hull_iou_mean
    lines = [
        f"{capture.name}: a capture of {len(capture.cameras)} cameras",
        f"  images    {', '.join(f'{w} x {h}' for w, h in sizes)}",
        f"  frames    {_frames(capture)}{'' if capture.frames == 1 else ', ' + fps}",
        f"  masks     {'yes' if capture.masks else 'none (viewmend masks makes them)'}",
        f"  depth     {'yes' if capture.depth else 'none'}",
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
    if capture.findings:
        lines += ["", "  wrong:", *(f"  - {text}" for text in capture.findings)]
    return lines


def _frames(capture: "CaptureDescription") -> str:
    if capture.frames == 1:
        return f"1 ('{capture.first_frame}'), static"
    return f"{capture.frames}, '{capture.first_frame}' to '{capture.last_frame}'"


def _gaps(capture: "CaptureDescription") -> str:
    if not capture.gaps:
        return "none"
    first = ", ".join(f"{camera} at '{frame}'" for camera, frame in capture.gaps[:3])
    return f"{len(capture.gaps)}: {first}{', ...' if len(capture.gaps) > 3 else ''}"


def _verdict(iou: float) -> str:
    if iou >= DOUBTFUL_IOU:
        return ""
    return "; low: check axes, units, K, distortion and the masks in the picture of --out"


def _camera(camera: "CameraDescription") -> str:
    iou = "" if camera.hull_iou is None else f"  IoU {camera.hull_iou:.3f}"
    size = f"{camera.width} x {camera.height}"
    return f"{size:<12} focal {camera.focal_px[0]:7.1f} px  {camera.fov_x_deg:5.1f} deg wide{iou}"


def _numbers(values: Sequence[float], digits: int = 2) -> str:
    return f"({', '.join(f'{value:.{digits}f}' for value in values)})"


def _extent(values: Sequence[float]) -> str:
    return " x ".join(f"{value:.3g}" for value in values)
