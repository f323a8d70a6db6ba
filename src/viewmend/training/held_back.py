"""What fine-tuning never trains on: one camera of a capture and its last frames, for validation and the final table."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor, nn

from viewmend.data.capture_folder import CaptureFolder
from viewmend.data.errors import CaptureError
from viewmend.data.images import write_image
from viewmend.data.prepare import PreparedCapture, first_with_subject, open_masked, prepare
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
"""A run ends after this many validations without a new best score."""
FEW_VALIDATIONS = 2
"""A run with fewer validations than this, at the recipe's interval, is too short to judge."""
PADDING_PX = 8
"""The subject's box has a margin of this many pixels."""
TILE_PX = (320, 480)
"""Width and height of the images in contact sheets, pixels."""


@dataclass(frozen=True)
class HeldBack:
    """The camera and the frames of a capture that training never uses."""

    camera: str | None
    """None if the rig has fewer than `MIN_CAMERAS`, or is listed in a splits file."""
    first_frame: int
    """The first frame that training never uses; 1 if only frame 0 shows a subject, which training uses."""

    @classmethod
    def of(cls, capture: CaptureSource, camera: str | None) -> "HeldBack":
        """Hold back this camera and the last frames; `AUTO` chooses the middle one of the cameras that see the subject.

        The last frames are a tenth of those up to the last one with a subject, and all after it.

        Raises:
            CaptureError: there is no such camera, or too few others.
        """
        names = capture.cameras.names
        count = _end_of_subject(capture)
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
        if len(names) < MIN_CAMERAS:
            return cls(None, first_frame)
        return cls(_middle_camera(capture) if camera == AUTO else camera, first_frame)

    def describe(self, capture: CaptureSource) -> str:
        """What is held back, as a sentence."""
        count = len(capture.frame_ids)
        late = max(0, count - self.first_frame) if count > 1 else 0
        parts = [] if self.camera is None else [f"camera '{self.camera}'"]
        if late:
            last = "the last frame" if late == 1 else f"the last {late} frames"
            parts.append(f"{last} (from '{capture.frame_ids[self.first_frame]}' on)")
        what = " and ".join(parts) or "nothing"
        verb = "are" if len(parts) > 1 or (self.camera is None and late > 1) else "is"
        return f"{capture.name}: {what} {verb} held out, for validation only"


def _end_of_subject(capture: CaptureSource) -> int:
    """The number of frames up to the last one that shows the subject; of all frames if none does."""
    count = len(capture.frame_ids)
    return next((time + 1 for time in reversed(range(count)) if capture.read(time).has_subject), count)


def _middle_camera(capture: CaptureSource) -> str:
    """The camera in the middle of the rig's list, or the nearest one to it whose mask shows the subject."""
    names = capture.cameras.names
    frame = first_with_subject(capture)
    middle = sorted(names, key=lambda name: abs(names.index(name) - len(names) // 2))
    if frame is None:
        return middle[0]
    seeing = {name for name in frame.cameras.names if frame.select([name]).has_subject}
    return next((name for name in middle if name in seeing), middle[0])


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
        return self._score(rgb, background, metric), completed

    def score_rendered(self, completed: CompletedView, background: Background, metric: Lpips) -> "ViewScore":
        """The scores of the view that was completed, as rendered."""
        view = completed.view
        return self._score(composite(background, view.cut_rgb, view.silhouette), background, metric)

    def _score(self, rgb: Tensor, background: Background, metric: Lpips) -> "ViewScore":
        truth = camera_image(self.truth, background)
        found = psnr(rgb, truth, torch.ones_like(truth[0], dtype=torch.bool))
        assert found is not None and self.truth.mask is not None, (
            "images have pixels, and captures masks here"
        )
        box = _subject_box(self.truth.mask[0])
        distance = float(metric(rgb[None, :, *box], truth[None, :, *box]))
        return ViewScore(self.camera, self.trained_on, found, distance)


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
    foreground = mask > 127
    height, width = mask.shape
    rows = foreground.any(1).nonzero()[:, 0].tolist()
    columns = foreground.any(0).nonzero()[:, 0].tolist()
    return _with_margin(rows, height), _with_margin(columns, width)


def _with_margin(occupied: list[int], length: int) -> slice:
    """The range of the occupied rows or columns of an image, with a margin; all of them if none is occupied."""
    if not occupied:
        return slice(0, length)
    start = occupied[0] - PADDING_PX
    end = occupied[-1] + 1 + PADDING_PX
    missing = max(0, MIN_PX["alex"] - (end - start))
    start -= (missing + 1) // 2
    end += (missing + 1) // 2

    # Move the range into the image
    if start < 0:
        end -= start
        start = 0
    if end > length:
        start = max(0, start - (end - length))
        end = length
    return slice(start, end)


def held_back_views(place: Path, hold_out: str, table: bool = False) -> Iterator[HeldBackView]:
    """The views on which a run is validated; with `table`, the views of its final table. The held-back camera is first.

    A camera is rendered from all others, as `viewmend mend --leave-out` does. Without a held-back
    camera, all cameras are rendered at frames that are held back. If `place` is a splits file, its first
    `MAX_VIEWS` captures are used, or for the table only its first. Raises as `open_training_captures`.
    """
    for opened in open_training_captures(place, hold_out)[: 1 if table else MAX_VIEWS]:
        assert opened.held_back is not None, "something is held back"
        yield from _views_of(opened.source, opened.held_back, table)


def _views_of(capture: CaptureFolder, held_back: HeldBack, table: bool) -> Iterator[HeldBackView]:
    names = capture.cameras.names
    count = _end_of_subject(capture)
    late = range(held_back.first_frame, count) if count > 1 else range(1)

    # Cameras and frames to render
    if table:
        others = [name for name in names if name != held_back.camera]
        chosen = [held_back.camera] if held_back.camera else []
        shown = min(MAX_TABLE, len(others))
        chosen += [others[len(others) * n // shown] for n in range(shown)]
        time = _time_with_subject(capture, late)
        wanted = [(name, time) for name in dict.fromkeys(chosen)]
    elif held_back.camera is None:
        wanted = [(names[n % len(names)], late[len(late) * n // MAX_VIEWS]) for n in range(MAX_VIEWS)]
    else:
        times = [count * n // MAX_VIEWS for n in range(1, MAX_VIEWS)] if count > MAX_VIEWS else range(count)
        wanted = [(held_back.camera, time) for time in (*times, late[-1])]

    # Their views from the other cameras; each camera is prepared once
    prepared_without: dict[str, PreparedCapture] = {}
    for camera, time in dict.fromkeys(wanted):
        if camera not in prepared_without:
            prepared_without[camera] = prepare(capture, tuple(name for name in names if name != camera))
        prepared = prepared_without[camera]
        frame = prepared.read(time)
        if camera not in frame.cameras.names or len(frame.cameras) < 3:
            continue
        if not frame.select([camera]).has_subject:  # there is nothing to score
            continue
        scene = LeaveOneOut({time: frame}, prepared.bounds).frame(camera, time)
        stream = Stream(Inpainter(), bounds=prepared.bounds)
        trained_on = camera != held_back.camera and time < held_back.first_frame
        yield HeldBackView(camera, trained_on, stream.add_frame(scene.inputs), scene.truth)


def _time_with_subject(capture: CaptureFolder, late: range) -> int:
    """The frame nearest to the middle of those held back that has a subject; without any, the middle one."""
    middle = late[len(late) // 2]
    nearest_first = sorted(late, key=lambda time: abs(time - middle))
    return next((time for time in nearest_first if capture.read(time).has_subject), middle)


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
            raise ValueError(
                "expected a view of the subject in what is held back, got none; use more cameras or frames, or "
                "choose another --hold-out"
            )
        self._metric = self._metric or load_lpips("alex")
        training = model.training
        model.eval()
        made = [view.score(model, self._metric) for view in self._views]
        model.train(training)
        background = model.background or "black"
        rows = [
            _row(view, [("tuned", own)], background) for view, (_, own) in zip(self._views, made, strict=True)
        ]
        write_image(image, contact_sheet(rows[:4], *TILE_PX))
        psnr_db, lpips = (sum(getattr(s, name) for s, _ in made) / len(made) for name in ("psnr_db", "lpips"))
        return {"psnr_whole": psnr_db, "lpips_subject": lpips, "score": psnr_db - LPIPS_DB * lpips}


def is_better(score: float, best: float | None) -> bool:
    """Whether weights with this score replace those with the best score so far."""
    return best is None or score >= best + MIN_GAIN_DB


@dataclass(frozen=True)
class KeptWeights:
    """The weights that a run kept, by its validations."""

    step: int
    """The step that gave these weights; 0 if they are the starting weights."""
    steps: int
    """The last step that was validated."""
    first: dict[str, float | None]
    """Scores of the weights that the run started from."""
    kept: dict[str, float | None]
    """Scores of the kept weights."""
    largest_gain: float
    """The largest gain of the score over the first weights."""

    @classmethod
    def of(cls, validations: Sequence[tuple[int, dict[str, float | None]]]) -> "KeptWeights | None":
        """The kept weights, by the steps and scores of all validations; None without any score."""
        scored = [(step, scores, scores["score"]) for step, scores in validations if "score" in scores]
        scored = [(step, scores, score) for step, scores, score in scored if score is not None]
        if not scored:
            return None
        kept_step, first, first_score = scored[0]
        kept = first
        best = first_score
        for step, scores, score in scored[1:]:
            if is_better(score, best):
                kept_step = step
                kept = scores
                best = score
        last_step, _, _ = scored[-1]
        gains = [score - first_score for _, _, score in scored[1:]]
        return cls(kept_step, last_step, first, kept, max(gains, default=0.0))

    def describe(self, start: str, validate_every: int) -> list[str]:
        """What was kept, and why, as sentences; `start` names the model that the run started from."""
        few = self.steps < FEW_VALIDATIONS * validate_every
        advice = f"{self.steps} steps are too few to judge: give more --minutes, or use a GPU"
        if self.step == 0:
            why = f"no validation scored at least {MIN_GAIN_DB:g} higher (largest change {self.largest_gain:+.2f})"
            text = f"kept the first weights: the result is '{start}' unchanged, because in {self.steps} steps {why}"
            return [text, advice] if few else [text]
        pairs = [(self.first.get(name), self.kept.get(name)) for name in ("psnr_whole", "lpips_subject")]
        scores = ""
        if all(value is not None for pair in pairs for value in pair):
            (psnr_before, psnr_after), (lpips_before, lpips_after) = pairs
            scores = f": PSNR {psnr_before:.2f} to {psnr_after:.2f} dB, LPIPS {lpips_before:.4f} to {lpips_after:.4f}"
        text = f"kept the weights of step {self.step} of {self.steps}, which score best on what was held out{scores}"
        return [text, advice] if few else [text]


def compare(place: Path, hold_out: str, models: Mapping[str, Inpainter], sheet: Path) -> str:
    """A Markdown table of scores by camera, of the rendered views and of the models.

    Args:
        place: a capture, or a splits file, of which the first capture is used.
        hold_out: the camera that was held out, or `AUTO`.
        models: the models by their names in the table, such as "before" and "after".
        sheet: the views are written to this file as a contact sheet.
    """
    metric = load_lpips("alex")
    rows = []
    columns = ["camera", "PSNR rendered", *models, "LPIPS rendered", *models]
    lines = [f"| {' | '.join(columns)} |", "| --- " * len(columns) + "|"]
    for view in held_back_views(place, hold_out, table=True):
        made = {name: view.score(model, metric) for name, model in models.items()}
        completed = [(name, own) for name, (_, own) in made.items()]
        background = next(iter(models.values())).background or "black"
        scores = [
            view.score_rendered(completed[0][1], background, metric),
            *(own for own, _ in made.values()),
        ]
        note = " (its image was trained on)" if view.trained_on else ""
        psnrs_db = " | ".join(f"{score.psnr_db:.2f}" for score in scores)
        distances = " | ".join(f"{score.lpips:.4f}" for score in scores)
        lines.append(f"| {view.camera}{note} | {psnrs_db} | {distances} |")
        rows.append(_row(view, completed, background))
    write_image(sheet, contact_sheet(rows, *TILE_PX))
    return "\n".join(lines)


def _row(
    view: HeldBackView, completed: Sequence[tuple[str, CompletedView]], background: Background
) -> list[Tile]:
    """The view as rendered, as completed, and the truth, cut to the subject."""
    box = _subject_box(view.truth.mask[0])  # pyrefly: ignore[unsupported-operation]
    images = [("rendered", completed[0][1].view.rgb), *((name, own.rgb) for name, own in completed)]
    images.append(("truth", camera_image(view.truth, background)))
    return [Tile(f"{view.camera}: {name}", picture(image[:, *box])) for name, image in images]
