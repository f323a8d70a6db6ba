"""A capture as everybody looks at it: opened, aligned on its input cameras alone, images no larger than wanted.

`mend`, `serve`, evaluation and training all take their frames from here, so that they see the same pixels. Colours
are 8 bit RGB, as the files store them or as cameras that disagree were matched. What is wrong with a capture is
refused, or said once through the logger `viewmend`; Python prints that to standard error unless a program arranges
otherwise.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from viewmend.capture.colour_match import ColourMatch, colour_match
from viewmend.capture.diagnosis import diagnose, faulty_masks
from viewmend.capture.errors import CaptureError
from viewmend.capture.finding import Finding
from viewmend.capture.peers import REACH, late_camera
from viewmend.capture.plain import PlainCapture, open_capture
from viewmend.capture.reduction import reduced, reduced_cameras
from viewmend.capture.source import CaptureSource, OfSource
from viewmend.geometry.alignment import Alignment, shared_offset
from viewmend.geometry.cameras import Cameras
from viewmend.views import MultiViewFrame


@dataclass(frozen=True)
class PreparedCapture(OfSource):
    """A `CaptureSource` whose cameras are aligned, and whose images are reduced, as `prepare` was asked."""

    source: CaptureSource
    alignment: Alignment | None = None
    """The shift of all images that was found in the input cameras' masks; None where none was looked for."""
    longest_px: int | None = None
    """Images are reduced to at most this length of their longer side; None leaves them as they are."""
    inputs: tuple[str, ...] | None = None
    """Cameras that may be looked at; None for all."""
    left_out: tuple[str, ...] = ()
    """Cameras that disagree with all others, and are absent from every frame."""
    colours: ColourMatch | None = None
    """How the input cameras' colours are matched; None where they stay as they are."""
    _said: set[str] = field(default_factory=set, compare=False, repr=False)

    @property
    def changes(self) -> tuple[str, ...]:
        """What is no longer as it was taken, in words."""
        told = [] if self.colours is None else [self.colours.said]
        if self.alignment is not None and self.alignment.offset_px != (0.0, 0.0):
            x, y = self.alignment.offset_px
            told.append(
                f"all principal points moved by ({x:+.2f}, {y:+.2f}) pixels: hull and masks then agree better, IoU "
                f"{self.alignment.iou_before:.3f} -> {self.alignment.iou_after:.3f}; check first_pixel_center, or use "
                "--no-align"
            )
        return tuple(told)

    @property
    def cameras(self) -> Cameras:
        """All cameras, those that are no inputs too, moved by the shift and resized with their images."""
        x_px, y_px = self.alignment.offset_px if self.alignment else (0.0, 0.0)
        return reduced_cameras(self.source.cameras.moved(x_px, y_px), self.longest_px)

    def read(self, time: int) -> MultiViewFrame:
        """All cameras that are there and right at index `time`, with `cameras`' calibration.

        A camera whose mask is inverted, or empty by mistake, is left out for that time, and named once.

        Raises:
            CaptureError: the source cannot be read, half of the masks are inverted, or no camera is left.
        """
        frame = self.source.read(time).without(self.left_out)
        named = self.cameras.names if self.inputs is None else self.inputs
        absent = [name for name in named if name not in frame.cameras.names and name not in self.left_out]
        text = "camera '{}' has no image or no mask, and is absent; check its files"
        found = tuple(Finding(text.format(name)) for name in absent)
        found += faulty_masks(frame, named, self.bounds)
        _refuse_or_warn(f"{self.name}: frame '{self.frame_ids[time]}'", found, self._said)
        wrong = [finding.camera for finding in found if finding.camera]
        if len(wrong) == len(frame.cameras):
            raise CaptureError(
                f"{self.name}: expected one right mask or more, got none at {self.frame_ids[time]}; redo it"
            )
        frame = reduced(frame.without(wrong), self.longest_px)
        frame = replace(frame, cameras=self.cameras.select(frame.cameras.names))
        return frame if self.colours is None else self.colours.matched(frame)


def prepare(
    source: CaptureSource,
    inputs: Sequence[str] | None = None,
    *,
    longest_px: int | None = None,
    align: bool = True,
    match_colours: bool = True,
    first: int = 0,
) -> PreparedCapture:
    """Align a capture and say how large its images may be.

    Args:
        source: the capture.
        inputs: names of the cameras that may be looked at; None for all. A camera that is left out is not among them,
            and no pixel of it changes anything.
        longest_px: images are reduced to at most this length of their longer side.
        align: look for a shift that all images share, in the masks of the first frame from `first` on that two inputs
            with any foreground are in, and for a camera that is late, in the frames around it. The shift is found at
            full size.
        match_colours: match the inputs' colours, by the same frame, where they then agree better on surface that
            nothing was fitted to.
        first: index of the first frame that will be used.

    Raises:
        CaptureError: a frame cannot be read, or the first one says that masks or calibration are wrong altogether.
        ValueError: the masks agree on no subject.

    Examples:
        >>> from viewmend import prepare
        >>> from viewmend.studio.stage import Studio, StudioConfig
        >>> capture = prepare(Studio(StudioConfig(cameras=4, frames=1, size_px=64)), longest_px=32, align=False)
        >>> capture.read(0).rgb.shape
        torch.Size([4, 3, 32, 32])
    """
    named = None if inputs is None else tuple(inputs)
    frame = _first_masked(source, named, first)
    if frame is None:
        return PreparedCapture(source, None, longest_px, named)
    said: set[str] = set()
    found = diagnose(frame, source.bounds)
    _refuse_or_warn(f"{source.name}: frame '{source.frame_ids[frame.time]}'", found, said)
    left_out = tuple(finding.camera for finding in found if finding.camera and finding.always)
    frame = frame.without([finding.camera for finding in found if finding.camera])
    alignment = None
    if align:
        _refuse_or_warn(source.name, late_camera(*_around(source, frame), source.bounds), said)
    if align and frame.mask is not None and len(frame.cameras) >= 2:
        alignment = shared_offset(frame.mask, frame.cameras, source.bounds)
    prepared = PreparedCapture(source, alignment, longest_px, named, left_out, None, said)
    return _matched(prepared, frame) if match_colours else prepared


def _matched(prepared: PreparedCapture, frame: MultiViewFrame) -> PreparedCapture:
    """With colours matched by this frame of the input cameras, where that helps."""
    cameras = replace(prepared, longest_px=None).cameras.select(frame.cameras.names)
    colours = colour_match(replace(frame, cameras=cameras), prepared.bounds)
    return replace(prepared, colours=colours) if colours is not None and colours.helps else prepared


def _refuse_or_warn(where: str, found: Sequence[Finding], said: set[str]) -> None:
    """CaptureError for the first fatal finding; the others are logged, each camera's once."""
    for finding in found:
        if finding.fatal:
            raise CaptureError(f"{where}: {finding.text}")
        key = finding.camera or finding.text
        if key not in said:
            said.add(key)
            logging.getLogger("viewmend").warning("%s: %s", where, finding.text)


def open_masked(
    path: Path | str, cameras: Sequence[str] | None = None, held: int = 0, kind: str | None = None
) -> PlainCapture:
    """Open a capture that has masks, and at least two input cameras besides `held` cameras that are left out.

    Raises:
        CaptureError: it cannot be opened (see `open_capture`), has no masks, or too few cameras.
    """
    capture = open_capture(path, cameras, kind)
    if not capture.has_masks:
        raise CaptureError(
            f"{path}: expected a 'mask' for every camera, got none: the visual hull is carved from them, and the truth "
            f"cut out; make them with viewmend masks {path} OUT --method ..., or name their files in cameras.json"
        )
    count = len(capture.cameras) - held
    if count < 2:
        raise CaptureError(f"{path}: expected at least 2 input cameras, got {count}; use more cameras")
    return capture


def _around(source: CaptureSource, frame: MultiViewFrame) -> tuple[list[MultiViewFrame], int]:
    """The frames of the same cameras before and after this one, with it, and where it is among them."""
    times = range(max(0, frame.time - REACH), min(len(source.frame_ids), frame.time + REACH + 1))
    others = {time: source.read(time) for time in times if time != frame.time} | {frame.time: frame}
    there = [name for name in frame.cameras.names if all(name in other.cameras.names for other in others.values())]
    return [others[time].select(there) for time in times], frame.time - times[0]


def _first_masked(source: CaptureSource, inputs: Sequence[str] | None, first: int) -> MultiViewFrame | None:
    """The inputs at the first time from `first` on at which two of them are there, with any foreground."""
    for time in range(first, len(source.frame_ids)):
        frame = source.read(time)
        if inputs is not None:
            frame = frame.select([name for name in inputs if name in frame.cameras.names])
        if len(frame.cameras) >= 2 and frame.mask is not None and bool((frame.mask > 0).any()):
            return frame
    return None
