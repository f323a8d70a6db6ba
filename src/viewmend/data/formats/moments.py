"""Images of a fixed rig at several times, in formats that list each image with a pose of its own."""

import re
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any

import numpy as np
from jaxtyping import Float64

from viewmend.data.formats.files import frame_order, frame_pattern, listed, names_of_patterns, warn

POSE_DIGITS = 6
"""Poses that are equal to this many decimals are those of one camera."""
MAX_SHIFT = 0.01
"""Largest distance of a fixed camera's positions from their mean, relative to the extent of the rig."""
MAX_TURN_DEG = 1.0
"""Largest rotation between a fixed camera's poses, degrees."""


@dataclass(frozen=True)
class PosedImage:
    """One image of a reconstruction."""

    path: str
    """Relative to the capture."""
    mask: str | None
    lens: dict[str, Any]
    """The keys of a `cameras.json` for the lens."""
    R: Float64[np.ndarray, "3 3"]
    """Rotation of camera_from_world."""
    center: Float64[np.ndarray, "3"]
    """The camera's position in the world."""


def fixed_cameras(images: Sequence[PosedImage]) -> tuple[list[dict[str, Any]], tuple[str, ...]] | None:
    """The cameras of a fixed rig and the frame ids, if the images show several moments; None if they show one.

    A camera's images have the same pose, or nearly the same one and names that belong together:
    those in one folder, those that differ only in their last number, or those of one name in
    several folders.

    Raises:
        ValueError: two images have the same pose, but their names do not tell which images belong
            to one moment.
    """
    groups = _by_pose(images) or _by_name(images)
    if groups is None:
        return None
    patterns = [_pattern([images[index].path for index in group]) for group in groups]
    ids = sorted({frame for _, found in patterns for frame in found}, key=frame_order)
    groups = _without_strangers(images, groups, ids)
    patterns = [_pattern([images[index].path for index in group]) for group in groups]
    _check_moments(patterns, ids)
    paths = [_completed(pattern, ids) for pattern, _ in patterns]
    cameras = []
    for name, group, path in zip(names_of_patterns(paths), groups, paths, strict=True):
        masks = [mask for index in group if (mask := images[index].mask) is not None]
        mask = _completed(_pattern(masks)[0], ids) if len(masks) == len(group) else None
        pose = _mean_pose([images[index] for index in group])
        cameras.append({"name": name, **images[group[0]].lens, **pose, "image": path, "mask": mask})
    return cameras, tuple(ids)


def _without_strangers(
    images: Sequence[PosedImage], groups: list[list[int]], ids: Sequence[str]
) -> list[list[int]]:
    """The groups, except single images whose names contain none of the frame ids. A warning names these.

    Such photos only help a reconstruction. All groups are kept if fewer than two would be.
    """
    strangers = [
        group for group in groups if len(group) == 1 and _complete(images[group[0]].path, ids) is None
    ]
    if not strangers or len(groups) - len(strangers) < 2:
        return groups
    names = [images[group[0]].path for group in strangers]
    warn(f"images of none of the rig's moments are left out: {listed(names)}")
    return [group for group in groups if group not in strangers]


def _check_moments(patterns: Sequence[tuple[str, tuple[str, ...]]], ids: Sequence[str]) -> None:
    """ValueError unless most cameras share most of the frame ids."""
    counts = [sum(frame in found for _, found in patterns) for frame in ids]
    shared = [count for count in counts if 2 * count > len(patterns)]
    if 2 * len(shared) < len(counts):
        examples = []
        for pattern, found in patterns[:2]:
            frame = found[0] if found else ""
            examples.append(pattern.replace("{frame}", frame))
        expected = "the same number in the names of all cameras' images of one moment"
        got = f"others (such as {' and '.join(examples)})"
        raise ValueError(f"expected {expected}, got {got}; rename the images")


def _by_pose(images: Sequence[PosedImage]) -> list[list[int]] | None:
    """The images of each pose, if any pose has several."""
    extent = _extent(images)
    groups = _grouped(
        images,
        lambda image: (
            (np.round(image.R, POSE_DIGITS) + 0.0).tobytes(),
            (np.round(image.center / extent, POSE_DIGITS) + 0.0).tobytes(),
        ),
    )
    return groups if len(groups) > 1 and any(len(group) > 1 for group in groups) else None


def _by_name(images: Sequence[PosedImage]) -> list[list[int]] | None:
    """The images that belong together by their names, if their poses nearly agree."""
    keys: tuple[Callable[[PosedImage], Hashable], ...] = (
        lambda image: PurePosixPath(image.path).parent,
        lambda image: re.sub(r"\d+(?=\D*$)", "", image.path),
        lambda image: PurePosixPath(image.path).name,
    )
    extent = _extent(images)
    for key in keys:
        groups = _grouped(images, key)
        several = [group for group in groups if len(group) > 1]
        is_repeated = len(groups) > 1 and 2 * len(several) > len(groups)
        if is_repeated and all(_is_fixed([images[index] for index in group], extent) for group in several):
            return groups
    return None


def _grouped(images: Sequence[PosedImage], key: Callable[[PosedImage], Hashable]) -> list[list[int]]:
    groups: dict[Hashable, list[int]] = {}
    for index, image in enumerate(images):
        groups.setdefault(key(image), []).append(index)
    return list(groups.values())


def _extent(images: Sequence[PosedImage]) -> float:
    """The longest side of the box around all positions; 1 if they are all the same."""
    centers = np.array([image.center for image in images])
    return float((centers.max(0) - centers.min(0)).max()) or 1.0


def _is_fixed(images: Sequence[PosedImage], extent: float) -> bool:
    """Whether the poses of one camera's images nearly agree."""
    centers = np.array([image.center for image in images])
    shift = np.linalg.norm(centers - centers.mean(0), axis=1).max() / extent
    cosines = [(np.trace(images[0].R.T @ image.R) - 1) / 2 for image in images]
    return bool(shift <= MAX_SHIFT and min(cosines) >= np.cos(np.deg2rad(MAX_TURN_DEG)))


def _mean_pose(images: Sequence[PosedImage]) -> dict[str, Any]:
    """R and t of the mean of a camera's poses."""
    u, _, vt = np.linalg.svd(np.mean([image.R for image in images], axis=0))
    R = images[0].R if len(images) == 1 else u @ vt
    center = np.mean([image.center for image in images], axis=0)
    return {"R": R.tolist(), "t": (-R @ center).tolist()}


def _pattern(paths: Sequence[str]) -> tuple[str, tuple[str, ...]]:
    """The pattern and the frame ids of one camera's paths; of a single path, the path itself and no ids."""
    if len(paths) == 1:
        return paths[0], ()
    if len(set(paths)) < len(paths):
        raise ValueError(f"expected different images, got {paths[0]} more than once; export it again")
    return frame_pattern(paths)


def _completed(pattern: str, ids: Sequence[str]) -> str:
    """The pattern of a single path, by the frame id that it contains; ValueError if it contains none."""
    completed = _complete(pattern, ids)
    if completed is None:
        raise ValueError(
            f"expected a frame id such as {ids[0]} in {pattern}, got another name; rename the image"
        )
    return completed


def _complete(pattern: str, ids: Sequence[str]) -> str | None:
    """The pattern of a single path, by the frame id that it contains; None if it contains none."""
    if "{frame}" in pattern:
        return pattern
    for frame in sorted(ids, key=len, reverse=True):
        before, found, after = pattern.rpartition(frame)
        if found:
            return f"{before}{{frame}}{after}"
    return None
