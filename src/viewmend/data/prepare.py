"""Preparing a capture: check it, align it on its input cameras, match colours, tighten masks, limit the image size.

`mend`, `serve`, `evaluate` and `train` all read their frames through `prepare`; `train` changes
neither colours nor masks, and `serve` limits the image size. Serious faults of a capture raise a
`CaptureError`; others are logged once as warnings of the logger `viewmend`.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from viewmend.data.capture_folder import CaptureFolder, open_capture
from viewmend.data.checks.colours import find_blank_images
from viewmend.data.checks.diagnosis import diagnose, find_bad_masks, find_wrong_unit
from viewmend.data.checks.synchronisation import find_desynchronised_cameras
from viewmend.data.colour_matching import ColourMatch, match_colours
from viewmend.data.errors import CaptureError, Issue, without_consequences
from viewmend.data.loose_masks import LooseMasks, find_loose_masks
from viewmend.data.source import CaptureSource, CaptureWrapper, limit_camera_size, limit_size
from viewmend.geometry.alignment import Alignment, shared_offset
from viewmend.geometry.cameras import Cameras, check_names
from viewmend.geometry.hull import FOREGROUND
from viewmend.types import MultiViewFrame

MAX_NAMED = 3
"""Warnings name the cameras that are not inputs if there are at most this many."""
ENTERING_FRAMES = 30
"""Half of the cameras are expected to see a subject within this many frames after one sees it first."""


@dataclass(frozen=True)
class PreparedCapture(CaptureWrapper):
    """A source with aligned cameras, matched colours and reduced images; see `prepare`."""

    source: CaptureSource  # pyrefly: ignore[bad-override]
    alignment: Alignment | None = None
    """The shift of all images that was found in the masks of the input cameras; None if off or impossible."""
    max_image_size: int | None = None
    """Maximum length of the longer image side; None for full size."""
    inputs: tuple[str, ...] | None = None
    """The input cameras; None for all."""
    left_out: tuple[str, ...] = ()
    """Cameras that disagree with all others and are therefore absent from every frame."""
    colours: ColourMatch | None = None
    """Colour corrections of the input cameras; None if colours stay as they are."""
    loose_masks: LooseMasks | None = None
    """The input cameras whose masks are tightened, and by how much; None if masks stay as they are."""
    _reported: set[str] = field(default_factory=set, compare=False, repr=False)

    @property
    def changes(self) -> tuple[str, ...]:
        """What preparation has changed, as sentences for the user."""
        changes = [found.summary for found in (self.colours, self.loose_masks) if found is not None]
        if self.alignment is not None and self.alignment.offset_px != (0.0, 0.0):
            x, y = self.alignment.offset_px
            changes.append(
                f"all principal points moved by ({x:+.2f}, {y:+.2f}) pixels, which improves the agreement of hull and "
                f"masks from IoU {self.alignment.iou_before:.3f} to {self.alignment.iou_after:.3f}; check "
                "first_pixel_center, or use --no-align"
            )
        return tuple(changes)

    @property
    def cameras(self) -> Cameras:
        """All cameras including those that are not inputs, shifted by the alignment and resized with their images."""
        x_px, y_px = self.alignment.offset_px if self.alignment else (0.0, 0.0)
        return limit_camera_size(self.source.cameras.moved(x_px, y_px), self.max_image_size)

    @property
    def usable_cameras(self) -> Cameras:
        """Those of `cameras` that frames may have: the input cameras that are not left out."""
        inputs = self.cameras.names if self.inputs is None else self.inputs
        return self.cameras.select([name for name in inputs if name not in self.left_out])

    def read(self, time: int) -> MultiViewFrame:
        """Read the frame at index `time` with the calibration of `cameras`; see `adjust`.

        CaptureError if the source cannot be read, half of the masks are inverted, or no camera is left.
        """
        return self.adjust(self.source.read(time), f"frame '{self.frame_ids[time]}'")

    def adjust(self, frame: MultiViewFrame, label: str) -> MultiViewFrame:
        """A frame of the source, or of the same rig, with the calibration of `cameras`; `label` is for messages.

        A camera whose mask is inverted or wrongly empty, or whose image is black, is left
        out of the frame and reported once. CaptureError if half of the masks are inverted,
        or no camera is left.
        """
        frame = frame.without(self.left_out)
        inputs = self.cameras.names if self.inputs is None else self.inputs
        absent = [name for name in inputs if name not in frame.cameras.names and name not in self.left_out]
        text = (
            "camera '{}' has no image or no mask in this frame and is absent; viewmend check lists all gaps"
        )
        issues = tuple(Issue(text.format(name)) for name in absent) + find_bad_masks(
            frame, inputs, self.bounds
        )
        good = [
            name for name in frame.cameras.names if name in inputs and all(name != i.camera for i in issues)
        ]
        issues += find_blank_images(frame.select(good))
        bad = [issue.camera for issue in issues if issue.camera]
        where = f"{self.name}: {label}"
        _raise_or_warn(where, issues, self._reported)
        if len(bad) == len(frame.cameras):
            raise CaptureError(f"{where}: expected at least one correct mask, got none; redo them")
        frame = limit_size(frame.without(bad), self.max_image_size)
        frame = replace(frame, cameras=self.cameras.select(frame.cameras.names))
        if self.colours is not None:
            frame = self.colours.apply(frame)
        return frame if self.loose_masks is None else self.loose_masks.apply(frame)


def prepare(
    source: CaptureSource,
    inputs: Sequence[str] | None = None,
    *,
    max_image_size: int | None = None,
    align: bool = True,
    match_colours: bool = True,
    tighten_masks: bool = True,
    first: int = 0,
    last: int | None = None,
) -> PreparedCapture:
    """Check and align a capture, match its colours, tighten its masks, and limit its image size.

    Args:
        source: the capture.
        inputs: names of the input cameras; None for all. Pixels of other (held-out) cameras
            have no effect.
        max_image_size: images are reduced to at most this length of their longer side.
        align: find the shift that all images share from the masks of one frame at full size, and
            look for out-of-sync cameras in the frames around it: `first_with_subject`.
        match_colours: match the input cameras' colours in the same frame, if that improves their
            agreement on parts of the surface that the correction was not fitted to.
        tighten_masks: tighten the input cameras' masks that extend beyond the subject, judging by
            colour in the same frame: `find_loose_masks`.
        first: index of the first frame that will be used.
        last: index of the last frame that will be used, at which synchronisation is checked again.

    Raises:
        CaptureError: a frame cannot be read, its masks or calibration are unusable, or no
            frame has a subject.
        ValueError: `inputs` is a string or has an unknown name, or the input cameras look away from each
        other.

    Examples:
        >>> from viewmend import prepare
        >>> from viewmend.studio.stage import Studio, StudioConfig
        >>> capture = prepare(Studio(StudioConfig(cameras=4, frames=1, size_px=64)), max_image_size=32, align=False)
        >>> capture.read(0).rgb.shape
        torch.Size([4, 3, 32, 32])
    """
    names = None
    if inputs is not None:
        check_names("inputs", inputs)
        names = source.cameras.select(tuple(inputs)).names
    frame = first_with_subject(source, names, first, least=2)
    if frame is None:
        return PreparedCapture(source, None, max_image_size, names)
    reported: set[str] = set()
    issues = diagnose(frame, source.bounds)
    left_out = tuple(issue.camera for issue in issues if issue.camera and issue.always)
    fatal = any(issue.fatal for issue in issues)
    where = _describe(source, names)
    at = f"{where}: frame '{source.frame_ids[frame.time]}'"
    frame = frame.without([issue.camera for issue in issues if issue.camera])
    late = find_desynchronised_cameras(source, frame, last) if align and not fatal else ()
    _raise_or_warn(at, without_consequences(issues, late), reported)
    _raise_or_warn(where, (*late, *find_wrong_unit(source.cameras, issues)), reported)
    prepared = PreparedCapture(source, None, max_image_size, names, left_out, _reported=reported)
    prepared = _adjusted(prepared, frame, issues, align, match_colours)
    return replace(prepared, loose_masks=find_loose_masks(frame)) if tighten_masks else prepared


def adjustments(source: CaptureSource, frame: MultiViewFrame, issues: Sequence[Issue]) -> tuple[str, ...]:
    """`PreparedCapture.changes` of `prepare`, judging by a frame of good cameras and its issues."""
    if not frame.has_subject:
        return ()
    prepared = _adjusted(PreparedCapture(source), frame, issues, align=True, colours=True)
    return replace(prepared, loose_masks=find_loose_masks(frame)).changes


def _adjusted(
    prepared: PreparedCapture, frame: MultiViewFrame, issues: Sequence[Issue], align: bool, colours: bool
) -> PreparedCapture:
    """The capture with the shift of all images undone, and with matched colours, as found in a frame."""
    if align and frame.mask is not None and len(frame.cameras) >= 2:
        prepared = replace(prepared, alignment=shared_offset(frame.mask, frame.cameras, prepared.bounds))
    if colours:
        cameras = replace(prepared, max_image_size=None).cameras.select(frame.cameras.names)
        odd = [issue.odd_image for issue in issues if issue.odd_image]
        found = match_colours(replace(frame, cameras=cameras), prepared.bounds, odd)
        prepared = replace(prepared, colours=found if found is not None and found.helps else None)
    return prepared


def _describe(source: CaptureSource, inputs: Sequence[str] | None) -> str:
    """The source's name, and which of its cameras are held out if they are few."""
    held = [name for name in source.cameras.names if inputs is not None and name not in inputs]
    return f"{source.name} without {', '.join(held)}" if 0 < len(held) <= MAX_NAMED else source.name


def _raise_or_warn(where: str, issues: Sequence[Issue], reported: set[str]) -> None:
    """Raise a CaptureError for the first fatal issue; log each other issue once per camera."""
    for issue in issues:
        if issue.fatal:
            raise CaptureError(f"{where}: {issue.text}")
        key = issue.camera or issue.text
        if key not in reported:
            reported.add(key)
            logging.getLogger("viewmend").warning("%s: %s", where, issue.text)


def open_masked(
    path: Path | str, cameras: Sequence[str] | None = None, held: int = 0, format: str | None = None
) -> CaptureFolder:
    """Open a capture; CaptureError unless it has masks and, besides `held` held-out cameras, two inputs or more."""
    capture = open_capture(path, cameras, format)
    if not capture.has_masks:
        raise CaptureError(
            f"{path}: expected a 'mask' for every camera, got none; the visual hull is computed from masks: make them "
            f"with viewmend masks {path} OUT, or name their files in cameras.json"
        )
    count = len(capture.cameras) - held
    if count < 2:
        raise CaptureError(f"{path}: expected at least 2 input cameras, got {count}; use more cameras")
    return capture


def first_with_subject(
    source: CaptureSource, inputs: Sequence[str] | None = None, first: int = 0, least: int = 1
) -> MultiViewFrame | None:
    """The input cameras in a frame in which `least` of them are present and see the subject; None without masks.

    It is the first such frame from the index `first` on, or else the last one before. If the subject
    is still entering, it is a later frame: the first in which half of the cameras see the subject, or
    the one in which the most do. CaptureError if no frame has foreground.
    """
    count = len(source.frame_ids)
    has_subject = False
    best = None
    most = 0
    frames_left = ENTERING_FRAMES
    for time in (*range(first, count), *reversed(range(first))):
        frame = source.read(time)
        if frame.mask is None:
            return None
        if inputs is not None:
            frame = frame.select([name for name in inputs if name in frame.cameras.names])
        seeing = sum(bool((mask > FOREGROUND).any()) for mask in frame.per_camera("mask"))
        has_subject |= seeing > 0
        if len(frame.cameras) >= least and seeing > most:
            best = frame
            most = seeing
        if best is None:
            continue
        frames_left -= 1
        if 2 * most >= len(best.cameras) or frames_left == 0:
            break
    if has_subject:
        return best
    where = source.folder if isinstance(source, CaptureFolder) else source.name
    masks = "a mask" if inputs is None else "a mask of the input cameras"
    raise CaptureError(
        f"{where}: expected foreground (values above {FOREGROUND}) in {masks}, got none in "
        f"{count} frame{'s' if count > 1 else ''}; segment the images again, with 255 as the subject"
    )
