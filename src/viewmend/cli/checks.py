"""Options, checks of options, and messages that several commands share."""

import re
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from viewmend.cli.console import say
from viewmend.utils.options import NEGATED

if TYPE_CHECKING:
    from viewmend.data.prepare import PreparedCapture
    from viewmend.data.source import CaptureSource
    from viewmend.models.base import Inpainter
    from viewmend.rendering.view import RenderConfig
    from viewmend.types import MultiViewFrame

Geometry = Literal["hull", "fused"]
"""The kinds of geometry proxy, as in `StreamConfig.geometry`."""

Precision = Literal["auto", "float32", "bfloat16"]
"""Number formats in which our networks compute."""

MAX_NAMED = 5
"""Messages name up to this many frames."""


@dataclass(frozen=True, kw_only=True)
class ViewOptions:
    """How views are rendered, and which of their pixels are inpainted."""

    num_source_views: int = 3
    """Number of source cameras: those closest to the view, which colour it. Our models choose their
    own context."""
    view_selection: Literal["angle", "direction"] = "angle"
    """How closeness is measured: by the 'angle' at the subject, or by viewing 'direction', an
    option of RIFTCast."""
    error_rule: str | None = None
    """Pixels to inpaint: 'holes', which no camera colours; 'all' of the subject, for models that
    leave correct pixels unchanged; 'predicted', which a model predicts to be wrong; or
    FILE.py:NAME, your own rule. By default, the rule that the model is made for."""
    refine_fraction: float = 0.15
    """Largest fraction of the subject to inpaint, all holes first (with the error rule
    'predicted')."""

    def config(self) -> "RenderConfig":
        """The renderer's configuration; ValueError for options that are out of range."""
        from viewmend.rendering.view import RenderConfig

        check_least(self, num_source_views=1)
        return RenderConfig(
            cameras=self.num_source_views,
            selection=self.view_selection,
            error_rule=self.error_rule,
            refine_fraction=self.refine_fraction,
        )


@dataclass(frozen=True, kw_only=True)
class PreparationOptions:
    """What is corrected in a capture."""

    align: Annotated[bool, NEGATED] = True
    """Use the calibration as it is, and do not look for cameras that are out of sync. By default, a
    shift that all images share (for example from another convention for pixel centres) is estimated
    from the masks of one frame, and undone if the masks then agree better."""
    match_colours: Annotated[bool, NEGATED] = True
    """Use the cameras' colours as they are. By default, the input cameras are colour-matched in one
    frame, if they then agree better on held-out surface points."""
    tighten_masks: Annotated[bool, NEGATED] = True
    """Use the masks as they are. By default, masks that extend beyond the subject, judging by the
    colours along the outline in one frame, are tightened by that width."""


def check_least(options: object, **least: int) -> None:
    """Raise a ValueError for an option below its least value; options without a value are skipped."""
    for name, low in least.items():
        value = getattr(options, name)
        if value is not None and not value >= low:
            raise ValueError(
                f"expected --{name.replace('_', '-')} of at least {low}, got {value}; see --help"
            )


def check_fps(fps: float | None) -> None:
    """Raise a ValueError for an option --fps that is out of range."""
    if fps is not None and not 0 < fps <= 240:
        raise ValueError(f"expected --fps above 0 and at most 240, got {fps}; choose again")


def check_device(name: str) -> None:
    """Raise a ValueError unless this device exists."""
    import torch

    count = torch.cuda.device_count()
    available = ["cpu", *(["cuda"] if count else []), *(f"cuda:{number}" for number in range(count))]
    if name not in available:
        raise ValueError(f"expected an available device ({', '.join(available)}), got '{name}'; choose one")


def check_people(performers: Path | None, motions: Path | None) -> None:
    """Raise a ValueError unless both or neither are given, and exist."""
    if (performers is None) != (motions is None):
        raise ValueError("expected both --performers and --motions, got one of them; give both folders")
    for option, folder in (("performers", performers), ("motions", motions)):
        if folder is not None and not folder.exists():
            raise ValueError(f"{folder}: expected the folder of --{option}, found nothing; check the path")


def load_named(name: str | None, device: str, precision: Precision = "auto") -> "Inpainter":
    """Load the method of this name (`make_method`); by default the shipped model, or Telea's fill without one.

    Raises:
        ValueError: there is no such method, it is damaged, or the device does not exist.
    """
    from viewmend.models.registry import default_method, make_method

    check_device(device)
    if name is None:
        name = default_method()
        if name == "telea":
            say("this version ships no model: holes are filled with OpenCV's Telea inpainting")
    return make_method(name, device, precision)


def make_studio(
    seed: int | None, cameras: int, frames: int, size_px: int, max_image_size: int | None
) -> "PreparedCapture":
    """The synthetic scene that stands for a capture; without a seed, one that no model was trained with."""
    from viewmend.data.prepare import prepare
    from viewmend.scenes.held_out import PROCEDURAL_SEEDS
    from viewmend.studio.stage import Studio, StudioConfig

    chosen = PROCEDURAL_SEEDS["test"][1] if seed is None else seed
    config = StudioConfig(seed=chosen, cameras=cameras, frames=frames, size_px=size_px, fps=15.0)
    return prepare(
        Studio(config), max_image_size=max_image_size, align=False, match_colours=False, tighten_masks=False
    )


def chosen_times(text: str | None, count: int) -> range:
    """The frame indices that `--frames FIRST:END` selects out of `count`; all by default.

    Negative indices count from the end. Says so if there are fewer frames than asked for.

    Raises:
        ValueError: there is no such frame.
    """
    parts = re.fullmatch(r"(-?\d{1,9})?:(-?\d{1,9})?", text or ":")
    first, end = (None if part is None else int(part) for part in parts.groups()) if parts else (0, 0)
    times = range(count)[first:end]
    if not times:
        raise ValueError(f"expected --frames FIRST:END within 0:{count}, got '{text}'; for example 0:{count}")
    if any(abs(index) > count for index in (first, end) if index is not None):
        say(f"--frames {text}: there are {count} frames, so {times[0]}:{times[-1] + 1} is used")
    return times


def log_preparation(capture: "PreparedCapture") -> None:
    """Report what preparation changed in a capture. Issues have already been logged as warnings."""
    for text in capture.changes:
        say(text)


def with_two_cameras(
    frames: "Iterable[MultiViewFrame]", source: "CaptureSource", count: int
) -> "Iterator[MultiViewFrame]":
    """Those of `count` frames of which a hull can be computed; reports the others, which are skipped.

    Raises:
        ValueError: there is no such frame.
    """
    skipped = []
    for frame in frames:
        if len(frame.cameras) >= 2:
            yield frame
        else:
            skipped.append(source.frame_ids[frame.time])
    if len(skipped) == count:
        raise ValueError(
            f"{source.name}: expected a frame with two usable cameras, got none; choose other --frames"
        )
    if skipped:
        number = f"{len(skipped)} of {count} frames"
        say(
            f"{number} have fewer than two usable cameras and were skipped, which shortens the result; "
            f"the first is '{skipped[0]}'"
        )


def without_subject(source: "CaptureSource", times: Collection[int], count: int) -> str:
    """Which of `count` frames, those at these times, have no subject, in words."""
    ids = [f"'{source.frame_ids[time]}'" for time in sorted(times)]
    more = f" and {len(ids) - MAX_NAMED} more" if len(ids) > MAX_NAMED else ""
    return f"{len(ids)} of {count} frames have no subject ({', '.join(ids[:MAX_NAMED])}{more})"
