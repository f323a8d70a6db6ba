"""Helpers of the format readers: image sizes, poses, footage found by camera names, and safe XML."""

import logging
import math
import os
import re
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar
from unicodedata import normalize
from xml.etree.ElementTree import Element, ParseError, fromstring

import cv2
import numpy as np

from viewmend.data.containers import read_bytes, stored_path
from viewmend.data.images import HEIF_REFUSED, heif_size_px, is_heif, pillow_heif, size_from_header
from viewmend.data.native_format import stays_inside
from viewmend.data.video_clock import match_tracks, video_track
from viewmend.data.videos import is_video, video_properties

Item = TypeVar("Item")
HEADER_BYTES = 2**20
"""How much of an image is read to find its size, unless it is farther back."""
PLACES = ("videos", "synchronized_videos", "videos-raw", "recordings", "images", "")
"""Folders that are searched for footage; in `recordings` also its only subfolder."""
MASK_PLACES = ("masks", "mask", "mask_cihp", "schp", "fmask", "rvm", "bgmtv2")
"""Folders that are searched for masks; the later names are those of segmentation networks and of
MVHumanNet."""
LABELS = ("mask_cihp", "schp")
"""Folders whose masks are body part labels, of which only 0 is background."""
NO_SUBJECT = re.compile("background|plate|empty|board|calib|intrinsic")
"""Videos with such names do not show the subject."""
IMAGE_SUFFIXES = (
    ".png",
    ".jpg",
    ".jpeg",
    ".jpe",
    ".jp2",
    ".bmp",
    ".dib",
    ".tif",
    ".tiff",
    ".webp",
    ".avif",
    ".heic",
    ".heif",
    ".gif",
    ".exr",
    ".hdr",
    ".pbm",
    ".pgm",
    ".ppm",
    ".pnm",
    ".ras",
    ".sr",
)
HIDDEN = ("__MACOSX", "@eaDir", "#recycle", "$RECYCLE.BIN")
"""Folders of file managers; other files and folders of theirs start with a dot."""
MAX_LISTED = 8
"""Messages list up to this many names."""
MAX_CROP_PX = 16
"""Encoders round sizes down to whole blocks; the calibration of a slightly larger image stays valid."""


def folders_containing(folder: Path, part: str) -> list[Path]:
    """A folder and its subfolders whose names contain `part`; empty if the folder does not exist."""
    if not folder.is_dir():
        return []
    return [folder, *(folder / name for name in _subfolders(folder) if part in name.lower())]


def files_like(folder: Path, pattern: str) -> list[Path]:
    """The files in a folder that match a glob pattern, sorted, without those of file managers (`._cameras.xml`)."""
    return sorted(path for path in folder.glob(pattern) if path.is_file() and not _is_hidden(path.name))


def decode_text(data: bytes, name: str) -> str:
    """The text of a file, without a byte order mark; ValueError if it is not UTF-8."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise ValueError(f"expected {name} in UTF-8, got another encoding; save it as UTF-8") from None


def warn(text: str) -> None:
    """Log a warning about a capture's files."""
    logging.getLogger("viewmend").warning(text)


def image_size_px(folder: Path, name: str) -> tuple[int, int]:
    """Width and height of an image in the folder, from its header; ValueError without one inside the folder."""
    size = None
    got = "none; add the file"
    if stays_inside(name):
        with suppress(OSError):
            path = folder / stored_path(folder, name)
            header = read_bytes(path, HEADER_BYTES)
            got = "a file that is no image or is damaged; copy or export it again"
            if is_heif(header) and pillow_heif is None:
                raise ValueError(f"{name[:200]!r}: {HEIF_REFUSED}")
            size = None if is_heif(header) else size_from_header(header)
            if size is None:  # the header of a TIFF may be at its end
                content = read_bytes(path)
                size = heif_size_px(content) if is_heif(content) else size_from_header(content)
    if size is None:
        raise ValueError(f"expected an image {name[:200]!r} in the folder to find the size, got {got}")
    return size


def names_from_paths(paths: Sequence[str]) -> list[str]:
    """A camera name for each image: the file name without suffix, or the whole path if file names are not unique."""
    stems = [PurePosixPath(path).stem for path in paths]
    if len(set(stems)) == len(stems):
        return stems
    return [str(PurePosixPath(path).with_suffix("")).replace("/", "_") if path else path for path in paths]


def names_of_patterns(patterns: Sequence[str]) -> list[str]:
    """A name for each camera: the last part of its images' paths, or else all parts in which the cameras differ."""
    shared = [path.rpartition(".")[0].replace("{frame}", "").rstrip("_-./ ") for path in patterns]
    parts = [path.split("/") for path in shared]
    last = [own[-1] for own in parts]
    if len(set(last)) == len(last) and all(last):
        return last
    if len({len(own) for own in parts}) == 1:
        differ = [at for at, found in enumerate(zip(*parts, strict=True)) if len(set(found)) > 1]
        parts = [[own[at] for at in differ] for own in parts]
    return ["_".join(own) for own in parts]


def existing(folder: Path, items: Sequence[Item], path: Callable[[Item], str]) -> list[Item]:
    """The items whose image is in the folder, with a warning about the others; all if fewer than two exist."""
    paths = [(number, path(item)) for number, item in enumerate(items) if stays_inside(path(item))]
    missing = [number for number, image in paths if not (folder / stored_path(folder, image)).is_file()]
    if not missing or len(items) - len(missing) < 2:
        return list(items)
    names = ", ".join(path(items[number]) for number in missing)
    warn(f"{folder}: cameras without their image are left out: {names[:200]}")
    return [item for number, item in enumerate(items) if number not in missing]


def warn_of_unused_images(folder: Path, used: Iterable[str]) -> None:
    """Name the images that a calibration does not mention, in `images` and next to those that it mentions.

    Paths are relative to the capture.
    """
    known = {path for path in used if stays_inside(path)}
    places = {folder / path for path in map(os.path.dirname, known)}
    found = {path for place in places if place.is_dir() for path in place.iterdir()}
    found |= set((folder / "images").rglob("*"))
    images = {path.relative_to(folder) for path in found if path.suffix.lower() in IMAGE_SUFFIXES}
    visible = {path.as_posix() for path in images if not any(_is_hidden(part) for part in path.parts)}
    unused = sorted(visible - known)
    if unused:
        warn(f"{folder}: images that the calibration does not mention are ignored: {listed(unused)}")


def warn_of_unmatched(folder: Path, cameras: Sequence[str], footage: Sequence[str]) -> None:
    """Name the cameras of a calibration that have no footage, and the footage of no camera."""
    if cameras:
        warn(f"{folder}: cameras without footage are left out: {listed(cameras)}")
    if footage:
        warn(f"{folder}: footage of no calibrated camera is not used: {listed(footage)}")


def with_folders(folder: Path, place: str, names: Iterable[str]) -> list[str]:
    """The cameras that have a folder of images in `place`; names the others, and folders of no camera."""
    calibrated = list(names)
    found = _subfolders(folder / place)
    absent = [name for name in calibrated if name not in found]
    warn_of_unmatched(folder, absent, [f"{place}/{name}" for name in found if name not in calibrated])
    return [name for name in calibrated if name in found]


def first_of(calibrations: Iterable[Path]) -> Path | None:
    """The first of these files, with a warning about the others; None if there is none."""
    first, *others = [*calibrations, None]
    unused = [path.name for path in others if path is not None]
    if unused:
        warn(f"{first}: this calibration is used, and not {listed(unused)}")
    return first


def frame_pattern(paths: Sequence[str]) -> tuple[str, tuple[str, ...]]:
    """A path with `{frame}`, and the number in which each path differs; ValueError if paths differ in several parts."""
    first = paths[0]
    if len(set(paths)) == 1:
        return first, ("0",) * len(paths)

    # The parts before and after the number are those that all paths share, without digits next to the number
    before = first[: _count_shared(paths)].rstrip("0123456789")
    num_shared = _count_shared([path[::-1] for path in paths])
    num_after = min(num_shared, min(map(len, paths)) - len(before))
    after = first[len(first) - num_after :].lstrip("0123456789")
    ids = tuple(path[len(before) : len(path) - len(after)] for path in paths)
    if not all(ids) or any("/" in name for name in ids):
        got = f"{first[:80]!r} and {paths[-1][:80]!r}"
        raise ValueError(f"expected paths that differ in a number, got {got}; rename")
    return f"{before}{{frame}}{after}", ids


def _count_shared(texts: Sequence[str]) -> int:
    """How many characters at the start are the same in all texts."""
    columns = zip(*texts, strict=False)
    return sum(1 for _ in takewhile(lambda characters: len(set(characters)) == 1, columns))


def find_mask(folder: Path, image: str) -> str | None:
    """The path of an image's mask in `masks`: `a.png`, or `a.jpg.png`, as in COLMAP; None without such a file."""
    names = (image.rpartition(".")[0], image)
    paths = [stored_path(folder, f"masks/{name}.png") for name in names]
    return next((path for path in paths if (folder / path).is_file()), None)


def to_rotation(name: str, values: object) -> list[list[float]]:
    """A rotation matrix from its nine numbers or from a Rodrigues vector; ValueError from anything else."""
    numbers = _to_array(values)
    if numbers.size not in (3, 9):
        raise ValueError(
            f"camera '{name}': expected a rotation of 3 or 9 numbers, got {numbers.size}; add it"
        )
    return np.asarray(cv2.Rodrigues(numbers)[0] if numbers.size == 3 else numbers.reshape(3, 3)).tolist()


def to_distortion(name: str, values: object) -> list[float]:
    """OpenCV's k1 k2 p1 p2 k3 from 0, 4 or 5 numbers, or more if the others are 0; ValueError from other numbers."""
    numbers = _to_array(values)
    if 0 < numbers.size < 4 or numbers[5:].any():
        got = f"{numbers.size} numbers"
        raise ValueError(f"camera '{name}': expected k1 k2 p1 p2 k3, got {got}; undistort the images first")
    return [*numbers[:5].tolist(), 0.0, 0.0, 0.0, 0.0, 0.0][:5]


def _to_array(values: object) -> np.ndarray:
    try:
        return np.asarray(values, float).ravel()
    except (TypeError, ValueError, OverflowError):
        raise ValueError("expected numbers, got something else; export the calibration again") from None


def invert_pose(world_from_camera: np.ndarray) -> dict[str, list[Any]]:
    """R and t of camera_from_world, from world_from_camera (3 x 4 or 4 x 4)."""
    R = world_from_camera[:3, :3].T
    return {"R": R.tolist(), "t": (-R @ world_from_camera[:3, 3]).tolist()}


@dataclass(frozen=True)
class Footage:
    """Images and masks of all cameras."""

    frames: tuple[str, ...]
    fps: float | None
    entries: dict[str, dict[str, Any]]
    """The keys of a `cameras.json` for a camera's size, images and masks, by its name."""

    def __contains__(self, name: str) -> bool:
        return name in self.entries

    def entry(self, name: str, calibrated_px: Sequence[int | float] | None = None) -> dict[str, Any]:
        """The keys of one camera; ValueError unless its images have the size that it was calibrated at, if known."""
        entry = self.entries[name]
        size = entry["width"], entry["height"]
        if calibrated_px and any(
            not 0 <= a - b <= MAX_CROP_PX for a, b in zip(calibrated_px, size, strict=True)
        ):
            printable = [max(-1e9, min(side, 1e9)) for side in calibrated_px]  # huge integers overflow
            expected = " x ".join(f"{side:g}" for side in printable)
            got = f"{size[0]} x {size[1]}"
            raise ValueError(
                f"camera '{name}': expected images of {expected} pixels, got {got}; export that size"
            )
        return {"name": name, **entry}


@dataclass(frozen=True)
class ImageList:
    """The images of one camera in a folder."""

    pattern: str
    """A path with `{frame}` for the frame id."""
    frames: frozenset[str]
    ignored: str = ""
    """How many images have other names, and an example; empty if none has."""


def find_footage(folder: Path, names: Sequence[str], places: Sequence[str] = PLACES) -> Footage:
    """Find videos, or folders of images, that are named after the cameras; likewise their masks, if any.

    Cameras without footage, such as those of a motion capture system that record markers only, are
    left out with a warning if two or more cameras have some.

    Raises:
        ValueError: fewer than two cameras have footage, a camera has several videos, or only some have masks.
    """
    candidates = [paths for place in places for paths in _footage_in(folder, place)]
    shown = [[path for path in paths if is_video(path) or _has_footage(folder, path)] for paths in candidates]
    for paths in (*shown, *candidates):
        if match_names(names, paths):
            return _found_footage(folder, names, paths)
    best = max(shown, key=lambda paths: len(_match_some(names, paths)), default=[])
    if len(_match_some(names, best)) < 2:
        raise ValueError(_without_footage(folder, names, places))
    return _found_footage(folder, names, best)


def _found_footage(folder: Path, names: Sequence[str], paths: Sequence[str]) -> Footage:
    """The footage of the cameras among these paths; warns of cameras and paths that have no counterpart."""
    match = _match_some(names, paths)
    if match.several:
        raise ValueError(_several_videos(match.several))
    used = set(match.paths.values())
    others = [path for path in paths if path not in used and not _without_subject(path)]
    unused = [path for path in others if "/" in path or is_video(path) or _has_footage(folder, path)]
    warn_of_unmatched(folder, [name for name in names if name not in match.paths], unused)
    return collect_footage(folder, match.paths)


def _footage_in(folder: Path, place: str) -> Iterator[list[str]]:
    """The videos of a place, then its folders, then both; in `recordings`, also those of its only subfolder."""
    only = [f"{place}/{name}" for name in _subfolders(folder / place)] if place == "recordings" else []
    for where in (place, *(only if len(only) == 1 else ())):
        yield from _videos_or_folders(folder, where)


def _videos_or_folders(folder: Path, place: str) -> tuple[list[str], list[str], list[str]]:
    """The videos of a place, its folders, and both: some cameras may have a video, and others a folder."""
    videos = _videos(folder, place)
    folders = _folders(folder, place)
    return videos, folders, videos + folders


def _without_footage(folder: Path, names: Sequence[str], places: Sequence[str]) -> str:
    """The error of a folder in which fewer than two cameras have footage."""
    inner = [place for place in PLACES if place]
    within = [
        *_subfolders(folder),
        *(f"{a}/{b}" for a in _subfolders(folder) for b in _subfolders(folder / a)),
    ]
    trials = [name for name in within if any((folder / name / place).is_dir() for place in inner)]
    if trials:
        return f"expected one recording, got a folder with {', '.join(trials)[:200]}; open one of these"
    searched = ", ".join(place or "the folder" for place in places)
    expected = f"a video or a folder of images named after each camera ({listed(names)}) in {searched}"
    for place in places:
        others = [
            f"{place}/{name}".removeprefix("/") for name in _files(folder / place) if not is_video(name)
        ]
        unknown = _match_some(
            names, [path for path in others if Path(path).suffix.lower() not in IMAGE_SUFFIXES]
        )
        if len(unknown) >= 2 and not unknown.several:
            got = listed(list(unknown.paths.values()))
            command = "ffmpeg -i FILE -c copy FILE.mp4"
            return f"expected {expected}, got files of an unknown kind ({got}); convert them to MP4 or MKV: {command}"
    return f"expected {expected}, got none; rename them"


def _several_videos(several: dict[str, list[str]]) -> str:
    """The error of cameras with several videos."""
    name, paths = next(iter(several.items()))
    more = f", and likewise for {listed(list(several)[1:])}" if len(several) > 1 else ""
    advice = "join the chapters of one recording (ffmpeg -f concat -safe 0 -i LIST.txt -c copy OUT.mp4), or keep one"
    return f"expected one video of camera '{name}', got {len(paths)} ({listed(paths)}){more}; {advice}"


def listed(names: Sequence[str]) -> str:
    """Names separated by commas; of many, the first ones and how many more there are."""
    shown = list(names[:MAX_LISTED])
    return ", ".join(shown) + (f" and {len(names) - MAX_LISTED} more" if len(names) > MAX_LISTED else "")


def _choose_videos(folder: Path, paths: dict[str, str]) -> dict[str, str]:
    """The paths, with each folder of a single video replaced by the video; ValueError for a folder of several."""
    found = {name: _videos_of_subject(folder, path) for name, path in paths.items()}
    several = {
        name: videos
        for name, videos in found.items()
        if len(videos) > max(1, _count_images(folder, paths[name]))
    }
    if several:
        raise ValueError(_several_videos(several))
    return {name: found[name][0] if len(found[name]) == 1 else path for name, path in paths.items()}


def collect_footage(folder: Path, paths: dict[str, str]) -> Footage:
    """Collect the footage of cameras whose videos or folders of images are known, by name, and find their masks.

    Cameras with one image each show one moment, whatever its name. ValueError for fewer
    than two cameras, one without footage, masks of only some, and cameras whose frame ids
    are not the others'.
    """
    if len(paths) < 2:
        raise ValueError(f"expected images or videos of two cameras or more, got {len(paths)}; add them")
    entries = {}
    ids = {}
    ignored = []
    paths = _choose_videos(folder, paths)
    videos = {name: video_properties(folder / path) for name, path in paths.items() if is_video(path)}
    for name, path in paths.items():
        video = videos.get(name)
        if video is not None:
            entries[name] = {"width": video.width, "height": video.height, "video": path}
            continue
        images = list_images(folder, path)
        if images is None:
            raise ValueError(_without_images(folder, name, path))
        first = images.pattern.replace("{frame}", min(images.frames, key=frame_order))
        width, height = image_size_px(folder, first)
        entries[name] = {"width": width, "height": height, "image": images.pattern}
        ids[name] = images.frames
        if images.ignored:
            ignored.append(f"{name}: {images.ignored}")
    if ignored:
        warn(f"images of {ignored[0]}, are ignored, as their names follow another pattern than the others'")
    masks = _find_masks(folder, tuple(paths))
    for name, (mask, _) in masks.items():
        entries[name] |= mask
    mask_ids = {name: found for name, (_, found) in masks.items() if found and name in ids}
    if not videos and all(len(found) == 1 for found in (*ids.values(), *mask_ids.values())):
        return _one_moment(entries, ids, mask_ids)
    _compare_ids(ids, mask_ids)
    if not videos:
        return Footage(tuple(sorted(frozenset().union(*ids.values()), key=frame_order)), None, entries)
    tracks = [video_track(name, "images", folder / paths[name]) for name in videos]
    for name in videos:
        mask_path = str(entries[name].get("mask", ""))
        if is_video(mask_path):
            tracks.append(video_track(name, "masks", folder / mask_path))
    clock = match_tracks(tracks)
    numbered = {*ids.values(), *(own for _, own in masks.values() if own)}
    return Footage(_frames_of_videos(clock.end, numbered), clock.fps, entries)


def _frames_of_videos(count: int, numbered: set[frozenset[str]]) -> tuple[str, ...]:
    """The frame ids of videos: those of numbered images or masks if there is one for each frame, else from 0 on."""
    if [len(ids) for ids in numbered] == [count]:
        (shared,) = numbered
        return tuple(sorted(shared, key=frame_order))
    return tuple(f"{time:06d}" for time in range(count))


def _without_images(folder: Path, name: str, path: str) -> str:
    """The error of a camera whose folder holds no footage; names a folder in it that does."""
    inner = [place for place in sorted((folder / path).rglob("*")) if place.is_dir()]
    places = [place.relative_to(folder).as_posix() for place in inner]
    within = next((place for place in places if _has_footage(folder, place)), None)
    if within is None:
        return f"expected images of camera '{name}' in {path}, got none; add them"
    return (
        f"expected images or a video of camera '{name}' in {path}, got some in {within} alone; move them up"
    )


def _count_images(folder: Path, place: str) -> int:
    """How many images a folder has; thumbnails of its videos count, too."""
    images = list_images(folder, place)
    return 0 if images is None else len(images.frames)


def list_images(folder: Path, place: str) -> ImageList | None:
    """The images in a subfolder whose names differ only in numbers, of the most frequent pattern; None without any.

    A frame's id is the number, or the part from the first to the last number, in which names differ.
    """
    names = [name for name in _files(folder / place) if Path(name).suffix.lower() in IMAGE_SUFFIXES]
    if not names:
        return None
    by_pattern: dict[tuple[bool, str], list[str]] = {}
    for name in names:
        numbered = any(map(str.isdecimal, Path(name).stem))
        pattern = re.sub(r"\d+", "0", name) if numbered else Path(name).suffix
        by_pattern.setdefault((numbered, pattern), []).append(name)
    (numbered, _), alike = max(sorted(by_pattern.items()), key=lambda item: (item[0][0], len(item[1])))
    if numbered and len(alike) > 1:
        pattern, frames = frame_pattern(alike)
    elif numbered:
        before, number, after = re.findall(r"(.*?)(\d+)(\D*)$", Path(alike[0]).stem)[0]
        pattern = f"{before}{{frame}}{after}{Path(alike[0]).suffix}"
        frames = (number,)
    else:
        pattern = f"{{frame}}{Path(alike[0]).suffix}"
        frames = tuple(Path(name).stem for name in alike)
    others = [name for name in names if name not in set(alike)]
    ignored = f"{len(others)} of {len(names)}, such as {others[0]}" if others else ""
    return ImageList(f"{place}/{pattern}".removeprefix("/"), frozenset(frames), ignored)


def _one_moment(
    entries: dict[str, dict[str, Any]], ids: dict[str, frozenset[str]], mask_ids: dict[str, frozenset[str]]
) -> Footage:
    """The footage of cameras with one image each: one frame, even if their names have other numbers."""
    frame = min(frozenset().union(*ids.values()), key=frame_order)
    for kind, found in (("image", ids), ("mask", mask_ids)):
        for name, (own,) in found.items():
            if own != frame:
                entries[name][kind] = entries[name][kind].replace("{frame}", own)
    if len(set(ids.values())) > 1:
        names = ", ".join(str(entries[name]["image"]).replace("{frame}", frame) for name in list(ids)[:3])
        warn(
            f"each camera has one image; they are taken as images of one moment, although their names differ: {names}"
        )
    return Footage((frame,), None, entries)


def _compare_ids(images: dict[str, frozenset[str]], masks: dict[str, frozenset[str]]) -> None:
    """Compare the frame ids of cameras, which have to be equal for images of one moment.

    ValueError if a camera shares fewer than half of its ids with most others, as with each camera's
    own clock, or its masks with its images.
    """
    counts = Counter(frame for found in images.values() for frame in found)
    usual = {frame for frame, count in counts.items() if 2 * count > len(images)}
    strangers = [name for name, found in images.items() if 2 * len(found & usual) < len(found)]
    for name, found in masks.items():
        if 2 * len(found & images[name]) < min(len(found), len(images[name])):
            strangers.append(f"{name} (masks)")
    ids = images | {f"{name} (masks)": found for name, found in masks.items()}
    if strangers:
        examples: dict[str, str] = {}
        for name, found in ids.items():
            own = found - usual if name in strangers else found
            examples.setdefault(min(own or found, key=frame_order), name)
        example = ", ".join(f"{frame} of {name}" for frame, name in list(examples.items())[:3])
        expected = "the same frame ids in the names of all cameras' images and masks"
        got = f"others for {', '.join(strangers)[:200]} (such as {example})"
        next_step = "rename images of one moment alike, or remove those that few cameras have"
        raise ValueError(f"expected {expected}, got {got}; {next_step}")
    numbers = {name: sorted(map(int, found)) for name, found in ids.items() if all(map(str.isdecimal, found))}
    spans = Counter((found[0], found[-1]) for found in numbers.values())
    if len(spans) > 1:
        (first, last), _ = spans.most_common(1)[0]
        moved = {
            name: found[0] for name, found in numbers.items() if found[0] - first == found[-1] - last != 0
        }
        if moved:
            warn(
                f"the numbers of images begin at {first}, but at {', '.join(map(str, sorted(set(moved.values()))))} "
                f"for {', '.join(moved)}; if all cameras started together, rename these images"
            )


def frame_order(frame: str) -> tuple[int, str]:
    """Sort key of frame ids, in which 9 precedes 10."""
    return len(frame), frame


@dataclass(frozen=True)
class NameMatch:
    """Paths that are named after cameras."""

    paths: dict[str, str]
    """The only path of each camera that has one, by its name."""
    several: dict[str, list[str]]
    """The paths of each camera that has more than one."""

    def __len__(self) -> int:
        return len(self.paths) + len(self.several)


def match_names(names: Sequence[str], paths: Iterable[str]) -> list[str] | None:
    """The path of each camera name, by the first of several comparisons that assigns exactly one to each; else None."""
    match = _match_some(names, paths)
    return [match.paths[name] for name in names] if len(match.paths) == len(names) else None


def _match_some(names: Sequence[str], paths: Iterable[str]) -> NameMatch:
    """The paths of as many cameras as possible, by the first comparison of names that finds most."""
    files = {path: normalize("NFC", Path(path).name) for path in paths}
    stems = {path: Path(name).stem if _has_file_suffix(name) else name for path, name in files.items()}
    best = NameMatch({}, {})
    comparisons: tuple[Callable[[str], Hashable], ...] = (str, _after_cam, _last_number)  # strictest first
    for key in comparisons:
        by_key: dict[Hashable, list[str]] = {}
        for path, stem in stems.items():
            by_key.setdefault(key(stem), []).append(path)
        keys = {name: key(normalize("NFC", name)) for name in names}
        counts = Counter(keys.values())
        named = {name: by_key.get(k, []) for name, k in keys.items() if k is not None and counts[k] == 1}
        match = NameMatch(
            {name: found[0] for name, found in named.items() if len(found) == 1},
            {name: found for name, found in named.items() if len(found) > 1},
        )
        if (len(match), len(match.paths)) > (len(best), len(best.paths)):
            best = match
    return best


def _has_file_suffix(name: str) -> bool:
    """Whether a name ends with the suffix of a video, or with an unknown suffix that has letters: `cam.1` has none."""
    return is_video(name) or re.search(r"\.\w*[a-zA-Z]\w{0,4}$", name) is not None


def _after_cam(text: str) -> str:
    """What follows the last "cam", "camera" or "port", without leading zeros; without one of them, the whole text."""
    found = re.findall(r"(?:cam(?:era)?|port)[-_ ]?([a-z0-9]+)", text.lower())
    return (found[-1] if found else text.lower()).lstrip("0")


def _last_number(text: str) -> int | None:
    found = re.findall(r"\d{1,9}", text)
    return int(found[-1]) if found else None


def _find_masks(folder: Path, names: Sequence[str]) -> dict[str, tuple[dict[str, Any], frozenset[str]]]:
    """Keys and frame ids of each camera's masks; empty without masks, ValueError if only some cameras have them."""
    places = [place for place in MASK_PLACES if (folder / place).is_dir()]
    if not places:
        return {}
    place = next((place for place in places if _videos(folder, place) or _folders(folder, place)), places[0])
    match = max((_match_some(names, paths) for paths in _videos_or_folders(folder, place)), key=len)
    if match.several:
        raise ValueError(f"{place}: {_several_videos(match.several)}")
    absent = [name for name in names if name not in match.paths]
    if absent:
        expected = f"masks of each camera in {place}"
        raise ValueError(f"expected {expected}, got none of {listed(absent)}; name them after the cameras")
    labels = {"mask_labels": True} if place in LABELS else {}
    found = {}
    for name, path in _choose_videos(folder, {name: match.paths[name] for name in names}).items():
        images = None if is_video(path) else list_images(folder, path)
        pattern = images.pattern if images else path if is_video(path) else f"{path}/{{frame}}.png"
        found[name] = {"mask": pattern} | labels, images.frames if images else frozenset()
    return found


def _videos_of_subject(folder: Path, path: str) -> list[str]:
    """The videos in a camera's folder that show the subject."""
    return [video for video in _videos(folder, path) if not _without_subject(video)]


def _has_footage(folder: Path, path: str) -> bool:
    """Whether a folder holds images or videos."""
    return bool(_videos(folder, path)) or list_images(folder, path) is not None


def _without_subject(path: str) -> bool:
    """Whether the name of some footage is that of a background or of a calibration board."""
    return NO_SUBJECT.search(Path(path).name.lower()) is not None


def _videos(folder: Path, place: str) -> list[str]:
    return [f"{place}/{name}".removeprefix("/") for name in _files(folder / place) if is_video(name)]


def _folders(folder: Path, place: str) -> list[str]:
    return [f"{place}/{name}".removeprefix("/") for name in _subfolders(folder / place)]


def _files(folder: Path) -> list[str]:
    return [path.name for path in files_like(folder, "*")] if folder.is_dir() else []


def _subfolders(folder: Path) -> list[str]:
    within = folder.iterdir() if folder.is_dir() else ()
    return sorted(path.name for path in within if path.is_dir() and not _is_hidden(path.name))


def _is_hidden(name: str) -> bool:
    return name.startswith(".") or name in HIDDEN


def read_xml(data: bytes) -> Element:
    """Parse an XML document. ValueError for one with a document type, whose entities can expand without limit."""
    if b"<!DOCTYPE" in data or b"<!ENTITY" in data or b"\0" in data:
        raise ValueError("expected XML without a document type, got one; export it again")
    try:
        return fromstring(data)
    except (ParseError, ValueError, LookupError) as error:
        raise ValueError(f"expected XML, got something else: {str(error)[:80]}; export it again") from None


def xml_number(what: str, text: str | None) -> float:
    """Parse a finite number. ValueError for other text, with a message that begins with `what`."""
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(
            f"{what}: expected a number, got {'nothing' if not text else repr(text[:40])}; add it"
        )
    return value


def xml_attributes(camera: str, element: Element | None, keys: str) -> list[float]:
    """Numbers that an element of a camera has as attributes; ValueError if one is missing or invalid."""
    attributes = {} if element is None else element.attrib
    return [xml_number(f"camera '{camera}': {key}", attributes.get(key)) for key in keys.split()]
