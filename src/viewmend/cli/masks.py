"""`viewmend masks`: masks for a capture that has none."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

if TYPE_CHECKING:
    from viewmend.capture.masks.maker import MaskMaker
    from viewmend.capture.plain import PlainCapture


@dataclass(frozen=True, kw_only=True)
class Options:
    """Write a capture that has no masks as a plain one that has; its own files stay as they are."""

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="CAPTURE")]
    """The capture's folder, of any format that is read."""
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """Folder for the plain capture with masks; it must not be in use."""
    method: Literal["plate", "model"]
    """A clean plate, or a model of the background that is learned from the frames."""
    plate: str | None = None
    """Clean plates: a path with {camera} in it, or a folder with an image or video named after each camera."""
    plate_frames: str | None = None
    """Frames of the capture that show no subject, as FIRST:END by index: their median is the plate."""
    model: Literal["mog2", "knn", "median"] = "knn"
    """The model of the background: OpenCV's mixtures or neighbours, or the median of some frames."""
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
    from viewmend.capture.masks.masked import MaskedCapture
    from viewmend.capture.part import CapturePart
    from viewmend.capture.plain import open_capture
    from viewmend.capture.plain_writer import write_capture
    from viewmend.cli.checks import chosen_times
    from viewmend.cli.console import say, track

    capture = open_capture(options.source, options.cameras or None, options.kind)
    part = CapturePart(capture, chosen_times(options.frames, len(capture.frame_ids)))
    masked = MaskedCapture(part, _makers(options, capture))
    write_capture(masked, options.out, images=options.images, progress=lambda times: track(times, "masks"))
    say(f"{options.out}: masks of {len(part.cameras)} cameras, {len(part.frame_ids)} frames")
    return 0


def _makers(options: Options, capture: "PlainCapture") -> dict[str, "MaskMaker"]:
    from viewmend.capture.masks.masked import view_rgb
    from viewmend.capture.masks.model import ModelMasks
    from viewmend.capture.masks.plate import PlateMasks
    from viewmend.capture.masks.plates import plates_from_files, plates_from_frames, spread
    from viewmend.cli.checks import chosen_times
    from viewmend.cli.console import track

    if options.method == "plate":
        if (options.plate is None) == (options.plate_frames is None):
            raise ValueError("expected --plate or --plate-frames with --method plate; give one of them")
        if options.plate is not None:
            plates = plates_from_files(capture, options.plate)
        else:
            plates = plates_from_frames(capture, chosen_times(options.plate_frames, len(capture.frame_ids)))
        return {name: PlateMasks(plate) for name, plate in plates.items()}
    makers = {name: ModelMasks(options.model, learning=False) for name in capture.cameras.names}
    for time in track(spread(range(len(capture.frame_ids))), "the background"):
        frame = capture.read(time)
        for view, name in enumerate(frame.cameras.names):
            makers[name].learn(view_rgb(frame, view))
    return dict(makers)
