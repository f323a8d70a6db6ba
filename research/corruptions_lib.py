"""Random corruptions of a good capture, one per seed; used by `corruptions.py`."""

import json
import math
import shutil
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np


def middle(frames: int) -> int:
    """Index of the evaluated frame, which films of half the rate have too."""
    return frames // 2 // 2 * 2


FLIP = np.diag([1.0, -1.0, -1.0])


class Corruption:
    """A copy of a capture that is being corrupted."""

    def __init__(self, folder: Path, rng: np.random.Generator):
        self.folder, self.rng = folder, rng
        self.description: dict[str, Any] = json.loads((folder / "cameras.json").read_text())
        self.cameras: list[dict[str, Any]] = self.description["cameras"]
        self.one = self.cameras[int(rng.integers(len(self.cameras)))]
        """The camera to corrupt."""
        self.two = self.cameras[
            (self.cameras.index(self.one) + int(rng.integers(1, len(self.cameras)))) % len(self.cameras)
        ]

    def save(self) -> None:
        (self.folder / "cameras.json").write_text(json.dumps(self.description))

    def files(self, stream: str, camera: dict[str, Any] | None = None) -> list[Path]:
        """The camera's files of a stream, frame by frame."""
        pattern = (camera or self.one)[stream]
        return [self.folder / pattern.replace("{frame}", frame) for frame in self.description["frames"]]

    def change(self, stream: str, change: Callable[[np.ndarray], np.ndarray], every: bool = False) -> None:
        for camera in self.cameras if every else [self.one]:
            for file in self.files(stream, camera):
                assert cv2.imwrite(str(file), change(cv2.imread(str(file), cv2.IMREAD_UNCHANGED)))

    def pose(
        self, change: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]], every: bool
    ) -> None:
        for camera in self.cameras if every else [self.one]:
            R, t = change(np.array(camera["R"]), np.array(camera["t"]))
            camera["R"], camera["t"] = R.tolist(), t.tolist()

    def intrinsics(self, change: Callable[[np.ndarray], None], every: bool = False) -> None:
        for camera in self.cameras if every else [self.one]:
            K = np.array(camera["K"])
            change(K)
            camera["K"] = K.tolist()


POSES = {
    "camera-to-world": lambda R, t: (R.T, -R.T @ t),
    "OpenGL axes": lambda R, t: (FLIP @ R, FLIP @ t),
    "camera-to-world of OpenGL axes": lambda R, t: (R.T @ FLIP, -R.T @ t),
    "R transposed": lambda R, t: (R.T, t),
    "t is the centre": lambda R, t: (R, -R.T @ t),
}


def poses(s: Corruption) -> str:
    name = str(s.rng.choice(list(POSES)))
    every = bool(s.rng.random() < 0.6)
    s.pose(POSES[name], every)
    return f"{name}, {'all cameras' if every else 'one camera'}"


def unit(s: Corruption) -> str:
    factor = float(s.rng.choice([0.001, 0.01, 0.1, 10, 100, 1000]))
    which = str(s.rng.choice(["metres_per_unit", "t of all", "t of one"]))
    if which == "metres_per_unit":
        s.description["metres_per_unit"] = s.description.get("metres_per_unit", 1.0) * factor
    else:
        s.pose(lambda R, t: (R, factor * t), which == "t of all")
    return f"{which} times {factor:g}"


def turned(s: Corruption) -> str:
    angle = math.radians(float(np.exp(s.rng.uniform(math.log(0.2), math.log(30)))))
    axis = s.rng.normal(size=3)
    turn = cv2.Rodrigues(angle * axis / np.linalg.norm(axis))[0]
    s.pose(lambda R, t: (turn @ R, turn @ t), False)
    return f"one camera turned by {math.degrees(angle):.2f} degrees"


def displaced(s: Corruption) -> str:
    centre = -np.array(s.one["R"]).T @ np.array(s.one["t"])
    far = float(np.linalg.norm(centre - _middle(s))) * float(
        np.exp(s.rng.uniform(math.log(0.003), math.log(0.3)))
    )
    step = s.rng.normal(size=3)
    s.pose(lambda R, t: (R, t + far * step / np.linalg.norm(step)), False)
    return f"one camera displaced by {far:.3g} units"


def _middle(s: Corruption) -> np.ndarray:
    return np.mean([-np.array(c["R"]).T @ np.array(c["t"]) for c in s.cameras], 0)


def focal(s: Corruption) -> str:
    every = bool(s.rng.random() < 0.4)
    factor = float(s.rng.choice([0.5, 2.0, s.rng.uniform(0.8, 1.25)]))

    def change(K: np.ndarray) -> None:
        K[:2] *= factor

    s.intrinsics(change, every)
    return f"K times {factor:.2f}, {'all cameras' if every else 'one camera'}"


def centre(s: Corruption) -> str:
    every = bool(s.rng.random() < 0.5)
    shift = s.rng.uniform(0.5, 3 if every else 40, 2) * s.rng.choice([-1, 1], 2)

    def change(K: np.ndarray) -> None:
        K[:2, 2] += shift

    s.intrinsics(change, every)
    return (
        f"principal point off by ({shift[0]:.1f}, {shift[1]:.1f}), {'all cameras' if every else 'one camera'}"
    )


def pixel_centre(s: Corruption) -> str:
    s.description["first_pixel_center"] = [0.5 - x for x in s.description.get("first_pixel_center", [0, 0])]
    return "the other convention of pixel centres"


def distortion(s: Corruption) -> str:
    k1 = float(s.rng.uniform(0.05, 0.4) * s.rng.choice([-1, 1]))
    s.one["dist"] = [k1, 0, 0, 0, 0]
    return f"k1 of {k1:.2f} in one camera"


def exchanged(s: Corruption) -> str:
    what = str(s.rng.choice(["calibration", "images and masks", "images", "masks"]))
    keys = {
        "calibration": ["K", "R", "t"],
        "images and masks": ["image", "mask"],
        "images": ["image"],
        "masks": ["mask"],
    }
    for key in keys[what]:
        s.one[key], s.two[key] = s.two[key], s.one[key]
    return f"{what} of two cameras exchanged"


def damaged_json(s: Corruption) -> str:
    key = str(s.rng.choice(["K", "R", "t", "width", "name", "mask", "image"]))
    how = str(s.rng.choice(["left out", "text", "null"]))
    s.one[key] = {"left out": None, "text": "wrong", "null": None}[how] if key != "name" else s.two["name"]
    if how == "left out":
        del s.one[key]
    return f"{key}: {how}"


def damaged_file(s: Corruption) -> str:
    stream = str(s.rng.choice(["image", "mask"]))
    how = str(s.rng.choice(["missing", "cut short", "empty", "another size", "text"]))
    file = s.files(stream)[middle(len(s.description["frames"]))]
    if how == "missing":
        file.unlink()
    elif how == "another size":
        cv2.imwrite(str(file), cv2.resize(cv2.imread(str(file), cv2.IMREAD_UNCHANGED), None, fx=0.5, fy=0.5))
    else:
        data = file.read_bytes()
        file.write_bytes({"cut short": data[: len(data) // 2], "empty": b"", "text": b"hello " * 50}[how])
    return f"{stream} {how}"


def exif(s: Corruption) -> str:
    """Store images rotated with an EXIF orientation, as phones do."""
    code = int(s.rng.choice([3, 6, 8]))
    turn = {3: cv2.ROTATE_180, 6: cv2.ROTATE_90_COUNTERCLOCKWISE, 8: cv2.ROTATE_90_CLOCKWISE}[code]
    every = bool(s.rng.random() < 0.5)
    for camera in s.cameras if every else [s.one]:
        for file in s.files("image", camera):
            image = cv2.rotate(cv2.imread(str(file)), turn)
            file.unlink()
            done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 95])
            assert done
            file.with_suffix(".jpg").write_bytes(with_orientation(data.tobytes(), code))
        camera["image"] = str(Path(camera["image"]).with_suffix(".jpg"))
    return f"EXIF orientation {code}, {'all cameras' if every else 'one camera'}"


def with_orientation(jpeg: bytes, code: int) -> bytes:
    """A JPEG with an EXIF orientation."""
    ifd = b"\x00\x01" + b"\x01\x12\x00\x03\x00\x00\x00\x01" + bytes([0, code, 0, 0]) + b"\x00" * 4
    tiff = b"Exif\x00\x00MM\x00*\x00\x00\x00\x08" + ifd
    return jpeg[:2] + b"\xff\xe1" + (len(tiff) + 2).to_bytes(2, "big") + tiff + jpeg[2:]


def picture(s: Corruption) -> str:
    gain, noise = float(s.rng.uniform(0.4, 1.8)), float(s.rng.uniform(5, 60))
    changes: dict[str, Callable[[np.ndarray], np.ndarray]] = {
        "black": lambda i: 0 * i,
        "white": lambda i: 0 * i + 255,
        "mirrored": lambda i: i[:, ::-1],
        "upside down": lambda i: i[::-1],
        "turned by 180": lambda i: i[::-1, ::-1],
        "BGR": lambda i: i[..., ::-1],
        f"gain {gain:.2f}": lambda i: (i * gain).clip(0, 255).astype(np.uint8),
        "grey": lambda i: np.repeat(i.mean(-1, keepdims=True), 3, -1).astype(np.uint8),
        f"noise {noise:.0f}": lambda i: (i + s.rng.normal(0, noise, i.shape)).clip(0, 255).astype(np.uint8),
        "blurred": lambda i: cv2.GaussianBlur(i, (0, 0), 4),
    }
    name = str(s.rng.choice(list(changes)))
    s.change("image", lambda i: np.ascontiguousarray(changes[name](i)))
    return f"images of one camera {name}"


def mask(s: Corruption) -> str:
    size = int(s.rng.integers(1, 13))
    kernel = np.ones((2 * size + 1,) * 2, np.uint8)
    x, y = (int(n) for n in s.rng.integers(-20, 21, 2))
    share = float(s.rng.uniform(0.1, 0.5))
    side = int(s.rng.integers(4))

    def cut(i: np.ndarray) -> np.ndarray:
        i = np.rot90(i.copy(), side)
        rows = np.flatnonzero((i > 127).reshape(len(i), -1).any(1))
        if len(rows):
            i[: rows[0] + int(share * (rows[-1] - rows[0]))] = 0
        return np.rot90(i, -side)

    changes: dict[str, Callable[[np.ndarray], np.ndarray]] = {
        "inverted": lambda i: 255 - i,
        "empty": lambda i: 0 * i,
        "full": lambda i: 0 * i + 255,
        "mirrored": lambda i: i[:, ::-1],
        "upside down": lambda i: i[::-1],
        "of 0 and 1": lambda i: i // 255,
        f"moved by {x}, {y}": lambda i: np.roll(i, (y, x), (0, 1)),
        f"widened by {size}": lambda i: cv2.dilate(i, kernel),
        f"narrowed by {size}": lambda i: cv2.erode(i, kernel),
        f"without {100 * share:.0f} % of the subject": cut,
        "salted": lambda i: np.where(
            s.rng.random(i.shape[:2] + (1,) * (i.ndim - 2)) < 0.02, 255 - i, i
        ).astype(np.uint8),
    }
    name = str(s.rng.choice(list(changes)))
    every = name in ("inverted", "of 0 and 1", "upside down", "mirrored") and bool(s.rng.random() < 0.5)
    s.change("mask", lambda i: np.ascontiguousarray(changes[name](i)), every)
    return f"masks of {'all' if every else 'one'} {name}"


def late(s: Corruption) -> str:
    streams = {"images and masks": ("image", "mask"), "images": ("image",), "masks": ("mask",)}
    which = str(s.rng.choice(list(streams)))
    frames = int(s.rng.integers(1, 5) * s.rng.choice([-1, 1]))
    for stream in streams[which]:
        files = s.files(stream)
        data = [file.read_bytes() for file in files]
        for time, file in enumerate(files):
            file.write_bytes(data[min(max(time - frames, 0), len(files) - 1)])
    return f"{which} of one camera late by {frames} frames"


def film(path: Path, files: list[Path], fps: int, times: list[int]) -> None:
    """Write images as a film; `times` are their times in frames."""
    import av

    path.parent.mkdir(exist_ok=True)
    with av.open(str(path), "w") as out:
        stream = out.add_stream("libx264", rate=fps)
        stream.height, stream.width = cv2.imread(str(files[0])).shape[:2]
        stream.pix_fmt, stream.options = "yuv444p", {"crf": "4", "preset": "veryfast"}
        stream.codec_context.time_base = Fraction(1, fps)
        for time, file in zip(times, files, strict=True):
            frame = av.VideoFrame.from_ndarray(
                np.ascontiguousarray(cv2.imread(str(file))[..., ::-1]), "rgb24"
            )
            frame.pts, frame.time_base = time, Fraction(1, fps)
            out.mux(stream.encode(frame))
        out.mux(stream.encode(None))


def films(s: Corruption) -> str:
    """Store all images and masks as films, some of them with a fault."""
    fps, count = round(s.description.get("fps") or 15), len(s.description["frames"])
    lost = int(s.rng.integers(1, count - 4))
    kept = [time for time in range(count) if time not in (lost, lost + 1)]
    one, half = [s.one["name"]], [camera["name"] for camera in s.cameras[::2]]
    faults = {
        "pictures lost": (one, ("image", "mask"), kept, kept),
        "pictures lost, without a trace in the times": (one, ("image", "mask"), kept, list(range(len(kept)))),
        "half the rate": (one, ("image", "mask"), list(range(0, count, 2)), list(range(0, count, 2))),
        "half the rate, half of all cameras": (half, ("image", "mask"), list(range(0, count, 2)), None),
        "masks at half the rate": (one, ("mask",), list(range(0, count, 2)), list(range(0, count, 2))),
        "masks end early": (one, ("mask",), list(range(count - 3)), list(range(count - 3))),
        "starts two frames later": (one, ("image", "mask"), list(range(2, count)), list(range(2, count))),
        "masks lost, without a trace in the times": (one, ("mask",), kept, list(range(len(kept)))),
    }
    name = str(s.rng.choice(list(faults)))
    cameras, streams, frames, times = faults[name]
    for camera in s.cameras:
        camera.pop("depth", None)
        for stream in ("image", "mask"):
            bad = camera["name"] in cameras and stream in streams
            own, rate = (frames, fps if times else fps // 2) if bad else (list(range(count)), fps)
            files = s.files(stream, camera)
            place = f"films/{stream}_{camera['name']}.mp4"
            film(
                s.folder / place,
                [files[n] for n in own],
                rate,
                (times or list(range(len(own)))) if bad else own,
            )
            camera["video" if stream == "image" else "mask"] = place
        del camera["image"]
    return f"film: {name}{' (all)' if cameras == half else ''}"


def mask_files(s: Corruption) -> str:
    """Write masks as other tools do; all of these mean the same."""
    from PIL import Image

    def palette(inside: np.ndarray) -> Image.Image:
        image = Image.fromarray(inside.astype(np.uint8) * 3, "P")
        image.putpalette([*(0, 0, 0), *(90, 0, 0), *(0, 90, 0), *(int(n) for n in s.rng.integers(0, 256, 3))])
        return image

    changes: dict[str, Callable[[np.ndarray], Any]] = {
        "a palette": palette,
        "1 bit": lambda inside: Image.fromarray(inside),
        "16 bit": lambda inside: Image.fromarray((inside * 65535).astype(np.uint16)),
        "labels of 16 bit": lambda inside: Image.fromarray((inside * 7).astype(np.uint16)),
        "0 and 1": lambda inside: Image.fromarray(inside.astype(np.uint8)),
        "dark red": lambda inside: Image.fromarray((inside[..., None] * [128, 0, 0]).astype(np.uint8)),
        "grey and alpha": lambda inside: Image.fromarray(
            np.dstack([0 * inside + 255, inside * 255]).astype(np.uint8), "LA"
        ),
    }
    name = str(s.rng.choice(list(changes)))
    every = bool(s.rng.random() < 0.7)
    for camera in s.cameras if every else [s.one]:
        for file in s.files("mask", camera):
            changes[name](cv2.imread(str(file), cv2.IMREAD_GRAYSCALE) > 127).save(file)
    return f"mask files: {name}, {'all' if every else 'one camera'}"


def file_names(s: Corruption) -> str:
    """Files of file managers, or paths of Windows: no fault."""
    if s.rng.random() < 0.5:
        for camera in s.cameras:
            camera["image"] = camera["image"].replace("/", "\\")
        return "paths with backslashes (all)"
    for place in {file.parent for camera in s.cameras for file in s.files("image", camera)} | {s.folder}:
        for junk in ("._000.png", ".DS_Store", "Thumbs.db"):
            (place / junk).write_bytes(b"\0\5\26\7")
    return "files of file managers (all)"


CALIBRATION = (
    r"calibration|camera_from_world|camera-to-world|OpenGL|axes|rotation|"
    r"principal|\bK\b|focal|unit|distortion"
)
CAUSES: dict[Callable[[Corruption], str], str] = {
    poses: CALIBRATION, unit: rf"metres|{CALIBRATION}", turned: CALIBRATION, displaced: CALIBRATION,
    focal: CALIBRATION, centre: rf"first_pixel|{CALIBRATION}", pixel_centre: "first_pixel|principal",
    distortion: CALIBRATION, exchanged: r"exchang|swap|match|its mask|calibration", damaged_json: ".",
    damaged_file: "file|image|mask|pixels", exif: "EXIF|rotat|upright|upside|turned|pixels",
    picture: "images|exposure|colour", mask: "mask", late: "late|early|synchronis|out of step|lost",
    films: "frames per second|lack|start|end |late|early|lost|synchronis|other times|common times|absent",
    mask_files: "mask|label", file_names: "path|file",
}  # fmt: skip
"""What messages about each kind say if they name the true cause."""

KINDS = (
    poses, poses, unit, turned, displaced, focal, centre, pixel_centre, distortion, exchanged, exchanged,
    damaged_json, damaged_file, exif, picture, picture, mask, mask, mask, late, late,
    films, films, films, films, mask_files, mask_files, file_names,
)  # fmt: skip
ONE_FRAME = (late, films)
"""Kinds that need several frames."""


def corrupt(good: Path, folder: Path, seed: int) -> tuple[str, str, str]:
    """Copy a capture with one random mistake; its description, the camera's name, and the pattern of its cause."""
    shutil.copytree(good, folder)
    copy = Corruption(folder, np.random.default_rng(seed))
    kinds = [kind for kind in KINDS if len(copy.description["frames"]) > 1 or kind not in ONE_FRAME]
    kind = kinds[int(copy.rng.integers(len(kinds)))]
    name = copy.one.get("name", "")
    what = kind(copy)
    copy.save()
    return what, name, CAUSES[kind]
