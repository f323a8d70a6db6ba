"""`viewmend export-scene`: a capture as a scene for Blender, Unreal, Unity, Houdini and their like."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

if TYPE_CHECKING:
    from torch import Tensor

    from viewmend.capture.prepare import PreparedCapture
    from viewmend.capture.source import CaptureSource
    from viewmend.geometry.cameras import Cameras
    from viewmend.observation import Observation


@dataclass(frozen=True, kw_only=True)
class Options:
    """Write a capture as a scene that engines take.

    OUT gets, for each time, the hull with the cameras' colours (hull/*.glb and *.ply) and the points that the mended
    views show (points/*.ply); for each view and time its picture, RGB and alpha (rgba/VIEW/*.png), and z-depth in
    metres as 32-bit float (depth/VIEW/*.exr, 0 where there is no subject); and the cameras of the rig and of the views,
    as USD (cameras.usda) and as a script that opens all of it in Blender (open_in_blender.py). Metres, +y up.
    """

    capture: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="CAPTURE")]
    """A capture of any format that is read, with masks."""
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """Folder for the scene."""
    kind: str | None = None
    """The capture's format, as docs/formats.md names it; by default it is recognised."""
    views: int = 8
    """How many views about the subject are mended at every time."""
    path: Path | None = None
    """A JSON file of views instead, as `viewmend mend --path` takes it; every one is mended at every time."""
    frames: str | None = None
    """Which frames, as FIRST:END by index; either may be left out."""
    longest_px: int | None = None
    """Reduce images to at most this length of their longer side; views about the subject are as large."""
    model: str | None = None
    """What mends: a shipped model's name or a model's folder, or any method that `viewmend evaluate` takes."""
    least_confidence: float = 0.5
    """Pixels less sure than this are no points, 0 to 1, where the model tells."""
    align: bool = True
    """Take the calibration as it is; by default a shift that all images share is undone."""
    match_colours: bool = True
    """Leave the cameras' colours as they are; by default they are matched, as `viewmend mend` does."""
    device: str = "cpu"
    """Where to compute: cpu, or cuda."""


def run(options: Options) -> int:
    """Run the command; the exit code."""
    if options.views < 1 or not 0 <= options.least_confidence <= 1:
        raise ValueError(
            f"expected --views of at least 1 and --least-confidence from 0 to 1, got {options.views} and "
            f"{options.least_confidence}; choose again"
        )
    from viewmend.capture.prefetch import prefetch
    from viewmend.capture.prepare import open_masked
    from viewmend.cli.checks import chosen_times, load_named
    from viewmend.cli.console import say, track
    from viewmend.export.depth_files import demand_openexr
    from viewmend.export.scene import RESULTS, export_scene
    from viewmend.output_folder import OutputFolder
    from viewmend.stream import Stream

    demand_openexr()
    opened = open_masked(options.capture, kind=options.kind)
    times = chosen_times(options.frames, len(opened.frame_ids))
    stream = Stream(load_named(options.model, options.device), bounds=opened.bounds)
    with OutputFolder(options.out) as folder:
        folder.demand_own(*RESULTS)
        capture = _prepared(options, opened, times[0])
        first = stream.push(capture.read(times[0]).to(options.device))
        views = _views(options, first, capture.cameras, capture.up)
        frames = (frame.to(options.device) for frame in prefetch(capture, times))
        shown = track(frames, "exporting", len(times))
        written = export_scene(
            shown,
            stream,
            views,
            capture.cameras,
            folder.draft,
            up=capture.up,
            fps=capture.fps,
            least_confidence=options.least_confidence,
        )
        folder.publish(*RESULTS)
    say(
        f"{options.out}: {written.times} times of {written.views} views; {written.vertices} vertices of hulls, "
        f"{written.points} points"
    )
    return 0


def _prepared(options: Options, opened: "CaptureSource", first: int) -> "PreparedCapture":
    from viewmend.capture.prepare import prepare
    from viewmend.cli.prepared import say_prepared

    capture = prepare(
        opened,
        longest_px=options.longest_px,
        align=options.align,
        match_colours=options.match_colours,
        first=first,
    )
    say_prepared(capture)
    return capture


def _views(options: Options, first: "Observation", rig: "Cameras", up: "Tensor | None") -> "Cameras":
    from viewmend.capture.camera_path import read_path
    from viewmend.geometry.orbit import orbit_around
    from viewmend.geometry.proxy import GeometryProxy

    if options.path is not None:
        return read_path(options.path, rig)
    assert isinstance(first.proxy, GeometryProxy), "no other geometry was pushed"
    center, count = first.proxy.mesh.vertices.mean(0).cpu(), options.views
    around = orbit_around(center, rig, up, count, count)
    back = count > 2 and around.centers[1].allclose(around.centers[-1], atol=1e-4)
    return orbit_around(center, rig, up, count, 2 * count - 2) if back else around  # a swing: only there
