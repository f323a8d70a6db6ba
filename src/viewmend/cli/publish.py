"""`viewmend publish`: a capture as a folder of static files, for any web host."""

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from viewmend.cli.checks import (
    Geometry,
    Precision,
    PreparationOptions,
    ViewOptions,
    check_fps,
    check_least,
    make_studio,
)
from viewmend.utils.options import FLAT

if TYPE_CHECKING:
    from viewmend.data.prepare import PreparedCapture

STUDIO_FRAMES = 24
"""The synthetic scene has this many frames, unless --frames asks for more."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """Write a capture as a web page of static files, which any web host serves.

    The page draws views in the browser, from the frames' meshes, the cameras' images and views that
    were completed in advance. OUT gets index.html, scene.json, poster.jpg, page/ and frames/; all
    addresses in it are relative. To look at it on this machine, run `python -m http.server` in OUT.
    See docs/guide/publish.md.
    """

    capture: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="CAPTURE|studio")]
    """A capture with masks, in any supported format; or 'studio' for a synthetic scene."""
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """Folder to write the page to."""
    format: str | None = None
    """Format of the capture (docs/formats.md); recognised by default."""
    frames: str | None = None
    """Frames to publish, as FIRST:END by index; either may be omitted."""
    title: str | None = None
    """Title of the page; by default the capture's name."""
    max_mb: float = 100.0
    """Largest size of all files together, in megabytes. Images and meshes are made coarser until they fit."""
    completed_cameras: int = 24
    """Number of completed views around the subject, in every frame, that the page draws from; at
    most 24. 0: none."""
    cameras: tuple[str, ...] = ()
    """Names of the input cameras; all by default."""
    fps: float | None = None
    """Frames per second; by default those of the capture, or 10."""
    max_image_size: int = 1024
    """Downscale images to at most this longer side, in pixels."""
    model: str | None = None
    """Name of a shipped model, a model's folder, or any method of `viewmend evaluate`."""
    preparation: Annotated[PreparationOptions, FLAT] = field(default_factory=PreparationOptions)
    view: Annotated[ViewOptions, FLAT] = field(default_factory=ViewOptions)
    size: int = 320
    """Width and height of the images of 'studio', in pixels."""
    seed: int | None = None
    """Seed of the scene of 'studio'; by default one that no model was trained with."""
    device: str = "cpu"
    """Device to compute on: cpu or cuda."""
    geometry: Geometry = "fused"
    """Geometry proxy: the visual 'hull' of the masks, or 'fused', the hull tightened by depth that the
    model 'views' predicts all around the subject. Fusing adds 3 to 7 seconds to each
    frame."""
    precision: Precision = "auto"
    """Number format of viewmend's own networks. 'auto' is bfloat16 if the model was
    trained in it and the device computes in it natively, otherwise float32."""


def run(options: Options) -> int:
    """Run the command; the exit code."""
    _check(options)
    from viewmend.cli.checks import chosen_times, load_named, log_preparation, with_two_cameras
    from viewmend.cli.console import say, track
    from viewmend.data.prepare import first_with_subject
    from viewmend.data.source import prefetch
    from viewmend.models.registry import error_model_for
    from viewmend.publishing import DEFAULT_FPS, RESULTS, PublishConfig, publish
    from viewmend.stream import Stream, StreamConfig
    from viewmend.utils.output_folder import OutputFolder

    capture = _open(options)
    times = chosen_times(options.frames, len(capture.frame_ids))
    inpainter = load_named(options.model, options.device, options.precision)
    render = options.view.config()
    needs_model = inpainter.needs_mask or options.geometry == "fused" or render.error_rule == "predicted"
    stream = Stream(
        inpainter,
        StreamConfig(geometry=options.geometry, render=render),
        capture.bounds,
        error_model_for(inpainter, options.device, options.precision) if needs_model else None,
    )
    config = PublishConfig(
        title=options.title or capture.name,
        max_mb=options.max_mb,
        completed_cameras=options.completed_cameras,
        fps=options.fps or capture.fps or DEFAULT_FPS,
    )
    with OutputFolder(options.out) as folder:
        folder.check_own_files(*RESULTS)
        log_preparation(capture)
        shown = first_with_subject(capture, first=times[0], least=2) or capture.read(times[0])
        first = stream.add_frame(shown.to(options.device))
        usable = with_two_cameras(prefetch(capture, times), capture, len(times))
        frames = (frame.to(options.device) for frame in usable)
        used = [name for name in capture.cameras.names if name not in capture.left_out]
        made = publish(
            track(frames, "publishing", len(times)),
            len(times),
            stream,
            first,
            capture.cameras.select(used),
            capture.up,
            folder.draft,
            config,
        )
        folder.publish(*RESULTS)
    total = f"{made.frames} frame{'s' if made.frames > 1 else ''}, {made.size_bytes / 1e6:.1f} MB"
    first = f"{made.first_bytes / 1e6:.1f} MB until the first frame is complete"
    scale = made.detail.image_scale
    size = "full size" if scale == 1 else f"{scale:g} of their size"
    detail = f"images at {size}, JPEG quality {made.detail.jpeg_quality}"
    say(f"{options.out}: {total}, {first}; {detail}")
    say(f"look at it: python -m http.server --directory {options.out}, then open http://localhost:8000")
    return 0


def _check(options: Options) -> None:
    """Raise a ValueError for an option that is out of range, before anything heavy is imported."""
    check_least(options, completed_cameras=0, max_image_size=1, size=1)
    if not options.max_mb > 0:
        raise ValueError(f"expected --max-mb above 0, got {options.max_mb}; choose a size in megabytes")
    check_fps(options.fps)


def _open(options: Options) -> "PreparedCapture":
    """The capture, checked and aligned, or the synthetic scene."""
    from viewmend.data.prepare import open_masked, prepare

    if options.capture == "studio":
        return make_studio(options.seed, 8, STUDIO_FRAMES, options.size, options.max_image_size)
    opened = open_masked(options.capture, options.cameras or None, format=options.format)
    return prepare(opened, max_image_size=options.max_image_size, **asdict(options.preparation))
