"""`viewmend masks`: masks for a capture that has none."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

if TYPE_CHECKING:
    from viewmend.data.capture_folder import CaptureFolder
    from viewmend.preprocess.masks.maker import Rgb
    from viewmend.preprocess.masks.masked import MaskedCapture


@dataclass(frozen=True, kw_only=True)
class Options:
    """Make masks for a capture that has none and write it, with masks, to a new folder."""

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="CAPTURE")]
    """Folder of the capture, in any supported format."""
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """New folder for the capture with masks."""
    method: Literal["person", "plate", "chroma", "alpha", "onnx"] = "person"
    """person: a person-segmentation network, needs nothing else. plate: difference from a clean
    plate. chroma: green or blue screen. alpha: the images' alpha channel. onnx: a matting network
    of your own."""
    plate: str | None = None
    """Clean plates: a path with {camera} in it, or a folder with an image or video named
    after each camera."""
    plate_frames: str | None = None
    """Frames without the subject, as FIRST:END by index; their median is the clean plate."""
    key: Literal["green", "blue"] = "green"
    """Colour of the screen, for --method chroma."""
    dark: bool = False
    """Treat dark pixels as background too, for stages with black walls (with --method chroma)."""
    network: Path | None = None
    """ONNX file for --method onnx: a matting network that takes an image, or an image and its clean plate."""
    no_clean: bool = False
    """Do not use other cameras and neighbouring frames to correct masks."""
    no_despill: bool = False
    """Do not remove colour that a green or blue screen, or a plate, casts on the outline."""
    format: str | None = None
    """Format of the capture (docs/formats.md); recognised by default."""
    frames: str | None = None
    """Frames to keep, as FIRST:END by index. Either may be omitted."""
    cameras: tuple[str, ...] = ()
    """Names of the cameras to keep; all by default."""
    images: Literal["jpeg", "png"] = "jpeg"
    """Image files: jpeg is smaller, png is lossless."""


def run(options: Options) -> int:
    """Run the command and return the exit code."""
    from viewmend.cli.checks import chosen_times, without_subject
    from viewmend.cli.console import say, track
    from viewmend.data.capture_folder import open_capture
    from viewmend.data.errors import CaptureError
    from viewmend.data.native_writer import write_capture
    from viewmend.data.source import CaptureSubset

    _check(options)
    alpha = options.method == "alpha"
    masks = "alpha" if alpha else "none"
    capture = open_capture(options.source, options.cameras or None, options.format, masks=masks)
    part = CaptureSubset(capture, chosen_times(options.frames, len(capture.frame_ids)))
    masked = None if alpha else _masked(options, capture, part)
    empty = write_capture(
        masked or part,
        options.out,
        images=options.images,
        progress=lambda times: track(times, "masks"),
        read_unmasked=None if masked is None else masked.take_unmasked,
    )
    if len(empty) == len(part.frame_ids):
        got = f"none in {len(empty)} frame{'s' if len(empty) > 1 else ''}"
        raise CaptureError(
            f"{options.out}: expected a subject, got {got}; remove the folder and try another --method"
        )
    if empty:
        say(f"{without_subject(part, empty, len(part.frame_ids))}; their masks are empty")
    for text in [] if masked is None else _describe_notes(masked):
        say(text)
    frames = len(part.frame_ids)
    bare = [] if masked is None else [n for n, times in masked.notes.without.items() if len(times) == frames]
    cameras = len(part.cameras) - len(bare)
    say(
        f"{options.out}: masks of {cameras} cameras, {frames} frame{'s' if frames > 1 else ''}; check them with"
    )
    say(f"  viewmend check {options.out} --out check.png")
    return 0


def _describe_notes(masked: "MaskedCapture") -> list[str]:
    """Lines about what the comparison of cameras has changed; cameras with the same change share a line."""
    notes = masked.notes
    ids = masked.frame_ids
    alike: dict[tuple[str, str], list[str]] = {}

    def note(name: str, times: Iterable[int], text: str) -> None:
        first, *rest = sorted(times)
        where = f" in {len(rest) + 1} of {len(ids)} frames, the first '{ids[first]}'" if len(ids) > 1 else ""
        alike.setdefault((where, text), []).append(f"'{name}'")

    for name, times in notes.remade.items():
        note(
            name,
            times,
            "no person detected, or not the one that the other cameras see; segmented where these see one",
        )
    for name, kept_at in notes.bystanders.items():
        x, y = kept_at[min(kept_at)]
        note(name, kept_at, f"several people; kept the one at ({x}, {y}) px, which the other cameras see too")
    for name, causes in notes.without.items():
        note(name, causes, f"{causes[min(causes)]}; written without a mask, and not used")
    texts = [f"{', '.join(names)}{where}: {text}" for (where, text), names in alike.items()]
    if notes.several:
        count = f"{len(notes.several)} of {len(ids)} frames"
        texts.append(f"{count} have several people that most cameras see; all of them are kept")
    return texts


def _check(options: Options) -> None:
    """Raise ValueError if options contradict each other."""
    from viewmend.data.native_writer import check_new_folder

    plates = (options.plate is not None) + (options.plate_frames is not None)
    if (options.method == "plate" and plates != 1) or plates > 1:
        raise ValueError(
            f"expected one of --plate and --plate-frames, got {'both' if plates else 'none'}; give one of them"
        )
    if plates and options.method not in ("plate", "onnx"):
        raise ValueError(
            f"expected plates only with --method plate or onnx, got --method {options.method}; drop them"
        )
    if (options.method == "onnx") != (options.network is not None):
        raise ValueError("expected --network with --method onnx and with no other; give both or neither")
    check_new_folder(options.out)


def _masked(options: Options, capture: "CaptureFolder", part) -> "MaskedCapture":
    from viewmend.cli.checks import chosen_times
    from viewmend.preprocess.masks.maker import KEYS, ChromaMasks
    from viewmend.preprocess.masks.masked import MaskedCapture
    from viewmend.preprocess.masks.network import NetworkMasks
    from viewmend.preprocess.masks.person import PersonMasks, mask_near
    from viewmend.preprocess.masks.plate import PlateMasks, plates_from_files, plates_from_frames

    names = capture.cameras.names
    plates = {}
    if options.plate is not None:
        plates = plates_from_files(capture, options.plate)
    elif options.plate_frames is not None:
        plates = plates_from_frames(capture, chosen_times(options.plate_frames, len(capture.frame_ids)))
    if options.method == "person":
        makers = {name: PersonMasks() for name in names}
        return MaskedCapture(part, makers, "none" if options.no_clean else "parts", mask_near=mask_near)
    if options.method == "onnx":
        assert options.network is not None
        makers = {name: NetworkMasks(options.network, plates.get(name)) for name in names}
    elif options.method == "chroma":
        makers = {name: ChromaMasks(options.key, options.dark) for name in names}
        plates = {name: _screen(capture, name, KEYS[options.key]) for name in names}
    else:
        makers = {name: PlateMasks(plate) for name, plate in plates.items()}
    screens = None if options.no_despill or not plates else plates
    return MaskedCapture(part, makers, "none" if options.no_clean else "pixels", screens)


def _screen(capture: "CaptureFolder", name: str, channel: int) -> "Rgb":
    """A plain image in the colour of the screen."""
    import numpy as np

    width, height = capture.cameras.select([name]).max_size_px
    screen = np.zeros((height, width, 3), np.uint8)
    screen[..., channel] = 255
    return screen
