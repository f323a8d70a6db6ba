"""Video files: exact frames with their presentation times, and writing of MP4 and WebM.

Captures and live rigs decode videos here, so they see the same frames: upright, in the
colours that the file declares, at the times that it gives. What a container claims of
length and rate is not trusted.
"""

import functools
import os
import threading
from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from io import BytesIO
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float64, UInt8

from viewmend.data.errors import CaptureError
from viewmend.data.video_colours import is_srgb, to_srgb

if TYPE_CHECKING:
    from av import VideoFrame
    from av.container import InputContainer
    from av.video.codeccontext import VideoCodecContext
    from av.video.stream import VideoStream

VIDEO_SUFFIXES = (
    ".mp4",
    ".avi",
    ".mkv",
    ".mov",
    ".webm",
    ".m4v",
    ".mpg",
    ".mpeg",
    ".wmv",
    ".ts",
    ".mts",
    ".m2ts",
    ".mxf",
    ".flv",
    ".h264",
    ".264",
    ".avc",
    ".h265",
    ".265",
    ".hevc",
    ".mjpg",
    ".mjpeg",
    ".m2v",
    ".ivf",
    ".obu",
    ".y4m",
    ".nut",
    ".3gp",
    ".3g2",
    ".asf",
    ".dv",
    ".f4v",
    ".m2t",
    ".mod",
    ".tod",
    ".mpe",
    ".mpv",
    ".ogv",
    ".qt",
    ".vob",
    ".gxf",
)
"""Suffixes of containers, of raw streams, and of camcorders."""
SMPTE170M = 6
"""The code of BT.601's matrix in ITU-T H.273."""
BT709 = 1
"""The code of BT.709's primaries and transfer function in ITU-T H.273."""
VIDEO_RANGE = 1
"""FFmpeg's code for luma from 16 to 235."""
ABSOLUTE_TIMES = {"mp4", "matroska"}
"""Containers in which time 0 is the start of the recording; in the others the first frame is."""
MAX_ENCODER_DELAY = 2.5
"""A fragmented MP4 with B-frames starts up to this many frames late, which is not a part of the recording."""
WITHOUT_TIMES = {"h264", "hevc", "mjpeg", "mpegvideo", "obu", "m4v", "dirac", "vc1"}
"""Raw streams, whose frames have no times and whose rate is often assumed."""
HIDDEN_FRAMES = ("vp8",)
"""Codecs with packets that show no frame: the number of packets is not the number of frames."""
CHECKED_FRAMES = 8
"""The times of this many frames at the start are compared with those of their packets."""
SEEK_FRAMES = 8
"""Fewer frames than this are decoded rather than skipped by seeking."""
FIRST_FIELDS = {2: "tff", 3: "bff", 4: "bff", 5: "tff"}
"""The field that is shown first, by FFmpeg's code of a stream's field order. Frames of some H.264 videos contradict it,
because their decoder takes the bottom field as the first where the stream does not say."""
RATE_TOLERANCE = 0.01
"""The declared rate is used if the measured one differs from it by less than about this share."""
NO_CHROMA_FILTER = "POINT"
"""The interpolation of chroma in images at their own size. FFmpeg does it this way for 8 bits in any
case; other bit depths follow this choice."""
OPAQUE_OPTIONS: dict[str, object] = {"crf": "18", "preset": "veryfast"}
"""Options of the encoder of videos without alpha."""
ALPHA_OPTIONS: dict[str, object] = {
    "crf": "18",
    "b:v": "0",
    "auto-alt-ref": "0",
    "deadline": "realtime",
    "cpu-used": "5",
}
"""Options of the encoder of videos with alpha, which is encoded as a second image; VP9's hidden
reference frames would separate the two."""

Image = UInt8[np.ndarray, "height width 3"]
ImageWithAlpha = UInt8[np.ndarray, "height width 4"]
"""RGB and straight alpha."""


def is_video(path: str) -> bool:
    """Whether a file name is that of a video."""
    return path.lower().endswith(VIDEO_SUFFIXES)


@dataclass(frozen=True)
class VideoProperties:
    """What a video file contains: measured, whatever its header claims."""

    path: Path
    width: int
    height: int
    """Size of the upright image."""
    fps: float | None
    """Frames per second, gaps aside; None for a single frame without a declared rate."""
    times_s: tuple[float, ...]
    """Presentation time of each frame, increasing; 0 is the start of the recording."""
    timestamps: tuple[int, ...] | None
    """The decoder's own times of the frames; None if they do not increase, so that frames are
    counted instead."""
    keys: tuple[int, ...]
    """The timestamps at which decoding can start."""
    is_timed: bool = True
    """Whether the file stores the times of its frames; raw streams do not."""
    is_interlaced: bool = False
    """Whether frames are made of two fields. They are read de-interlaced, at the time of their
    first field."""
    first_field: str = "auto"
    """Which field of an interlaced video is shown first, as FFmpeg's filters name it: "tff" for the top one, "bff" for
    the bottom one, "auto" as each frame says."""
    timecode: str | None = None
    """The recorder's clock at the first frame, HH:MM:SS:FF, or HH:MM:SS;FF in drop-frame counting."""

    @property
    def frames(self) -> int:
        """How many frames can be decoded."""
        return len(self.times_s)


def video_properties(path: Path) -> VideoProperties:
    """Size, rate and frame times of a video, from its packets and the frames at its start and end.

    CaptureError for a file without frames.
    """
    stat = path.stat() if path.is_file() else None
    return _measured(path, None if stat is None else (stat.st_mtime_ns, stat.st_size))


@functools.lru_cache(maxsize=512)
def _measured(path: Path, _version: tuple[int, int] | None) -> VideoProperties:
    """Compute `video_properties`; `_version` changes with the file."""
    with _open_video(path) as container:
        stream = container.streams.video[0]
        codec = stream.codec_context
        base = stream.time_base or Fraction(1, 25)
        rate = stream.average_rate or stream.guessed_rate
        shown = (packet for packet in container.demux(stream) if packet.size > 0 and not packet.is_discard)
        packets = [(packet.pts, packet.is_keyframe) for packet in shown]  # an edit list hides the others
        may_be_delayed = stream.frames == 0 and codec.has_b_frames
        first_field = first_field_of(codec)
        names = set(container.format.name.split(","))
        timecode = _timecode(container, stream)
    head = list(islice(_decoded(path), CHECKED_FRAMES))
    if not head:
        raise CaptureError(f"{path}: expected a video, got a file without decodable frames; export it again")
    timestamps = None if codec.name in HIDDEN_FRAMES else _timestamps(path, packets, [f.pts for f in head])
    times = timestamps
    if timestamps is None:
        decoded = [frame.pts for frame in _decoded(path)]
        times = sorted({time for time in decoded if time is not None})
        if times == decoded:
            timestamps = tuple(times)
        elif not len(times) == len(decoded) == len(packets):  # AVI mixes the order up, but keeps the gaps
            times = range(len(decoded))
            base = 1 / (rate or Fraction(25))
    seconds = np.array([float(time * base) for time in times or ()])
    fps = _measured_rate(seconds, None if rate is None else float(rate), float(base))
    delayed = may_be_delayed and fps is not None and seconds[0] <= MAX_ENCODER_DELAY / fps
    if not names & ABSOLUTE_TIMES or ("mp4" in names and delayed):
        seconds -= seconds[0]
    height, width = _upright(np.empty((head[0].height, head[0].width), np.uint8), head[0]).shape
    return VideoProperties(
        path,
        width,
        height,
        fps,
        tuple(seconds.tolist()),
        timestamps,
        tuple(sorted(time for time, key in packets if key and time is not None)) if timestamps else (),
        is_timed=not names & WITHOUT_TIMES,
        is_interlaced=2 * sum(frame.interlaced_frame for frame in head) > len(head),
        first_field=first_field,
        timecode=timecode,
    )


def _timecode(container: "InputContainer", stream: "VideoStream") -> str | None:
    """The timecode in a file's metadata: of the container, else of the video stream, else of another one."""
    for place in (container, stream, *container.streams):
        for key, value in place.metadata.items():
            if key.lower() == "timecode":  # Matroska has capitals
                return value
    return None


def _timestamps(
    path: Path, packets: list[tuple[int | None, bool]], head: list[int | None]
) -> tuple[int, ...] | None:
    """The times of all frames by their packets; None if packets and the frames at the start and the end differ."""
    times = sorted(time for time, _ in packets if time is not None)
    if len(set(times)) != len(packets) or head[0] is None:
        return None
    times = times[bisect_left(times, head[0]) :]  # earlier ones lack the frames that they are predicted from
    if times[: len(head)] != head:
        return None
    last_key = max(
        (time for time, key in packets if key and time is not None and time >= times[0]), default=times[0]
    )
    tail = [frame.pts for frame in _decoded(path, last_key) if frame.pts is not None]
    if last_key not in tail:
        return None
    return tuple(times[: bisect_left(times, last_key)] + tail[tail.index(last_key) :])


def _measured_rate(
    seconds: Float64[np.ndarray, "frame"], declared: float | None, resolution_s: float
) -> float | None:
    """Frames per second between gaps; the declared rate if that is as close as the resolution of the times allows."""
    if len(seconds) < 2:
        return declared
    steps = np.diff(seconds)
    steps = steps[steps < 1.5 * np.median(steps)]
    tolerance = RATE_TOLERANCE + resolution_s / float(steps.sum())
    measured = 1 / float(steps.mean())
    return declared if declared and abs(measured / declared - 1) < tolerance else measured


def _open_video(path: Path) -> "InputContainer":
    import av

    try:
        container = av.open(str(path), metadata_errors="ignore")
    except FileNotFoundError:
        raise CaptureError(
            f"{path}: expected a video, got: No such file or directory; check the path"
        ) from None
    except (av.FFmpegError, OSError, ValueError):
        raise CaptureError(
            f"{path}: expected a video, got a file that no decoder opens; export it again"
        ) from None
    if not container.streams.video:
        container.close()
        raise CaptureError(f"{path}: expected a video, got a file without one; export it again")
    return container


def _decoded(path: Path, seek: int | None = None, threads: int = 0) -> "Iterator[VideoFrame]":
    """The undamaged frames of a file in order, from the key frame at or before the timestamp `seek` on."""
    import av

    with _open_video(path) as container:
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        stream.codec_context.thread_count = threads
        if seek is not None:
            container.seek(seek, stream=stream, backward=True)
        packets = container.demux(stream)
        while True:
            try:
                packet = next(packets, None)
                if packet is None:
                    return
                yield from packet.decode()  # the last packet is empty and returns the frames that the decoder holds
            except av.InvalidDataError:
                continue
            except av.FFmpegError:
                return


def decode(video: VideoProperties, start: int = 0, threads: int = 0) -> "Iterator[tuple[int, VideoFrame]]":
    """The frames of a file from index `start` on, each with its index. Frames that cannot be decoded are left out."""
    times = video.timestamps
    if start >= video.frames:
        return
    if times is None:
        yield from islice(enumerate(_progressive(video, None, threads)), start, None)
        return
    key = bisect_right(video.keys, times[start]) - 1
    frames = _progressive(video, video.keys[key] if key > 0 else None, threads)
    first = next(frames, None)
    if key > 0 and (first is None or first.pts is None or first.pts > video.keys[key]):  # the seek has missed
        frames = _progressive(video, None, threads)
        first = next(frames, None)
    for frame in chain([] if first is None else [first], frames):
        index = bisect_left(times, frame.pts) if frame.pts is not None else len(times)
        if start <= index < len(times) and times[index] == frame.pts:
            yield index, frame


def _progressive(video: VideoProperties, seek: int | None, threads: int) -> "Iterator[VideoFrame]":
    """The decoded frames, de-interlaced if the video is interlaced."""
    frames = _decoded(video.path, seek, threads)
    if not video.is_interlaced:
        return frames
    return _filtered(frames, "bwdif", f"mode=send_frame:parity={video.first_field}:deint=all")


def first_field_of(codec: "VideoCodecContext") -> str:
    """Which field of an interlaced stream is shown first; see `VideoProperties.first_field`."""
    return FIRST_FIELDS.get(int(codec.field_order), "auto")


def first_field_alone(frame: "VideoFrame", first_field: str = "auto") -> "VideoFrame":
    """A live stream's frame without its second field, whose rows are interpolated; itself if it is not interlaced.

    Recorded videos are interpolated from the frames before and after, too. A live picture would be late if it waited.
    """
    if not frame.interlaced_frame:
        return frame
    return next(_filtered(iter([frame]), "estdif", f"mode=frame:parity={first_field}:deint=all"), frame)


def _filtered(frames: "Iterator[VideoFrame]", name: str, options: str) -> "Iterator[VideoFrame]":
    """The frames after one of FFmpeg's filters, with their own times."""
    from av import BlockingIOError, FFmpegError
    from av.filter import Graph

    first = next(frames, None)
    if first is None:
        return
    graph = Graph()
    base = first.time_base or Fraction(1, 25)
    source = graph.add_buffer(width=first.width, height=first.height, format=first.format, time_base=base)
    graph.link_nodes(source, graph.add(name, options), graph.add("buffersink"))
    graph.configure()
    for frame in chain([first], frames, [None]):
        graph.push(frame)
        while True:
            try:
                made: Any = graph.pull()
            except (BlockingIOError, FFmpegError):
                break
            if made.pts is not None and made.time_base:
                made.pts = round(made.pts * made.time_base / base)
                made.time_base = base
            yield made


def to_rgb(frame: "VideoFrame", size_px: tuple[int, int] | None = None) -> Image:
    """A decoded frame as upright sRGB, by the colours that it declares, at its own or another upright size."""
    stored_px = frame.width, frame.height
    width, height = stored_px if size_px is None else size_px[::-1] if is_turned(frame) else size_px
    how = NO_CHROMA_FILTER if (width, height) == stored_px else "AREA"
    primaries = int(frame.color_primaries)
    transfer = int(frame.color_trc)
    if is_srgb(primaries, transfer):
        rgb = frame.to_ndarray(format="rgb24", width=width, height=height, interpolation=how)
    else:
        deep = frame.to_ndarray(format="rgb48le", width=width, height=height, interpolation=how)
        rgb = to_srgb(deep, primaries, transfer)
    return np.ascontiguousarray(_upright(rgb, frame))


def is_turned(frame: "VideoFrame") -> bool:
    """Whether the upright image is as wide as the stored one is high."""
    return _display_matrix(frame)[0] == 0


def _display_matrix(frame: "VideoFrame") -> tuple[int, int, int, int]:
    """a, b, c, d of the display matrix, as signs: a stored (x, y) is shown at (a x + c y, b x + d y)."""
    from av.sidedata.sidedata import Type

    side_data: Any = frame.side_data  # its stub names other keys
    matrix = side_data.get(Type.DISPLAYMATRIX)
    if matrix is not None:
        numbers = np.frombuffer(bytes(matrix), np.int32)
        a, b, c, d = np.sign(np.rint(numbers[[0, 1, 3, 4]] / 2**16).astype(int)).tolist()
        if (b == c == 0 and a * d != 0) or (a == d == 0 and b * c != 0):
            return a, b, c, d
    return 1, 0, 0, 1


def _upright(image: np.ndarray, frame: "VideoFrame") -> np.ndarray:
    """An image as stored, turned and mirrored as the frame's display matrix says; a view."""
    a, b, c, d = _display_matrix(frame)
    if a == 0:
        image = image.swapaxes(0, 1)
        a = c
        d = b
    return image[:: -1 if d < 0 else 1, :: -1 if a < 0 else 1]


@dataclass
class _Decoding:
    """How far one process has decoded a video. It keeps the last frame."""

    frames: "Iterator[tuple[int, VideoFrame]] | None" = None
    before: int = -1
    """Index of the frame before the last one that was decoded."""
    at: int = -1
    """Index of the last frame that was decoded."""
    last: "VideoFrame | None" = None
    image: Image | None = None
    lock: threading.Lock = field(default_factory=threading.Lock)


class VideoFile:
    """A video, read by frame index. Threads and forked processes may share it. Frames are cheapest in order of time."""

    def __init__(self, path: Path):
        self.path = path
        self._decoding: dict[int, _Decoding] = {}
        """A decoder for each process. A forked process has no decoder threads and cannot unlock its
        parent's decoder, so it opens its own. It does not close the parent's, which would wait for threads."""

    def read(self, index: int, where: str) -> Image | None:
        """The frame at `index` as RGB, read-only; None if it is damaged.

        CaptureError, whose message begins with `where`, if the video is too short.
        """
        decoding = self._decoding.setdefault(os.getpid(), _Decoding())
        with decoding.lock:
            video = video_properties(self.path)
            if index >= video.frames:
                expected = f"at least {index + 1} frames in the video"
                got = video.frames
                next_step = "shorten 'frames' in cameras.json, or export the video again"
                raise CaptureError(f"{where}: expected {expected}, got {got}; {next_step}")
            if decoding.frames is None or index <= decoding.before or _skips(video, decoding.at, index):
                decoding.frames = decode(video, index)
                decoding.before = index - 1
                decoding.at = index - 1
                decoding.last = None
            while decoding.at < index:
                found = next(decoding.frames, None)
                if found is None:
                    break
                decoding.before = decoding.at
                decoding.at, decoding.last = found
                decoding.image = None
            if decoding.at != index or decoding.last is None:
                return None
            if decoding.image is None:
                decoding.image = to_rgb(decoding.last)
            return decoding.image


def _skips(video: VideoProperties, at: int, index: int) -> bool:
    """Whether seeking is faster than decoding on from the frame `at` to another one."""
    if video.timestamps is None or index < at + SEEK_FRAMES:
        return False
    key = bisect_right(video.keys, video.timestamps[index]) - 1
    return key >= 0 and video.keys[key] > video.timestamps[max(at, 0)]


class VideoWriter:
    """Writes a video of frames that all have the size of the first. A context manager.

    RGB becomes an H.264 MP4 that plays everywhere (4:2:0); an odd last row or column is dropped.
    RGB with `alpha` becomes a VP9 WebM, which browsers and editors composite. `threads` is the
    number of encoder threads, 0 for one per core.
    """

    def __init__(self, file: Path | BytesIO, fps: float, threads: int = 0, alpha: bool = False):
        import av

        if isinstance(file, Path):
            file.parent.mkdir(parents=True, exist_ok=True)
        self._container: Any = av.open(file, "w", format="webm" if alpha else "mp4")
        codec = "libvpx-vp9" if alpha else "libx264"
        rate = Fraction(fps).limit_denominator(1001)
        self._stream: Any = self._container.add_stream(codec, rate=rate)
        self._stream.pix_fmt = "yuva420p" if alpha else "yuv420p"
        tag_colours(self._stream.codec_context)
        self._stream.options = ALPHA_OPTIONS if alpha else OPAQUE_OPTIONS
        if alpha:
            self._stream.metadata["alpha_mode"] = "1"
        self._stream.codec_context.thread_count = threads
        self._started = False
        self._alpha = alpha

    def __enter__(self) -> "VideoWriter":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def add(self, image: Image | ImageWithAlpha) -> None:
        """Append a frame."""
        from av import VideoFrame

        if not self._alpha:
            image = image[: image.shape[0] // 2 * 2, : image.shape[1] // 2 * 2]
        if not self._started:
            self._stream.height, self._stream.width = image.shape[:2]
            self._started = True
        frame = VideoFrame.from_ndarray(
            np.ascontiguousarray(image), format="rgba" if self._alpha else "rgb24"
        )
        self._container.mux(self._stream.encode(frame))

    def close(self) -> None:
        """Finish the file; a second call does nothing."""
        if self._started:
            self._container.mux(self._stream.encode(None))
            self._started = False
        self._container.close()


def tag_colours(context: "VideoCodecContext") -> None:
    """Declare that the YUV data are sRGB converted by BT.601 in video range, as FFmpeg does. Call before opening.

    Without these tags browsers assume BT.709, always or from 720 rows on, and colours
    change by up to 25 of 255.
    """
    context.colorspace = SMPTE170M
    context.color_range = VIDEO_RANGE
    # The primaries and the transfer function of sRGB; browsers need both
    context.color_primaries = BT709
    context.color_trc = BT709


def write_mp4(file: Path | BytesIO, frames: Iterable[Image], fps: float) -> None:
    """Write frames as an MP4 that plays everywhere."""
    with VideoWriter(file, fps) as video:
        for frame in frames:
            video.add(frame)


def write_webm(file: Path, frames: Iterable[ImageWithAlpha], fps: float) -> None:
    """Write frames as a WebM with alpha."""
    with VideoWriter(file, fps, alpha=True) as video:
        for frame in frames:
            video.add(frame)
