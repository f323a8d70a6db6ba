"""`viewmend masks`: masks for a capture that has none."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

if TYPE_CHECKING:
    import numpy as np

    from viewmend.capture.masks.maker import Rgb
    from viewmend.capture.masks.masked import MaskedCapture
    from viewmend.capture.plain import PlainCapture


@dataclass(frozen=True, kw_only=True)
class Options:
    """Write a capture that has no masks as a plain one that has; its own files stay as they are."""

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="CAPTURE")]
    """The capture's folder, of any format that is read."""
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """Folder for the plain capture with masks; it must not be in use."""
    method: Literal["plate", "model", "chroma", "alpha", "onnx"]
    """A clean plate, a model of the background, a green or blue screen, the images' alpha, or a network of yours."""
    plate: str | None = None
    """Clean plates: a path with {camera} in it, or a folder with an image or video named after each camera."""
    plate_frames: str | None = None
    """Frames of the capture that show no subject, as FIRST:END by index: their median is the plate."""
    model: Literal["learned", "mog2", "knn", "median"] = "learned"
    """The model: learned from all cameras together, OpenCV's mixtures or neighbours, or the median of some frames."""
    key: Literal["green", "blue"] = "green"
    """The screen's colour, for --method chroma."""
    dark: bool = False
    """With --method chroma: what is dark is background, too, as in a stage whose walls are black."""
    network: Path | None = None
    """A matting network as an ONNX file, for --method onnx: of one image, or of an image and its clean plate."""
    no_clean: bool = False
    """Leave the masks as the method gives them: one camera and one time know nothing of the others."""
    no_despill: bool = False
    """Leave the light of a green or blue screen on the subject's edges."""
    kind: str | None = None
    """The capture's format, as docs/formats.md names it; by default it is recognised."""
    frames: str | None = None
    """Which frames, as FIRST:END by index. Either may be left out."""
    cameras: tuple[str, ...] = ()
    """Names of the cameras to keep; by default all."""
    images: Literal["jpeg", "png"] = "jpeg"
    """Image files: smaller, or exact."""


def run(options: Options) -> int:
    """Run the command; the exit code."""
    from viewmend.capture.part import CapturePart
    from viewmend.capture.plain import open_capture
    from viewmend.capture.plain_writer import write_capture
    from viewmend.cli.checks import chosen_times
    from viewmend.cli.console import say, track

    _check(options)
    alpha = options.method == "alpha"
    capture = open_capture(options.source, options.cameras or None, options.kind, alpha=alpha)
    part = CapturePart(capture, chosen_times(options.frames, len(capture.frame_ids)))
    source = part if alpha else _masked(options, capture, part)
    write_capture(source, options.out, images=options.images, progress=lambda times: track(times, "masks"))
    say(f"{options.out}: masks of {len(part.cameras)} cameras, {len(part.frame_ids)} frames; look at them with")
    say(f"  viewmend info {options.out} --out check.png")
    return 0


def _check(options: Options) -> None:
    """ValueError where options do not go together."""
    from viewmend.capture.errors import CaptureError

    plates = (options.plate is not None) + (options.plate_frames is not None)
    if (options.method == "plate" and plates != 1) or plates > 1:
        raise ValueError("expected --plate or --plate-frames with --method plate; give one of them")
    if plates and options.method not in ("plate", "onnx"):
        raise ValueError(f"expected plates with --method plate or onnx, got --method {options.method}; leave them away")
    if (options.method == "onnx") != (options.network is not None):
        raise ValueError("expected --network with --method onnx, and with no other; give both or none")
    if options.out.exists() and not (options.out.is_dir() and not any(options.out.iterdir())):
        raise CaptureError(f"{options.out}: expected no such folder, or an empty one, got one in use; choose another")


def _masked(options: Options, capture: "PlainCapture", part) -> "MaskedCapture":
    from viewmend.capture.masks.chroma import KEYS, ChromaMasks
    from viewmend.capture.masks.masked import MaskedCapture
    from viewmend.capture.masks.network import NetworkMasks
    from viewmend.capture.masks.plate import PlateMasks

    names, clean = capture.cameras.names, not options.no_clean
    plates, unsure = _plates(options, capture)
    if options.method == "onnx":
        assert options.network is not None
        makers = {name: NetworkMasks(options.network, plates.get(name)) for name in names}
    elif options.method == "chroma":
        makers = {name: ChromaMasks(options.key, options.dark) for name in names}
        plates = {name: _screen(capture, name, KEYS[options.key]) for name in names}
    elif plates:
        makers = {name: PlateMasks(plate) for name, plate in plates.items()}
    else:
        makers = _models(options, capture)
    return MaskedCapture(part, makers, clean, unsure, None if options.no_despill or not plates else plates)


def _plates(options: Options, capture: "PlainCapture") -> tuple[dict[str, "Rgb"], dict[str, "np.ndarray"]]:
    """Each camera's plate as far as the options give one, and where a learned one is a guess."""
    from viewmend.capture.masks.learning import plates_of_capture
    from viewmend.capture.masks.plates import plates_from_files, plates_from_frames
    from viewmend.capture.plain import open_capture
    from viewmend.cli.checks import chosen_times
    from viewmend.cli.console import busy, track

    times = range(len(capture.frame_ids))
    if options.plate is not None:
        return plates_from_files(capture, options.plate), {}
    if options.plate_frames is not None:
        return plates_from_frames(capture, chosen_times(options.plate_frames, len(times))), {}
    if options.method != "model" or options.model != "learned":
        return {}, {}
    with busy("learning the background from all cameras"):
        learned = plates_of_capture(
            capture,
            times,
            lambda name: open_capture(options.source, [name], options.kind),
            lambda chosen: track(chosen, "the background"),
        )
    return {name: own.rgb for name, own in learned.items()}, {name: own.unsure for name, own in learned.items()}


def _models(options: Options, capture: "PlainCapture"):
    from viewmend.capture.masks.masked import view_rgb
    from viewmend.capture.masks.model import ModelMasks
    from viewmend.capture.masks.plates import spread
    from viewmend.cli.console import track

    assert options.model != "learned"
    makers = {name: ModelMasks(options.model, learning=False) for name in capture.cameras.names}
    for time in track(spread(range(len(capture.frame_ids))), "the background"):
        frame = capture.read(time)
        for view, name in enumerate(frame.cameras.names):
            makers[name].learn(view_rgb(frame, view))
    return makers


def _screen(capture: "PlainCapture", name: str, channel: int) -> "Rgb":
    """An image of nothing but the screen's colour."""
    import numpy as np

    width, height = capture.cameras.select([name]).max_size_px
    screen = np.zeros((height, width, 3), np.uint8)
    screen[..., channel] = 255
    return screen
