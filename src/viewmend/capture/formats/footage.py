"""Where each camera's images are, for formats that do not say so: videos and folders that are named after cameras."""

import re
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from viewmend.capture.formats.files import image_size_px
from viewmend.capture.videos import is_video, video_facts

PLACES = ("videos", "videos-raw", "recordings", "images", "")
"""Where footage is looked for, beside folders of one recording within `recordings`."""
MASK_PLACES = ("masks", "mask", "mask_cihp", "schp", "fmask", "rvm", "bgmtv2")
"""Where masks are looked for; the later names are those of segmenting networks, and MVHumanNet's."""
LABELS = ("mask_cihp", "schp")
"""Places whose masks label parts of people: 0 alone is background."""
NO_TAKES = re.compile("background|plate|empty|board|calib|intrinsic")
"""Videos that are so named show no subject."""
CROPPED_PX = 16
"""Encoders round sizes down to whole blocks; a calibration of a slightly larger image stays right."""
LONG_PX = 1e9
"""Sides are said to be no longer: a number of hundreds of digits is no float."""


@dataclass(frozen=True)
class Footage:
    """What the cameras of a capture have recorded."""

    frames: tuple[str, ...]
    fps: float | None
    entries: dict[str, dict[str, Any]]
    """The keys of a `cameras.json` that say a camera's size, images and masks, by its name."""

    def of(self, name: str, told_px: Sequence[int | float] | None = None) -> dict[str, Any]:
        """The keys of a camera, which was calibrated at this width and height where the calibration says so.

        Raises:
            ValueError: its images are of another size.
        """
        entry = self.entries[name]
        size = entry["width"], entry["height"]
        if told_px and any(not 0 <= told - got <= CROPPED_PX for told, got in zip(told_px, size, strict=True)):
            told = " x ".join(f"{max(-LONG_PX, min(side, LONG_PX)):g}" for side in told_px)
            got = f"{size[0]} x {size[1]}"
            raise ValueError(f"camera '{name}': expected images of {told} pixels, got {got}; export them in that size")
        return {"name": name, **entry}


@dataclass(frozen=True)
class Listing:
    """The images of one camera in a folder."""

    pattern: str
    """A path with `{frame}` for the frame's id."""
    frames: frozenset[str]

    def first(self) -> str:
        """The path of the first image."""
        return self.pattern.replace("{frame}", min(self.frames, key=in_time))


def find_footage(folder: Path, names: Sequence[str], places: Sequence[str] = PLACES) -> Footage:
    """Videos, or folders of images, that are named after these cameras; masks likewise, where there are any.

    Raises:
        ValueError: no place has footage of every camera, or there are masks of some only.
    """
    for place in _with_recordings(folder, places):
        for found in (_videos(folder, place), _folders(folder, place)):
            if chosen := paired(names, found):
                return footage_of(folder, dict(zip(names, chosen, strict=True)))
    looked = ", ".join(place or "the folder" for place in places)
    raise ValueError(
        f"expected a video or a folder of images named after each camera ({', '.join(names)[:80]}) in {looked}, "
        "got none; rename them"
    )


def footage_of(folder: Path, chosen: dict[str, str]) -> Footage:
    """The footage of cameras whose video or folder of images is known, by their names; masks are looked for.

    Raises:
        ValueError: there are fewer than two, a camera has none, or there are masks of some only.
    """
    if len(chosen) < 2:
        raise ValueError(f"expected images or videos of two cameras or more, got {len(chosen)}; add them")
    entries, frames, rates = {}, set(), []
    chosen = {name: _only_video(folder, path) or path for name, path in chosen.items()}
    videos = {name: video_facts(folder / path) for name, path in chosen.items() if is_video(path)}
    for name, path in chosen.items():
        if name in videos:
            facts = videos[name]
            entries[name] = {"width": facts.width, "height": facts.height, "video": path}
            rates.append(facts.fps)
            continue
        images = listing(folder, path)
        if images is None:
            raise ValueError(f"expected images of camera '{name}' in {path}, got none; add them")
        width, height = image_size_px(folder, images.first())
        entries[name] = {"width": width, "height": height, "image": images.pattern}
        frames |= images.frames
    if videos:
        frames = {f"{time:06d}" for time in range(min(facts.frames for facts in videos.values()))}
    for name, mask in masks_of(folder, tuple(chosen)).items():
        entries[name] |= mask
    return Footage(tuple(sorted(frames, key=in_time)), rates[0] if rates else None, entries)


def listing(folder: Path, place: str) -> Listing | None:
    """The images in a folder within `folder`, by the name that most of them share around a number; None without any."""
    named = [re.fullmatch(r"(.*?)(\d+)([^\d]*)(\.\w+)|([^.].*)()()(\.\w+)", name) for name in _names(folder / place)]
    parts = [m.groups()[:4] if m[2] else ("", m[5], "", m[8]) for m in named if m and not is_video(m[0])]
    if not parts:
        return None
    (before, after, suffix), _ = Counter(sorted((p[0], p[2], p[3]) for p in parts)).most_common(1)[0]
    frames = frozenset(p[1] for p in parts if (p[0], p[2], p[3]) == (before, after, suffix))
    return Listing(f"{place}/{before}{{frame}}{after}{suffix}".removeprefix("/"), frames)


def in_time(frame: str) -> tuple[int, str]:
    """What to sort frame ids by: 9 comes before 10."""
    return len(frame), frame


def paired(names: Sequence[str], found: Iterable[str]) -> list[str] | None:
    """The path of each name, None unless every name has exactly one; by the first of some ways to compare."""
    paths = {path: Path(path).stem if is_video(path) else Path(path).name for path in found}
    for key in _KEYS:
        by_key: dict[Hashable, list[str]] = {}
        for path, stem in paths.items():
            by_key.setdefault(key(stem), []).append(path)
        keys = [key(name) for name in names]
        if None not in keys and len(set(keys)) == len(keys) and all(len(by_key.get(k, ())) == 1 for k in keys):
            return [by_key[k][0] for k in keys]
    return None


def _after_cam(text: str) -> str:
    """What follows the last "cam", "camera" or "port", without leading zeros; the whole text without one of them."""
    found = re.findall(r"(?:cam(?:era)?|port)[-_ ]?([a-z0-9]+)", text.lower())
    return (found[-1] if found else text.lower()).lstrip("0")


def _last_number(text: str) -> int | None:
    found = re.findall(r"\d{1,9}", text)
    return int(found[-1]) if found else None


_KEYS: tuple[Callable[[str], Hashable], ...] = (str, _after_cam, _last_number)
"""Ways to compare names, the strictest first."""


def _with_recordings(folder: Path, places: Sequence[str]) -> list[str]:
    within = {place: _subfolders(folder / place) if place == "recordings" else () for place in places}
    return [p for place in places for p in (place, *(f"{place}/{n}" for n in within[place] if len(within[place]) == 1))]


def masks_of(folder: Path, names: Sequence[str]) -> dict[str, dict[str, Any]]:
    """The keys of a `cameras.json` that say where each camera's masks are; nothing where there are none.

    Raises:
        ValueError: there are masks, but not of each camera.
    """
    place = next((place for place in MASK_PLACES if (folder / place).is_dir()), None)
    if place is None:
        return {}
    chosen = paired(names, _videos(folder, place)) or paired(names, _folders(folder, place))
    if chosen is None:
        raise ValueError(f"expected masks of each camera in {place}, got others; rename them after the cameras")
    listed = {name: path if is_video(path) else listing(folder, path) for name, path in zip(names, chosen, strict=True)}
    patterns = {
        name: found if isinstance(found, str) else found.pattern if found else f"{path}/{{frame}}.png"
        for (name, found), path in zip(listed.items(), chosen, strict=True)
    }
    return {
        name: {"mask": mask} | ({"mask_labels": True} if place in LABELS else {}) for name, mask in patterns.items()
    }


def _only_video(folder: Path, path: str) -> str | None:
    """The video in a camera's folder, if there is one besides those of an empty room or a board."""
    found = [video for video in _videos(folder, path) if not NO_TAKES.search(Path(video).name.lower())]
    return found[0] if len(found) == 1 else None


def _videos(folder: Path, place: str) -> list[str]:
    return [f"{place}/{name}".removeprefix("/") for name in _names(folder / place) if is_video(name)]


def _folders(folder: Path, place: str) -> list[str]:
    return [f"{place}/{name}".removeprefix("/") for name in _subfolders(folder / place)]


def _names(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir() if p.is_file()) if folder.is_dir() else []


def _subfolders(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir() if p.is_dir() and p.name[0] != ".") if folder.is_dir() else []
