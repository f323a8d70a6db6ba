"""Images of a fixed rig at several times, in formats that list each image with a pose of its own."""

import re
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from jaxtyping import Float64

from viewmend.data.formats.files import find_mask, frame_order, frame_pattern, listed, names_of_patterns, warn

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
            to one moment; or masks have other numbers than their images.
    """
    groups = _by_pose(images) or _by_name(images)
    if groups is None:
        return None
    patterns = [_pattern([images[index].path for index in group]) for group in groups]
    ids = sorted({frame for _, found in patterns for frame in found}, key=frame_order)
    groups = _without_strangers(images, groups, ids)
    patterns = [_pattern([images[index].path for index in group]) for group in groups]
    _check_moments(patterns, ids)
    shapes = {_shape(pattern) for pattern, found in patterns if found}
    patterns = [
        (pattern, found) if found else _completed(pattern, ids, shapes) for pattern, found in patterns
    ]
    names = names_of_patterns([pattern for pattern, _ in patterns])
    cameras = []
    for name, group, (pattern, found) in zip(names, groups, patterns, strict=True):
        own = [images[index] for index in group]
        mask = _mask_pattern(
            [(image.mask, frame) for image, frame in zip(own, found, strict=True) if image.mask]
        )
        cameras.append({"name": name, **own[0].lens, **_mean_pose(own), "image": pattern, "mask": mask})
    return cameras, tuple(ids)


def _without_strangers(
    images: Sequence[PosedImage], groups: list[list[int]], ids: Sequence[str]
) -> list[list[int]]:
    """The groups, except single images whose names contain none of the frame ids. A warning names these.

    Such photos only help a reconstruction. All groups are kept if fewer than two would be.
    """
    strangers = [
        group
        for group in groups
        if len(group) == 1 and not any(_with_frame(images[group[0]].path, frame) for frame in ids)
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


def _completed(path: str, ids: Sequence[str], shapes: set[str]) -> tuple[str, tuple[str]]:
    """The pattern of a single path and the frame id that it contains; ValueError if it contains none.

    An id may also be in the camera's part of the path. Of several places, the one that gives a pattern of
    one of these shapes counts, or else the last one.
    """
    found = [(pattern, frame) for frame in ids for pattern in _with_frame(path, frame)]
    if not found:
        raise ValueError(
            f"expected a frame id such as {ids[0]} in {path}, got another name; rename the image"
        )
    pattern, frame = max(found, key=lambda one: (_shape(one[0]) in shapes, one[0].index("{frame}")))
    return pattern, (frame,)


def _mask_pattern(masks: Sequence[tuple[str, str]]) -> str | None:
    """The pattern of a camera's masks, given with their images' frame ids; None without masks.

    ValueError if they do not have these ids at the same place of their names.
    """
    found = [_with_frame(path, frame) for path, frame in masks]
    shared = [pattern for pattern in found[0] if all(pattern in own for own in found)] if found else []
    if masks and not shared:
        path, frame = masks[0]
        raise ValueError(
            f"expected the numbers of images in the names of their masks, got {path} for frame {frame}; rename "
            "the masks as the images"
        )
    return shared[-1] if shared else None


def _with_frame(path: str, frame: str) -> list[str]:
    """The patterns that give this path for a frame id, one for each place where it has the id."""
    places = re.finditer(rf"(?<!\d){re.escape(frame)}(?!\d)", path)
    return [f"{path[: place.start()]}{{frame}}{path[place.end() :]}" for place in places]


def _shape(pattern: str) -> str:
    """A pattern without the numbers of its camera."""
    return re.sub(r"\d+", "0", pattern)


def with_masks(folder: Path, images: Sequence[PosedImage]) -> list[PosedImage]:
    """The images with their masks in the folder `masks`, as `find_mask` finds them.

    If no image has one, all get the path that was expected, which the message about missing files names.
    """
    names = [image.path.removeprefix("images/") for image in images]
    masks = [find_mask(folder, name) for name in names]
    if not any(masks) and (folder / "masks").is_dir():
        masks = [f"masks/{name}.png" for name in names]
    return [replace(image, mask=mask) for image, mask in zip(images, masks, strict=True)]
