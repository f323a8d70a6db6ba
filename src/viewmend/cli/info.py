"""`viewmend info`: what a capture or a model is, and whether a calibration is right."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

if TYPE_CHECKING:
    from viewmend.cli.capture_description import CaptureDescription


@dataclass(frozen=True, kw_only=True)
class Options:
    """Say what a capture or a model is; for a capture, also draw a picture that checks its calibration."""

    target: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="CAPTURE|MODEL")]
    """A capture folder (with cameras.json), or a model: a name or a folder with config.json and model.safetensors."""
    out: Path | None = None
    """Where to write the check picture of a capture (.png or .jpg)."""
    time: int = 0
    """Index of the frame to look at."""
    json: bool = False
    """Write one JSON object to standard output and nothing else there."""


def run(options: Options) -> int:
    """Run the command; the exit code."""
    from dataclasses import asdict

    from viewmend.cli import capture_description, model_description
    from viewmend.cli.console import print_json

    if _is_model(options.target):
        if options.out is not None:
            raise ValueError(f"expected --out with a capture, got the model {options.target}; leave --out away")
        model = model_description.describe_model(options.target)
        description, lines = asdict(model), model_description.in_words(model)
    else:
        capture = _look_at_capture(options)
        description, lines = asdict(capture), capture_description.in_words(capture)
    if options.json:
        print_json(description)
    else:
        print("\n".join(lines))
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


def _look_at_capture(options: Options) -> "CaptureDescription":
    from viewmend.capture.images import write_image
    from viewmend.capture.plain import open_capture
    from viewmend.cli.calibration_check import check_calibration, check_picture
    from viewmend.cli.capture_description import describe_capture
    from viewmend.cli.console import busy, say

    capture = open_capture(options.target)
    if not 0 <= options.time < len(capture.frame_ids):
        last = len(capture.frame_ids) - 1
        raise ValueError(f"{options.target}: expected --time of 0 to {last}, got {options.time}; choose again")
    with busy("carving the subject"):
        check = check_calibration(capture.read(options.time), capture.bounds)
    if options.out is not None:
        with busy("drawing the check picture"):
            write_image(options.out, check_picture(check, capture.up))
        say(f"wrote {options.out}")
    return describe_capture(capture, check)
