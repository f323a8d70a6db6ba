"""Small films for tests, written by PyAV."""

import shutil
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from reference.capture_folder import edit_description

from viewmend.data.images import read_rgb
from viewmend.data.native_writer import write_capture
from viewmend.data.source import CaptureSource

SIZE = (64, 48)
MATRICES = {
    "turned by 180 degrees": (-1, 0, 0, -1),
    "turned by 90 degrees": (0, 1, -1, 0),
    "turned by 270 degrees": (0, -1, 1, 0),
    "mirrored": (-1, 0, 0, 1),
    "upside down": (1, 0, 0, -1),
    "transposed": (0, 1, 1, 0),
}
"""a, b, c, d of display matrices."""


def picture(number: int) -> np.ndarray:
    """An image without symmetry, which differs from number to number: a dark corner, and a bar that moves right."""
    image = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
    image[..., 0], image[..., 1] = np.linspace(60, 250, SIZE[0])[None], np.linspace(250, 60, SIZE[1])[:, None]
    image[:, (2 * number) % SIZE[0] :][:, :8, 2] = 255
    return image


def write_film(
    path: Path,
    frames: Sequence[np.ndarray],
    *,
    fps: int = 30,
    codec: str = "libx264",
    pix_fmt: str = "yuv420p",
    times: Sequence[int] | None = None,
    hidden: int = 0,
    options: dict[str, str] | None = None,
    container: dict[str, str] | None = None,
    full_range: bool = False,
    bt709: bool = False,
) -> Path:
    """Write a film whose frames are shown at `times`, in frame periods; an edit list hides the first `hidden`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    extra = {"use_editlist": "1", "avoid_negative_ts": "disabled"} if hidden else {}
    with av.open(str(path), "w", options=(container or {}) | extra) as film:
        stream = film.add_stream(codec, rate=fps)
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt, stream.options = pix_fmt, options or {}
        if full_range:
            stream.codec_context.color_range = 2
        if bt709:
            stream.codec_context.colorspace = 1
        for number, rgb in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(rgb), format="rgb24")
            frame.pts = number if times is None else times[number]
            frame.time_base = Fraction(1, fps)
            _mux(film, stream.encode(frame), hidden / fps)
        _mux(film, stream.encode(None), hidden / fps)
    return path


def _mux(film, packets, earlier_s: float) -> None:
    for packet in packets:
        if earlier_s:
            shift = round(earlier_s / float(packet.time_base))
            packet.pts, packet.dts = packet.pts - shift, packet.dts - shift
        film.mux(packet)


def write_film_capture(source: CaptureSource, folder: Path) -> None:
    """Write a capture with a nearly lossless film of each camera, and numbered masks."""
    write_capture(source, folder, images="png")

    def replace_images(content):
        for camera in content["cameras"]:
            images = sorted((folder / camera.pop("image")).parent.glob("*.png"))
            camera["video"] = f"video/{camera['name']}.mp4"
            frames = [read_rgb(path, "") for path in images]
            write_film(folder / camera["video"], frames, fps=10, pix_fmt="yuv444p", options={"crf": "8"})

    edit_description(folder, replace_images)
    shutil.rmtree(folder / "image")


def set_matrix(path: Path, name: str) -> Path:
    """Write one of `MATRICES` into the track header of an MP4, as phones do."""
    data = bytearray(path.read_bytes())
    start = data.find(b"tkhd") + 4
    start += 40 if data[start] == 0 else 52
    numbers = (*MATRICES[name][:2], 0, *MATRICES[name][2:], 0, 0, 0)
    fixed = b"".join((number << 16).to_bytes(4, "big", signed=True) for number in numbers)
    data[start : start + 36] = fixed + bytes.fromhex("40000000")
    path.write_bytes(data)
    return path
