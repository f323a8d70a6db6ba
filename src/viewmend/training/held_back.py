"""What fine-tuning never trains on: one camera of a capture and its last frames, for validation and the final table."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor, nn

from viewmend.data.capture_folder import CaptureFolder
from viewmend.data.errors import CaptureError
from viewmend.data.images import write_image
from viewmend.data.prepare import open_masked, prepare
from viewmend.data.source import CaptureSource
from viewmend.frame_cache import CachedFrame
from viewmend.metrics.image_quality import psnr
from viewmend.metrics.lpips import MIN_PX, Lpips, load_lpips
from viewmend.models.base import Inpainter
from viewmend.models.compositing import Background, camera_image, composite
from viewmend.scenes.capture_scenes import is_splits, training_captures
from viewmend.scenes.held_out import LeaveOneOut
from viewmend.stream import Stream, StreamConfig
from viewmend.types import CompletedView, MultiViewFrame
from viewmend.utils.contact_sheet import Tile, contact_sheet, picture
from viewmend.utils.tensors import to_device

AUTO = "auto"
"""Value of `SceneConfig.hold_out` that leaves the choice to `HeldBack.of`."""
TAIL = 0.1
"""Fraction of a capture's frames that is held back, at its end."""
MIN_CAMERAS = 5
"""Smaller rigs keep all their cameras for training: views from two cameras say little about views
from three."""
MAX_VIEWS = 6
"""Views that a run is validated on."""
MAX_TABLE = 8
"""Cameras of the final table."""
LPIPS_DB = 40.0
"""Decibels that one unit of LPIPS is worth when weights are compared: 0.01 counts as much as 0.4 dB."""
MIN_GAIN_DB = 0.1
"""Better weights have a score that is higher by at least this: smaller gains are chance on a few views."""
PATIENCE = 6
"""Validations without a new best score after which a run ends."""
PADDING_PX = 8
TILE_PX = (320, 480)


@dataclass(frozen=True)
class HeldBack:
    """The camera and the frames of a capture that training never uses."""

    camera: str | None
    """None for rigs of fewer than `MIN_CAMERAS`, and for those of a splits file."""
    first_frame: int
    """Frames from this one on; the number of frames if the capture has only one."""

    @classmethod
    def of(cls, capture: CaptureSource, camera: str | None) -> "HeldBack":
        """This camera, with `AUTO` the middle one of the rig, or none, and the last tenth of the frames.

        Raises:
            CaptureError: there is no such camera, or too few others.
        """
        names = capture.cameras.names
        count = len(capture.frame_ids)
        first_frame = count - math.ceil(TAIL * count) if count > 1 else 1
        if camera is None:
            return cls(None, first_frame)
        if camera != AUTO and camera not in names:
            raise CaptureError(
                f"{capture.name}: expected --hold-out among {', '.join(names)}, got '{camera}'"
            )
        if camera != AUTO and len(names) < MIN_CAMERAS:
            raise CaptureError(
                f"{capture.name}: expected at least {MIN_CAMERAS} cameras to hold one back, got {len(names)}; omit "
                "--hold-out to hold back only the last frames"
            )
        chosen = names[len(names) // 2] if camera == AUTO else camera
        return cls(chosen if len(names) >= MIN_CAMERAS else None, first_frame)


@dataclass(frozen=True)
class TrainingCapture:
    """A capture to train on."""

    source: CaptureFolder
    left_out: str | None
    """The one camera that is the ground truth; None for all in turn."""
    held_back: HeldBack | None


def open_training_captures(place: Path, hold_out: str | None) -> list[TrainingCapture]:
    """A capture; or the training captures of a splits file, of which only the last frames are held back.

    Raises:
        CaptureError: a capture cannot be used, or has no camera `hold_out`.
        ValueError: the splits file has no training captures, or one of them is absent or was recalibrated.
    """
    if is_splits(place):
        return [
            TrainingCapture(source, left_out, None if hold_out is None else HeldBack.of(source, None))
            for source, left_out in training_captures(place)
        ]
    source = open_masked(place, held=1)
    return [TrainingCapture(source, None, None if hold_out is None else HeldBack.of(source, hold_out))]


@dataclass(frozen=True)
class HeldBackView:
    """A view of one camera of a capture, from the others, with the truth."""

    camera: str
    trained_on: bool
    """Whether training saw this camera's image at this frame."""
    inputs: CachedFrame
    truth: MultiViewFrame

    def score(self, model: Inpainter, metric: Lpips) -> tuple["ViewScore", CompletedView]:
        """The view by this model, on the CPU, and its scores on the background that the model paints."""
        background = model.background or "black"
        device = next(model.parameters()).device if isinstance(model, nn.Module) else torch.device("cpu")
        stream = Stream(model, StreamConfig(memory_mb=None, background=background))
        stream.add_frame(*to_device((self.inputs.frame, self.inputs.proxy), device))
        completed = to_device(stream.view(self.truth.cameras.to(device)).completed, "cpu")
        rgb = composite(background, completed.rgb, completed.opacity)
        truth = camera_image(self.truth, background)
        found = psnr(rgb, truth, torch.ones_like(truth[0], dtype=torch.bool))
        assert found is not None and self.truth.mask is not None, (
            "images have pixels, and captures masks here"
        )
        box = _subject_box(self.truth.mask[0])
        distance = float(metric(rgb[None, :, *box], truth[None, :, *box]))
        return ViewScore(self.camera, self.trained_on, found, distance), completed


@dataclass(frozen=True)
class ViewScore:
    """Scores of one view."""

    camera: str
    trained_on: bool
    psnr_db: float
    """PSNR of the whole view."""
    lpips: float
    """LPIPS (AlexNet) in the subject's box."""


def _subject_box(mask: Tensor) -> tuple[slice, slice]:
    """Rows and columns of the subject with a margin, at least as many as LPIPS needs where the image allows it."""
    box = []
    for axis, length in enumerate(mask.shape):
        own = (mask > 127).any(1 - axis).nonzero()[:, 0]
        first, last = (
            (0, length) if not len(own) else (int(own[0]) - PADDING_PX, int(own[-1]) + 1 + PADDING_PX)
        )
        short = max(0, MIN_PX["alex"] - (last - first))
        first = first - (short + 1) // 2
        last = last + (short + 1) // 2
        first, last = (0, last - first) if first < 0 else (first, last)
        box.append(slice(max(0, first - (last - length)), length) if last > length else slice(first, last))
    return box[0], box[1]


def held_back_views(place: Path, hold_out: str, table: bool = False) -> Iterator[HeldBackView]:
    """The views on which a run is validated, or with `table` those of its final table, the held-back camera first.

    A camera is rendered from all others, as `viewmend mend --leave-out` does. Without a held-back
    camera, all cameras are rendered at frames that are held back. Of a splits file, the first
    `MAX_VIEWS` captures are used, for the table the first. Raises as `open_training_captures`.
    """
    for opened in open_training_captures(place, hold_out)[: 1 if table else MAX_VIEWS]:
        assert opened.held_back is not None, "something is held back"
        yield from _views_of(opened.source, opened.held_back, table)


def _views_of(capture: CaptureFolder, own: HeldBack, table: bool) -> Iterator[HeldBackView]:
    names = capture.cameras.names
    count = len(capture.frame_ids)
    late = range(own.first_frame, count) if count > 1 else range(1)
    if table:
        others = [name for name in names if name != own.camera]
        chosen = [own.camera] if own.camera else []
        shown = min(MAX_TABLE, len(others))
        chosen += [others[len(others) * n // shown] for n in range(shown)]
        time = _time_with_subject(capture, late)
        wanted = [(name, time) for name in dict.fromkeys(chosen)]
    elif own.camera is None:
        wanted = [(names[n % len(names)], late[len(late) * n // MAX_VIEWS]) for n in range(MAX_VIEWS)]
    else:
        times = [count * n // MAX_VIEWS for n in range(1, MAX_VIEWS)] if count > MAX_VIEWS else range(count)
        wanted = [(own.camera, time) for time in (*times, late[-1])]
    for camera, time in dict.fromkeys(wanted):
        others = tuple(name for name in names if name != camera)
        prepared = prepare(capture, others)
        frame = prepared.read(time)
        if camera not in frame.cameras.names or len(frame.cameras) < 3 or not frame.has_subject:
            continue
        seen = LeaveOneOut({time: frame}, prepared.bounds).frame(camera, time)
        stream = Stream(Inpainter(), bounds=prepared.bounds)
        yield HeldBackView(
            camera, camera != own.camera and count == 1, stream.add_frame(seen.inputs), seen.truth
        )


def _time_with_subject(capture: CaptureFolder, late: range) -> int:
    """The frame nearest to the middle of those held back that has a subject, or else the last one before them.

    Without any, the middle one.
    """
    middle = late[len(late) // 2]
    held = sorted(late, key=lambda time: abs(time - middle))
    for time in (*held, *reversed(range(late.start))):
        if capture.read(time).has_subject:
            return time
    return middle


@dataclass
class HeldBackValidation:
    """Validation of a fine-tuning run on what it holds back; the run keeps the weights with the best "score"."""

    captures: Sequence[Path]
    hold_out: str
    _views: list[HeldBackView] = field(default_factory=list)
    _metric: Lpips | None = None

    @torch.no_grad()
    def __call__(self, model: nn.Module, image: Path) -> dict[str, float | None]:
        """Mean PSNR of whole views in dB, LPIPS in the subject's box, and "score", which weighs both."""
        assert isinstance(model, Inpainter), "a network that completes views"
        if not self._views:
            self._views = [view for place in self.captures for view in held_back_views(place, self.hold_out)]
        if not self._views:
            raise ValueError("expected a subject in what is held back, got none; choose another --hold-out")
        self._metric = self._metric or load_lpips("alex")
        training = model.training  # pyright: ignore
        model.eval()  # pyright: ignore
        made = [view.score(model, self._metric) for view in self._views]
        model.train(training)  # pyright: ignore
        background = model.background or "black"
        rows = [
            _row(view, [("tuned", own)], background) for view, (_, own) in zip(self._views, made, strict=True)
        ]
        write_image(image, contact_sheet(rows[:4], *TILE_PX))
        psnr_db, lpips = (sum(getattr(s, name) for s, _ in made) / len(made) for name in ("psnr_db", "lpips"))
        return {"psnr_whole": psnr_db, "lpips_subject": lpips, "score": psnr_db - LPIPS_DB * lpips}


def compare(place: Path, hold_out: str, before: Inpainter, after: Inpainter, sheet: Path) -> str:
    """A Markdown table of the scores before and after fine-tuning by camera; writes the views as a contact sheet."""
    metric = load_lpips("alex")
    rows = []
    lines = ["| camera | PSNR before, dB | after | LPIPS before | after |", "| --- | --- | --- | --- | --- |"]
    for view in held_back_views(place, hold_out, table=True):
        old, old_view = view.score(before, metric)
        new, new_view = view.score(after, metric)
        note = " (its image was trained on)" if view.trained_on else ""
        lines.append(
            f"| {view.camera}{note} | {old.psnr_db:.2f} | {new.psnr_db:.2f} | {old.lpips:.4f} | {new.lpips:.4f} |"
        )
        rows.append(_row(view, [("before", old_view), ("after", new_view)], after.background or "black"))
    write_image(sheet, contact_sheet(rows, *TILE_PX))
    return "\n".join(lines)


def _row(
    view: HeldBackView, completed: Sequence[tuple[str, CompletedView]], background: Background
) -> list[Tile]:
    """The view as rendered, as completed, and the truth, cut to the subject."""
    box = _subject_box(view.truth.mask[0])  # pyright: ignore[reportOptionalSubscript]
    images = [("rendered", completed[0][1].view.rgb), *((name, own.rgb) for name, own in completed)]
    images.append(("truth", camera_image(view.truth, background)))
    return [Tile(f"{view.camera}: {name}", picture(image[:, *box])) for name, image in images]
