"""Films of many codecs and containers, read offline and live, against a full decode: python benchmarks/videos.py.

The reference is an ffmpeg binary (`--ffmpeg`, or the one on the path), which turns films upright itself. Without one it
is FFmpeg's own filters from PyAV, and the known display matrix. Prints a table; writes benchmarks/results.
"""

import argparse
import json
import shutil
import subprocess
import tempfile
from collections import Counter
from contextlib import closing
from itertools import islice
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import av
import numpy as np
import tests_path  # noqa: F401
from av.filter import Graph
from measure import write
from reference.films import MATRICES, picture, set_matrix, write_film

from viewmend.contrib.live_rig.frame_readers import Playback, read_images
from viewmend.data.videos import VideoFile, to_rgb, video_properties

COUNT = 24
FRAMES = [picture(number) for number in range(COUNT)]
B, GROUPS = {"bf": "3", "crf": "8"}, {"bf": "3", "g": "8", "crf": "8"}
VP8 = {"codec": "libvpx", "options": {"b:v": "4M", "deadline": "realtime"}, "container": {"live": "1"}}
HIDDEN = {"codec": "libvpx", "options": {"b:v": "4M", "auto-alt-ref": "1", "lag-in-frames": "16"}}
UNEVEN = [0, 1, 3, 4, 5, 8, 9, 11, 12, 13, 14, 17, 18, 19, 21, 22, 23, 24, 25, 28, 29, 30, 31, 33]
FILMS: dict[str, tuple[str, dict[str, Any]]] = {
    "H.264, B-frames, MP4": ("mp4", {"options": B}),
    "H.264, short groups, Matroska": ("mkv", {"options": GROUPS}),
    "H.264, B-frames, AVI": ("avi", {"options": B}),
    "H.264, MPEG-TS": ("ts", {"options": GROUPS}),
    "H.264, open groups": ("mp4", {"options": GROUPS | {"x264-params": "open-gop=1:bframes=3:keyint=8"}}),
    "H.264, 4:4:4": ("mp4", {"pix_fmt": "yuv444p"}),
    "H.264, 10 bit": ("mp4", {"pix_fmt": "yuv420p10le", "options": B}),
    "H.264, full range": ("mp4", {"full_range": True}),
    "H.264, BT.709": ("mp4", {"bt709": True}),
    "H.264, BT.709, full range": ("mkv", {"bt709": True, "full_range": True}),
    "HEVC, MP4": ("mp4", {"codec": "libx265", "options": {"x265-params": "log-level=none"}}),
    "HEVC, 10 bit": (
        "mkv",
        {"codec": "libx265", "pix_fmt": "yuv420p10le", "options": {"x265-params": "log-level=none"}},
    ),
    "VP8, WebM without a length": ("webm", VP8),
    "VP8, hidden frames": ("webm", HIDDEN),
    "VP9": ("webm", {"codec": "libvpx-vp9", "options": {"deadline": "realtime", "crf": "8", "b:v": "0"}}),
    "AV1": ("mp4", {"codec": "libsvtav1", "options": {"crf": "20", "preset": "12"}}),
    "MPEG-4, B-frames, AVI": ("avi", {"codec": "mpeg4", "options": {"bf": "2", "q:v": "2"}}),
    "MPEG-2, program stream": ("mpg", {"codec": "mpeg2video", "options": {"q:v": "2", "bf": "2"}}),
    "Motion JPEG, full range": ("avi", {"codec": "mjpeg", "pix_fmt": "yuvj420p", "options": {"q:v": "2"}}),
    "ProRes, 4:2:2 of 10 bit": ("mov", {"codec": "prores_ks", "pix_fmt": "yuv422p10le"}),
    "FFV1": ("mkv", {"codec": "ffv1"}),
    "uneven intervals, MP4": ("mp4", {"options": B, "times": UNEVEN}),
    "uneven intervals, Matroska": ("mkv", {"options": B, "times": UNEVEN}),
    "an edit list that hides frames": ("mp4", {"hidden": 9, "options": {"bf": "0", "g": "250"}}),
    "fragments without a length": (
        "mp4",
        {"options": GROUPS, "container": {"movflags": "frag_keyframe+empty_moov"}},
    ),
    "cut off": ("mkv", {"options": GROUPS}),
} | {f"display matrix: {name}": ("mp4", {"options": B}) for name in MATRICES}


def make(name: str, folder: Path) -> Path:
    suffix, how = FILMS[name]
    path = folder / f"{list(FILMS).index(name)}.{suffix}"
    write_film(path, [np.zeros_like(FRAMES[0])] * how.get("hidden", 0) + FRAMES, **how)
    if name == "cut off":
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    matrix = name.removeprefix("display matrix: ")
    return set_matrix(path, matrix) if matrix in MATRICES else path


def by_ffmpeg(binary: str, path: Path, size: tuple[int, int]) -> np.ndarray:
    """All frames, (time, height, width, 3)."""
    command = [binary, "-loglevel", "quiet", "-i", str(path), "-fps_mode", "passthrough"]
    done = subprocess.run(
        [*command, "-f", "rawvideo", "-pix_fmt", "rgb24", "-"], check=True, capture_output=True
    )
    return np.frombuffer(done.stdout, np.uint8).reshape(-1, size[1], size[0], 3)


def by_filters(path: Path, matrix: tuple[int, int, int, int]) -> np.ndarray:
    """All frames, (time, height, width, 3), by FFmpeg's conversion."""
    frames, graph = [], Graph()
    with av.open(str(path)) as film:
        source, end = graph.add_buffer(template=film.streams.video[0]), graph.add("buffersink")
        convert = graph.add("format", "pix_fmts=rgb24")
        source.link_to(convert)
        convert.link_to(end)
        graph.configure()
        for frame in film.decode(video=0):
            graph.push(frame)
            frames.append(graph.pull().to_ndarray())
    a, b, c, d = matrix
    shown = np.stack(frames)
    if a == 0:
        shown, a, d = shown.swapaxes(1, 2), c, b
    return shown[:, ::d, ::a]


class AtOnce(Playback):
    """Nothing is due yet, so nothing is too late."""

    def lap_start_s(self, now_s: float) -> float:
        return now_s + 3600


def live(path: Path, count: int) -> np.ndarray:
    """All frames, (time, height, width, 3), as a live rig plays them; a lap takes no time."""
    playback = AtOnce(1e9)
    camera: Any = SimpleNamespace(name="a", url=str(path), is_file=True, offset_s=0.0)
    with closing(read_images(camera, Counter(), playback, lambda seconds: False)) as pictures:
        return np.stack([to_rgb(played.frame) for played in islice(pictures, count)])


def compare(name: str, folder: Path, binary: str | None) -> dict[str, Any]:
    path = make(name, folder)
    video, film = video_properties(path), VideoFile(path)
    order = np.random.default_rng(0).permutation(video.frames).tolist()
    offline = np.stack([np.asarray(film.read(index, name)) for index in range(video.frames)])
    jumping = all((film.read(index, name) == offline[index]).all() for index in order)
    matrix = MATRICES.get(name.removeprefix("display matrix: "), (1, 0, 0, 1))
    size = (video.width, video.height)
    reference = by_filters(path, matrix) if binary is None else by_ffmpeg(binary, path, size)
    played = live(path, video.frames)
    times = np.array(FILMS[name][1].get("times", range(COUNT))) / 30
    times_off_s = [np.abs(times - time).min() for time in video.times_s]
    same = len(offline) == len(reference)
    return {
        "film": name,
        "frames": [len(reference), len(offline), len(played)],
        "times_off_ms": 1000 * float(max(times_off_s)),
        "offline_off": int(np.abs(offline.astype(int) - reference).max()) if same else None,
        "offline_off_mean": float(np.abs(offline.astype(int) - reference).mean()) if same else None,
        "live_is_offline": bool(played.shape == offline.shape and (played == offline).all()),
        "any_order": jumping,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--ffmpeg", default=shutil.which("ffmpeg"), help="the ffmpeg binary")
    binary = parser.parse_args().ffmpeg
    print(
        "film | frames: reference, offline, live | times off, ms | largest, mean difference | live = offline | seeks"
    )
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for name in FILMS:
            row = compare(name, Path(folder), binary)
            rows.append(row)
            off = (
                f"{row['offline_off']} | {row['offline_off_mean']:.2f}"
                if row["offline_off"] is not None
                else "- | -"
            )
            print(
                f"{name} | {row['frames']} | {row['times_off_ms']:.1f} | {off} | {row['live_is_offline']} | "
                f"{row['any_order']}"
            )
    write("videos", "cpu", {"reference": "ffmpeg" if binary else "PyAV"}, rows)
    print(json.dumps({"films": len(rows), "exact": sum(row["offline_off"] == 0 for row in rows)}))


if __name__ == "__main__":
    main()
