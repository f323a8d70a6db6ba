"""ZJU-MoCap, as distributed by NeuralBody: `annots.npy` with the cameras and the path of each image."""

from pathlib import Path, PurePosixPath
from typing import Any

from viewmend.data.formats.files import LABELS, MASK_PLACES, image_size_px, to_distortion
from viewmend.utils.safe_pickle import numbers, read_objects, unwrap

MILLIMETRES = 0.001
MAX_FRAMES = 100_000


def find(folder: Path) -> Path | None:
    """The annotations."""
    return folder / "annots.npy" if (folder / "annots.npy").is_file() else None


def content(folder: Path, file: Path) -> dict[str, Any]:
    """All cameras, named after the folders of their images."""
    annotations = read_objects(file)
    cams, ims = (
        (annotations.get(key) for key in ("cams", "ims")) if isinstance(annotations, dict) else (None, None)
    )
    lists = [_to_list(cams.get(key)) for key in ("K", "D", "R", "T")] if isinstance(cams, dict) else []
    if not lists or not isinstance(ims, list) or len({len(values) for values in lists}) != 1:
        raise ValueError(
            "expected lists K, D, R and T in 'cams', and 'ims', got others; is it a file of ZJU-MoCap?"
        )
    paths = [_paths(frame, len(lists[0])) for frame in ims[:MAX_FRAMES]]
    patterns = [_pattern([frame[camera] for frame in paths]) for camera in range(len(lists[0]))]
    if not patterns or len({ids for _, ids in patterns}) != 1:
        raise ValueError("expected the same frame ids for all cameras, got others; rename the images alike")
    place = next((place for place in MASK_PLACES if (folder / place).is_dir()), None)
    entries = []
    for (pattern, ids), K, D, R, T in zip(patterns, *lists, strict=True):
        name = str(PurePosixPath(pattern).parent).removeprefix("images/").replace("/", "_")
        images = [pattern.replace("{frame}", frame) for frame in ids]
        example = next((path for path in images if (folder / path).is_file()), images[0])
        width, height = image_size_px(folder, example)
        entry = {
            "name": name,
            "width": width,
            "height": height,
            "image": pattern,
            "K": numbers(K, 3, 3).tolist(),
        }
        entry |= {"R": numbers(R, 3, 3).tolist(), "t": numbers(T, 3).tolist()}
        entry |= {"dist": to_distortion(name, numbers(D, 5))}
        if place:
            entry |= {
                "mask": f"{place}/{pattern.rpartition('.')[0]}.png",
                "mask_labels": place in (*LABELS, "mask"),
            }
        entries.append(entry)
    return {"metres_per_unit": MILLIMETRES, "frames": patterns[0][1], "cameras": entries}


def _to_list(value: Any) -> list[Any]:
    """A list of each camera's values, which may be stored as one array."""
    stored = getattr(value, "value", value)
    return list(stored) if hasattr(stored, "__len__") and not isinstance(stored, dict | str) else []


def _paths(frame: Any, cameras: int) -> list[str]:
    found = _to_list(unwrap(frame.get("ims")) if isinstance(frame, dict) else None)
    if len(found) < cameras or not all(isinstance(path, str) and path for path in found[:cameras]):
        raise ValueError(
            f"expected paths of {cameras} images in each of 'ims', got others; is it ZJU-MoCap's file?"
        )
    return [path.replace("\\", "/") for path in found[:cameras]]


def _pattern(paths: list[str]) -> tuple[str, tuple[str, ...]]:
    """A path with `{frame}`, and the frame ids: the part in which the names of a camera's images differ."""
    pure = [PurePosixPath(path) for path in paths]
    if len({path.parent for path in pure}) != 1 or len({path.suffix for path in pure}) != 1:
        raise ValueError("expected one folder per camera for the images, got others; move them")
    if len(pure) == 1:
        return str(pure[0]), ("0",)
    stems = [path.stem for path in pure]
    columns = enumerate(zip(*stems, strict=False))
    same = next((n for n, characters in columns if len(set(characters)) > 1), min(map(len, stems)))
    prefix = stems[0][:same].rstrip("0123456789")
    ids = tuple(stem[len(prefix) :] for stem in stems)
    return str(pure[0].parent / f"{prefix}{{frame}}{pure[0].suffix}"), ids
