"""`viewmend calibrate`: calibrate cameras with a board, or refine them with silhouettes."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

if TYPE_CHECKING:
    from viewmend.geometry.bounds import Bounds
    from viewmend.types import MultiViewFrame
Figures = dict[str, dict[str, int | float]]
"""Numbers of each camera, by the camera's name and the number's."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """Find the cameras of a rig, or refine them, and write them as OUT/cameras.json.

    With --board, SOURCE holds a video or a folder of images for each camera, named after it, that
    shows a ChArUco board being carried around; all begin at the same moment. OUT/residuals.png
    shows the reprojection errors. With --silhouettes, SOURCE is a capture with masks, and nothing
    is written unless held-out cameras agree better with the others afterwards. OUT/cameras.json
    refers to the files of SOURCE: copy it there, or next to footage with these names.
    """

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")]
    """Footage of a board, or a capture."""
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """New or empty folder for the results."""
    board: str | None = None
    """The board, as COLUMNSxROWS:SQUARE_M:MARKER_M, counted in squares: 8x6:0.06:0.045."""
    dictionary: str = "DICT_5X5_1000"
    """OpenCV's name of the board's marker dictionary."""
    every: int = 5
    """Only every n-th frame is searched for the board (with --board)."""
    silhouettes: bool = False
    """Refine a capture's poses and focal lengths with its masks."""
    num_frames: int = 12
    """Number of frames to use, evenly spread (with --silhouettes)."""
    frames: str | None = None
    """Frames to use, as FIRST:END by index; either may be omitted."""
    format: str | None = None
    """Format of the capture (docs/formats.md); recognised by default."""
    json: bool = False
    """Write the figures to standard output as one JSON object, and nothing else."""


def run(options: Options) -> int:
    """Run the command; the exit code."""
    from viewmend.cli.checks import check_least
    from viewmend.cli.console import print_json, say, show
    from viewmend.data.native_writer import atomic_folder

    if (options.board is not None) == options.silhouettes:
        raise ValueError("expected either --board or --silhouettes, got both or neither; choose one of them")
    check_least(options, every=1, num_frames=1)
    with atomic_folder(options.out) as unfinished:
        figures = (_by_silhouettes if options.silhouettes else _by_board)(options, unfinished)
    if options.json:
        print_json(figures)
    else:
        show(
            *(
                f"{name}  " + ", ".join(f"{key} {n:.4g}" for key, n in row.items())
                for name, row in figures.items()
            )
        )
    say(f"wrote {options.out}")
    return 0


def _by_board(options: Options, out: Path) -> Figures:
    from viewmend.cli.checks import chosen_times
    from viewmend.cli.console import busy, track
    from viewmend.data.images import write_image
    from viewmend.data.native_format import write_calibration
    from viewmend.preprocess.calibration.board import find_board, open_footage, parse_board
    from viewmend.preprocess.calibration.bundle import calibrate, draw_residuals

    assert options.board is not None
    board = parse_board(options.board, options.dictionary)
    footage = open_footage(options.source)
    times = chosen_times(options.frames, len(footage.frames))[:: options.every]
    seen = find_board(board, footage, times, lambda cameras: track(cameras, "looking for the board"))
    sizes = [(camera.width, camera.height) for camera in footage.cameras]
    with busy("adjusting all cameras"):
        found = calibrate(seen, board, [camera.name for camera in footage.cameras], sizes)
    cameras = tuple(
        replace(
            camera, K=one.K, dist=one.dist, R=one.camera_from_world[:3, :3], t_m=one.camera_from_world[:3, 3]
        )
        for camera, one in zip(footage.cameras, found, strict=True)
    )
    up: Any = -sum(camera.R[1] for camera in cameras)
    out.mkdir()
    # The footage that this calibration is for has other frames than that of the board
    write_calibration(out, replace(footage, cameras=cameras, up=up, frames=()))
    write_image(out / "residuals.png", draw_residuals(cameras, found))
    images = [sum(view == number for view, _ in seen) for number in range(len(cameras))]
    return {
        camera.name: {"images": count, "corners": len(one.corners), "rms_px": one.rms_px}
        for camera, one, count in zip(cameras, found, images, strict=True)
    }


def _by_silhouettes(options: Options, out: Path) -> Figures:
    from viewmend.cli.console import busy, say, track
    from viewmend.data.formats import read_any_calibration
    from viewmend.data.native_format import write_calibration
    from viewmend.preprocess.calibration.bundle import with_cameras
    from viewmend.preprocess.calibration.cross_validation import (
        best_hold,
        cameras_to_hold_out,
        refine_all,
        validate_without,
    )

    frames, bounds = _frames(options)
    names = frames[0].cameras.names
    with busy("choosing how far cameras may move"):
        hold = best_hold(frames, bounds)
    scores = [
        validate_without(frames, name, bounds, hold)
        for name in track(cameras_to_hold_out(names), "cameras left out")
    ]
    for score in scores:
        say(
            f"{score.camera} left out: IoU of its mask and the others' hull {score.before:.4f}, "
            f"after refining them {score.after:.4f}"
        )
    before, after = (
        sum(own) / len(scores) for own in zip(*((s.before, s.after) for s in scores), strict=True)
    )
    if after <= before:
        raise ValueError(
            "expected left-out cameras to agree better with the refined others, got a mean IoU of "
            f"{after:.4f} after and {before:.4f} before; keep the calibration, or use more frames (--num-frames) or "
            "better masks"
        )
    with busy("refining all cameras"):
        refined = refine_all(frames, bounds, hold)
    out.mkdir()
    unrefined = read_any_calibration(options.source, options.format)
    write_calibration(out, with_cameras(unrefined, refined.cameras))
    held = {f"{score.camera} left out": {"iou": score.before, "refined": score.after} for score in scores}
    return {"outlines": {"missed_px": refined.before_px, "refined_px": refined.after_px}} | held


def _frames(options: Options) -> "tuple[list[MultiViewFrame], Bounds | None]":
    """Frames with a subject, all with the same cameras, as many as possible; and the capture's bounds."""
    from viewmend.cli.checks import chosen_times
    from viewmend.cli.console import say
    from viewmend.data.prepare import open_masked, prepare
    from viewmend.preprocess.calibration.silhouettes import MIN_CAMERAS

    capture = open_masked(options.source, format=options.format)
    times = chosen_times(options.frames, len(capture.frame_ids))
    count = min(options.num_frames, len(times))
    prepared = prepare(capture, match_colours=False, tighten_masks=False, first=times[0])
    read = [prepared.read(times[len(times) * number // count]) for number in range(count)]
    read = [frame for frame in read if frame.has_subject]
    if not read:
        raise ValueError(f"expected a subject in one of {count} frames, got none; choose other --frames")
    most = max((frame.cameras.names for frame in read), key=len)
    frames = [frame for frame in read if frame.cameras.names == most]
    if len(most) < MIN_CAMERAS + 1:
        raise ValueError(
            f"expected {MIN_CAMERAS + 1} cameras or more with masks, got {len(most)}; use more, or --board"
        )
    if len(frames) < count:
        say(
            f"of {count} chosen frames, {len(frames)} are used: the others show no subject or lack some of the "
            f"{len(most)} cameras"
        )
    return frames, capture.bounds
