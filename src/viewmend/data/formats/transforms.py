"""`transforms.json` of nerfstudio, instant-ngp and Blender.

Each of its frames is a camera of a single frame, or, if they have a `time`, a camera at one time.
Without `time`, poses and names may show that a fixed rig was recorded at several times.
"""

import math
from pathlib import Path, PurePosixPath
from typing import Annotated, Any

import numpy as np
from msgspec import Meta, Struct, structs

from viewmend.data.containers import container_of, stored_path
from viewmend.data.formats.files import (
    IMAGE_SUFFIXES,
    existing,
    frame_pattern,
    image_size_px,
    names_from_paths,
    names_of_patterns,
    warn,
    warn_of_unused_images,
)
from viewmend.data.formats.moments import PosedImage, fixed_cameras
from viewmend.data.images import uses_alpha
from viewmend.data.native_format import stays_inside
from viewmend.utils.untrusted_input import Number, bounded_bytes, read_json, typed

NAMES = ("transforms.json", "transforms_train.json")
MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
MILLIMETRES = 0.001
"""The only supported unit of depth."""
POSE_DIGITS = 6
"""Poses that are equal to this many decimals are those of one camera."""
OTHER_MEANING = ("equirectangular", "latlong", "from_mitsuba", "ftheta_p0", "ortho_scale")
"""Keys that give images or poses another meaning if set."""
WITHOUT_EFFECT = (
    "aabb_scale",
    "scale",
    "offset",
    "up",
    "applied_transform",
    "applied_scale",
    "ply_file_path",
    "name",
    "version",
    "train_filenames",
    "val_filenames",
    "test_filenames",
    "orientation_override",
    "auto_scale_poses_override",
    "n_extra_learnable_dims",
    "white_transparent",
    "black_transparent",
    "render_aabb",
    "sharpen",
    "sharpness",
    "enable_depth_loading",
    "fix_premult",
    "envmap",
    "colmap_im_id",
    "rotation",
    "camera_angle",
    "fovx",
    "fovy",
    "fov_x",
    "fov_y",
    "fisheye_crop_radius",
    "normal_file_path",
    "semantics_path",
    "transform_matrix_start",
    "transform_matrix_end",
)
"""Keys that change neither images nor cameras."""
SUFFIXES = ("", *IMAGE_SUFFIXES, *map(str.upper, IMAGE_SUFFIXES))
"""What is added to the path of an image without such a file."""
Row = tuple[Number, Number, Number, Number]
Angle = Annotated[float, Meta(gt=0, lt=3.14)]
Side = Annotated[int, Meta(ge=1, le=2**16)]


class Lens(Struct, kw_only=True):
    """Intrinsics, at the top level or of one frame."""

    camera_model: str | None = None
    is_fisheye: bool | None = None
    camera_angle_x: Angle | None = None
    camera_angle_y: Angle | None = None
    fl_x: Number | None = None
    fl_y: Number | None = None
    cx: Number | None = None
    cy: Number | None = None
    w: Side | None = None
    h: Side | None = None
    k1: Number | None = None
    k2: Number | None = None
    k3: Number | None = None
    k4: Number | None = None
    k5: Number | None = None
    k6: Number | None = None
    p1: Number | None = None
    p2: Number | None = None
    rolling_shutter: list[Number] | None = None


class _Entry(Lens, kw_only=True):
    file_path: Annotated[str, Meta(min_length=1)]
    transform_matrix: Annotated[tuple[Row, ...], Meta(min_length=3, max_length=4)]
    """world_from_camera, OpenGL axes."""
    mask_path: str | None = None
    depth_file_path: str | None = None
    time: Number | None = None


class _File(Lens, kw_only=True):
    frames: list[_Entry]
    from_na: bool = False
    integer_depth_scale: Number = MILLIMETRES
    depth_unit_scale_factor: Number = MILLIMETRES


def find(folder: Path) -> Path | None:
    """The file that identifies the format."""
    return next((folder / name for name in NAMES if (folder / name).is_file()), None)


def content(folder: Path, file: Path) -> dict[str, Any]:
    """All frames. The alpha of the images is the mask if no frame names one, and an image is not opaque."""
    parsed = read_json(bounded_bytes(file))
    read = typed(parsed, _File, "see docs/formats.md")
    _check_keys(file, parsed)
    frames = [_with_local_paths(folder, frame) for frame in read.frames]
    if file.name == NAMES[0]:  # the others name a part of the images
        paths = [(frame.file_path, frame.mask_path, frame.depth_file_path) for frame in frames]
        warn_of_unused_images(folder, (str(PurePosixPath(path)) for own in paths for path in own if path))
    is_timed = len({frame.time for frame in frames}) > 1
    if not is_timed:
        frames = existing(folder, frames, lambda frame: frame.file_path)
    _check_suffixes(folder, frames)
    scales = {read.integer_depth_scale, read.depth_unit_scale_factor}
    if read.from_na or (scales != {MILLIMETRES} and any(frame.depth_file_path for frame in frames)):
        got = "from_na" if read.from_na else f"a scale of {max(scales)}"
        raise ValueError(f"expected OpenGL axes and depth in millimetres (0.001), got {got}; export it again")
    named = any(frame.mask_path for frame in frames)
    alpha = not named and any(uses_alpha(folder / f.file_path) for f in frames if stays_inside(f.file_path))
    rig = None
    if not is_timed and not any(frame.depth_file_path for frame in frames):
        rig = fixed_cameras([_posed(folder, read, frame, alpha) for frame in frames])
    entries, ids = rig or _entries(folder, read, frames, alpha)
    return {"first_pixel_center": [0.5, 0.5], "up": [0.0, 0.0, 1.0], "frames": ids, "cameras": entries}


def _entries(
    folder: Path, file: _File, frames: list[_Entry], alpha: bool
) -> tuple[list[dict[str, Any]], tuple[str, ...]]:
    """The cameras by pose and `time`, and the frame ids; with `alpha`, images are their own masks."""
    cameras, ids = _cameras_of(frames)
    paths = [camera[0].file_path for camera in cameras]
    names = names_from_paths(paths) if len(ids) == 1 else names_of_patterns(paths)
    entries = []
    for (pattern, frame), name in zip(cameras, names, strict=True):
        posed = _posed(folder, file, frame, alpha)
        entry = {"name": name, **posed.lens, "R": posed.R.tolist(), "t": (-posed.R @ posed.center).tolist()}
        files = {"image": pattern.file_path, "mask": pattern.mask_path, "depth": pattern.depth_file_path}
        entries.append(entry | files | ({"mask": pattern.file_path} if alpha else {}))
    return entries, ids


def _posed(folder: Path, file: _File, frame: _Entry, alpha: bool) -> PosedImage:
    """A frame's image, lens and pose; with `alpha`, the image is its own mask."""
    world_from_camera = np.array(frame.transform_matrix, float)[:3]
    R = np.diag([1.0, -1.0, -1.0]) @ world_from_camera[:, :3].T  # from OpenGL to OpenCV axes
    mask = frame.file_path if alpha else frame.mask_path
    lens = _intrinsics(folder, frame.file_path, file, frame)
    return PosedImage(frame.file_path, mask, lens, R, world_from_camera[:, 3])


def _check_keys(file: Path, parsed: dict[str, Any]) -> None:
    """Warn of keys whose effect is unknown; raise a ValueError for keys that change the meaning of images or poses."""
    parts = [parsed, *parsed["frames"]]
    other = [key for key in OTHER_MEANING if any(part.get(key) for part in parts)]
    if any(part.get("transform_matrix_start") != part.get("transform_matrix_end") for part in parts):
        other.append("transform_matrix_start other than transform_matrix_end")
    if other:
        got = ", ".join(other)
        raise ValueError(f"expected perspective images of one moment, OpenGL axes, got {got}; convert them")
    fields = {*_File.__struct_fields__, *_Entry.__struct_fields__}
    unknown = sorted({key for part in parts for key in part} - fields - {*OTHER_MEANING, *WITHOUT_EFFECT})
    if unknown:
        warn(f"{file}: these keys are not known and have no effect: {', '.join(unknown)[:200]}")


def _with_local_paths(folder: Path, frame: _Entry) -> _Entry:
    """The frame with paths as on this system, and with the suffix of the image, which Blender omits."""
    mask, depth = (path and path.replace("\\", "/") for path in (frame.mask_path, frame.depth_file_path))
    image = str(PurePosixPath(frame.file_path.replace("\\", "/")))
    if stays_inside(image):
        found = (stored_path(folder, f"{image}{suffix}") for suffix in SUFFIXES)
        image = next((path for path in found if (folder / path).is_file()), image)
    return structs.replace(frame, file_path=image, mask_path=mask, depth_file_path=depth)


def _check_suffixes(folder: Path, frames: list[_Entry]) -> None:
    """ValueError for an image without suffix that was not found under any."""
    for path in (frame.file_path for frame in frames if stays_inside(frame.file_path)):
        if (
            PurePosixPath(path).suffix.lower() not in IMAGE_SUFFIXES
            and not container_of(folder / path).is_file()
        ):
            expected = f"an image {path[:200]!r}, or this with an image suffix such as .png or .jpg"
            raise ValueError(f"expected {expected}, got none; add the file, or correct file_path")


def _cameras_of(frames: list[_Entry]) -> tuple[list[tuple[_Entry, _Entry]], tuple[str, ...]]:
    """Each camera's entry with patterns as paths and its first frame's entry, and the frame ids in order of time."""
    by_pose: dict[bytes, dict[float | None, _Entry]] = {}
    for frame in frames:
        pose = (np.round(frame.transform_matrix, POSE_DIGITS) + 0.0).tobytes()
        at_pose = by_pose.setdefault(pose, {})
        if frame.time in at_pose:
            got = f"{at_pose[frame.time].file_path[:60]} and {frame.file_path[:60]} at the same"
            raise ValueError(
                f"expected one image for each pose and 'time', got {got}; add 'time' to each frame"
            )
        at_pose[frame.time] = frame
    times = {frame.time for frame in frames}
    if len(times) <= 1:
        return [(frame, frame) for frame in frames], ("0",)
    ids: dict[float | None, str] = {}
    cameras = []
    for at_pose in by_pose.values():
        if None in times or len(at_pose) < 2:
            got = (
                "frames without one"
                if None in times
                else f"only {next(iter(at_pose.values())).file_path[:60]}"
            )
            raise ValueError(
                f"expected a 'time' in each frame, and each camera's pose at two or more times, got {got}; add them, "
                "or write one file for each time (a single moving camera cannot be used)"
            )
        entries = list(at_pose.values())
        patterns = {}
        for key in ("file_path", "mask_path", "depth_file_path"):
            paths = {time: path for time, entry in at_pose.items() if (path := getattr(entry, key))}
            pattern, found = frame_pattern(list(paths.values())) if len(paths) > 1 else (None, ())
            patterns[key] = pattern
            if any(ids.setdefault(time, name) != name for time, name in zip(paths, found, strict=False)):
                raise ValueError(
                    f"expected equal numbers in {key} for equal 'time', got others; rename the files"
                )
            if len(set(ids.values())) < len(ids):
                raise ValueError(
                    f"expected equal 'time' for equal numbers in {key}, got others; round them alike"
                )
        cameras.append((structs.replace(entries[0], **patterns), entries[0]))
    return cameras, tuple(ids[time] for time in sorted(times))  # pyrefly: ignore[bad-specialization]


def _intrinsics(folder: Path, path: str, default: Lens, frame: Lens) -> dict[str, Any]:
    lens = {key: _first(getattr(frame, key), getattr(default, key)) for key in Lens.__struct_fields__}
    others = [part.camera_model for part in (default, frame) if part.camera_model not in (None, *MODELS)]
    fisheye = default.is_fisheye or frame.is_fisheye or any(lens[key] for key in ("k4", "k5", "k6"))
    if others or fisheye:
        got = str(others[0])[:40] if others else "k4 or a fisheye"
        raise ValueError(
            f"expected a camera_model among {', '.join(MODELS)}, got {got}; undistort the images first"
        )
    if any(lens["rolling_shutter"] or ()):
        raise ValueError(
            "expected images of one moment, got rolling_shutter; correct the images and set it to zeros"
        )
    width = lens["w"]
    height = lens["h"]
    if width is None or height is None:
        width, height = image_size_px(folder, path)
    fx = lens["fl_x"]
    if fx is None:
        if lens["camera_angle_x"] is None:
            raise ValueError("expected fl_x or camera_angle_x, got neither; add the focal length")
        fx = width / (2 * math.tan(lens["camera_angle_x"] / 2))
    fy = lens["fl_y"]
    if fy is None:
        fy = height / (2 * math.tan(lens["camera_angle_y"] / 2)) if lens["camera_angle_y"] else fx
    cx = _first(lens["cx"], width / 2)
    cy = _first(lens["cy"], height / 2)
    K = [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]
    dist = [lens[key] or 0.0 for key in ("k1", "k2", "p1", "p2", "k3")]
    return {"width": width, "height": height, "K": K, "dist": dist}


def _first(value: Any, otherwise: Any) -> Any:
    return otherwise if value is None else value
