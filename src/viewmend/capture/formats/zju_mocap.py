"""ZJU-MoCap, as NeuralBody has it: `annots.npy` with cameras and every image's path."""

from pathlib import Path, PurePosixPath
from typing import Any

from viewmend.capture.formats.files import five_coefficients, image_size_px
from viewmend.capture.formats.footage import LABELS, MASK_PLACES
from viewmend.capture.formats.numpy_objects import numbers, read_objects, unwrapped

MILLIMETRES = 0.001
MOST_FRAMES = 100_000


def find(folder: Path) -> Path | None:
    """The file by which the folder is recognised."""
    return folder / "annots.npy" if (folder / "annots.npy").is_file() else None


def content(folder: Path, file: Path) -> dict[str, Any]:
    """What a `cameras.json` of these cameras would hold; each is named after its images' folder.

    Raises:
        ValueError: the annotations hold something else, or the cameras' images cannot be told by a frame's id.
    """
    told = read_objects(file)
    cams, ims = (told.get(key) for key in ("cams", "ims")) if isinstance(told, dict) else (None, None)
    keys = [_listed(cams.get(key)) for key in ("K", "D", "R", "T")] if isinstance(cams, dict) else []
    if not keys or not isinstance(ims, list) or len({len(values) for values in keys}) != 1:
        raise ValueError("expected lists K, D, R and T of 'cams', and 'ims', got others; is it ZJU-MoCap's file?")
    paths = [_paths(frame, len(keys[0])) for frame in ims[:MOST_FRAMES]]
    patterns = [_pattern([frame[camera] for frame in paths]) for camera in range(len(keys[0]))]
    if not patterns or len({ids for _, ids in patterns}) != 1:
        raise ValueError("expected images of all cameras by the same frame ids, got others; rename them alike")
    place = next((place for place in MASK_PLACES if (folder / place).is_dir()), None)
    entries = []
    for (pattern, ids), K, D, R, T in zip(patterns, *keys, strict=True):
        name = str(PurePosixPath(pattern).parent).removeprefix("images/").replace("/", "_")
        images = [pattern.replace("{frame}", frame) for frame in ids]
        there = next((path for path in images if "\0" not in path and (folder / path).is_file()), images[0])
        width, height = image_size_px(folder, there)
        entry = {"name": name, "width": width, "height": height, "K": numbers(K, 3, 3).tolist()}
        entry |= {"R": numbers(R, 3, 3).tolist(), "t": numbers(T, 3).tolist()}
        entry |= {"dist": five_coefficients(name, numbers(D, 5)), "image": pattern}
        if place:
            entry |= {"mask": f"{place}/{pattern.rpartition('.')[0]}.png", "mask_labels": place in (*LABELS, "mask")}
        entries.append(entry)
    return {"metres_per_unit": MILLIMETRES, "frames": patterns[0][1], "cameras": entries}


def _listed(value: Any) -> list[Any]:
    """A list of each camera's matrix, which may be one array of all."""
    stored = getattr(value, "value", value)
    return list(stored) if hasattr(stored, "__len__") and not isinstance(stored, dict | str) else []


def _paths(frame: Any, cameras: int) -> list[str]:
    found = _listed(unwrapped(frame.get("ims")) if isinstance(frame, dict) else None)
    if len(found) < cameras or not all(isinstance(path, str) and path for path in found[:cameras]):
        raise ValueError(f"expected paths of {cameras} images in each of 'ims', got others; is it ZJU-MoCap's file?")
    return found[:cameras]


def _pattern(paths: list[str]) -> tuple[str, tuple[str, ...]]:
    """A path with `{frame}`, and the ids: what differs between the names of one camera's images."""
    pure = [PurePosixPath(path) for path in paths]
    if len({path.parent for path in pure}) != 1 or len({path.suffix for path in pure}) != 1:
        raise ValueError("expected each camera's images in a folder of its own, got others; move them")
    if len(pure) == 1:
        return str(pure[0]), ("0",)
    stems = [path.stem for path in pure]
    same = 0
    for signs in zip(*stems, strict=False):
        if len(set(signs)) > 1:
            break
        same += 1
    start = stems[0][:same].rstrip("0123456789")
    pattern = str(pure[0].parent / f"{start}{{frame}}{pure[0].suffix}")
    return pattern, tuple(stem[len(start) :] for stem in stems)
