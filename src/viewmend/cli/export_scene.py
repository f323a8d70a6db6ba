"""`viewmend export-scene`: exports a capture as a scene for Blender, Unreal, Unity, Houdini and similar programs."""

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from viewmend.cli.checks import Geometry, Precision, PreparationOptions, check_fps, check_least
from viewmend.utils.options import FLAT

if TYPE_CHECKING:
    from viewmend.data.prepare import PreparedCapture
    from viewmend.frame_cache import CachedFrame
    from viewmend.geometry.cameras import Cameras


@dataclass(frozen=True, kw_only=True)
class Options:
    """Export a capture as a scene for 3D engines.

    Written to OUT, per frame: the hull in the cameras' colours (hull/*.glb and *.ply) and the
    points of the completed views (points/*.ply). Per view and frame: its image with alpha
    (rgba/VIEW/*.png) and its z-depth in metres as 32-bit float (depth/VIEW/*.exr, 0 where there is
    no subject). And the cameras of the rig and of the views, as USD (cameras.usda) and in a script
    that opens everything in Blender (open_in_blender.py). Metres, +y up.
    """

    capture: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="CAPTURE")]
    """A capture of any supported format, with masks."""
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """Folder to write the scene to."""
    format: str | None = None
    """Format of the capture (docs/formats.md); recognised by default."""
    views: int = 8
    """Number of views around the subject that are completed in every frame."""
    path: Path | None = None
    """A JSON file of views to use instead, as for `viewmend mend --path`; all are completed in
    every frame."""
    frames: str | None = None
    """Frames to export, as FIRST:END by index; either may be omitted."""
    max_image_size: int | None = None
    """Downscale images to at most this longer side, in pixels; views around the subject get the same size."""
    fps: float | None = None
    """Frames per second; by default those of the capture, or 15."""
    model: str | None = None
    """Name of a shipped model, a model's folder, or any method of `viewmend evaluate`."""
    min_confidence: float = 0.5
    """Drop points below this confidence, 0 to 1, if the model predicts one."""
    preparation: Annotated[PreparationOptions, FLAT] = field(default_factory=PreparationOptions)
    device: str = "cpu"
    """Device to compute on: cpu or cuda."""
    geometry: Geometry = "hull"
    """Geometry proxy: the visual 'hull' of the masks, or 'fused', the hull tightened by depth that
    the model 'views' predicts all around the subject. Fusing adds 3 to 7 seconds to each
    frame."""
    precision: Precision = "auto"
    """Number format of viewmend's own networks. 'auto' is bfloat16 if the model was
    trained in it and the device computes in it natively, otherwise float32."""


def run(options: Options) -> int:
    """Run the command; the exit code."""
    check_least(options, views=1)
    check_fps(options.fps)
    if not 0 <= options.min_confidence <= 1:
        raise ValueError(f"expected --min-confidence from 0 to 1, got {options.min_confidence}; choose again")
    from viewmend.cli.checks import chosen_times, load_named, log_preparation, with_two_cameras
    from viewmend.cli.console import say, track
    from viewmend.data.camera_path import STATIC_FPS
    from viewmend.data.prepare import first_with_subject, open_masked, prepare
    from viewmend.data.source import prefetch
    from viewmend.export.scene import RESULTS, check_openexr, export_scene
    from viewmend.models.registry import error_model_for
    from viewmend.stream import Stream, StreamConfig
    from viewmend.utils.output_folder import OutputFolder

    check_openexr()
    opened = open_masked(options.capture, format=options.format)
    times = chosen_times(options.frames, len(opened.frame_ids))
    inpainter = load_named(options.model, options.device, options.precision)
    needs_model = inpainter.needs_mask or options.geometry == "fused"
    error_model = error_model_for(inpainter, options.device, options.precision) if needs_model else None
    stream = Stream(inpainter, StreamConfig(geometry=options.geometry), opened.bounds, error_model)
    with OutputFolder(options.out) as folder:
        folder.check_own_files(*RESULTS)
        prepared = asdict(options.preparation)
        size = options.max_image_size
        capture = prepare(opened, max_image_size=size, **prepared, first=times[0])
        log_preparation(capture)
        shown = first_with_subject(capture, first=times[0], least=2) or capture.read(times[0])
        first = stream.add_frame(shown.to(options.device))
        views = _views(options, first, capture, opened.cameras[0].max_size_px)
        fps = options.fps or capture.fps or STATIC_FPS
        usable = with_two_cameras(prefetch(capture, times), capture, len(times))
        frames = (frame.to(options.device) for frame in usable)
        more = {"up": capture.up, "fps": fps, "min_confidence": options.min_confidence}
        frames = track(frames, "exporting", len(times))
        written = export_scene(frames, stream, views, capture.cameras, folder.draft, **more)
        folder.publish(*RESULTS)
    say(
        f"{options.out}: {written.frames} frames of {written.views} views; {written.vertices} vertices, "
        f"{written.points} points"
    )
    if opened.origin_m.any():
        origin = ", ".join(f"{value:.3f}" for value in opened.origin_m)
        say(f"the scene's origin is at ({origin}) m of the capture, whose cameras are far from its origin")
    return 0


def _views(
    options: Options, first: "CachedFrame", capture: "PreparedCapture", full_size_px: tuple[int, int]
) -> "Cameras":
    """The views to complete; `full_size_px` is the size of the first camera's images, before they are reduced."""
    from viewmend.completed_cameras import place_around
    from viewmend.data.camera_path import read_camera_path
    from viewmend.data.capture_folder import origin_of
    from viewmend.geometry.proxy import GeometryProxy

    if options.path is not None:
        return read_camera_path(options.path, capture.cameras, origin_of(capture), full_size_px).cameras
    assert isinstance(first.proxy, GeometryProxy), "no other geometry was given"
    return place_around(capture.cameras, first.proxy.center, capture.up, options.views)
