"""Pictures as HLS: a playlist and segments of a second, H.264 in fragmented MP4, made by PyAV and kept in memory."""

from collections import deque
from fractions import Fraction
from io import BytesIO
from typing import TYPE_CHECKING

import numpy as np

from viewmend.data.videos import tag_colours
from viewmend.live.encoding import Image

if TYPE_CHECKING:
    from av import Packet
    from av.container import OutputContainer
    from av.video.stream import VideoStream

PLAYLIST, INIT = "live.m3u8", "init.mp4"
FIRST, LISTED = 3, 6
"""Segments that the playlist names, least and most: players begin three before its end, some refuse a shorter one."""
KEPT = 10
"""Segments that can be asked for: who has an old playlist finds what it names."""
BITS_PER_S = 8_000_000
"""The most that is spent, and saved up: a segment has at most 2 MB."""
MUXER = {
    "hls_time": "1",
    "hls_list_size": str(LISTED),
    "hls_segment_type": "fmp4",
    "hls_fmp4_init_filename": INIT,
    "hls_segment_filename": "memory://%d.m4s",
    "hls_flags": "independent_segments+discont_start",
    "hls_start_number_source": "epoch",  # numbering continues after a restart: segment names are unique
}
ENCODER = {
    "preset": "veryfast",
    "tune": "zerolatency",
    "profile": "main",
    "crf": "21",
    "maxrate": str(BITS_PER_S),
    "bufsize": str(BITS_PER_S),
}


class FilmSegments:
    """A film that goes on, of one size; a context manager. Its files can be asked for from any thread."""

    def __init__(self, size_px: tuple[int, int], fps: int) -> None:
        """Begin.

        Args:
            size_px: width and height, even.
            fps: frames a second that there may be at most.
        """
        self._size_px, self._fps = size_px, fps
        self._files: dict[str, bytes] = {}
        self._segments: deque[str] = deque()
        self._second = -1
        self._held: list[Packet] = []
        self._container, self._stream = self._open()

    def _open(self) -> "tuple[OutputContainer, VideoStream]":
        import av
        from av.video.stream import VideoStream

        container = av.open(f"memory://{PLAYLIST}", "w", format="hls", io_open=self._file, options=MUXER)
        stream = container.add_stream("libx264", rate=self._fps)
        assert isinstance(stream, VideoStream), "that encoder is a video's"
        stream.width, stream.height = self._size_px
        stream.pix_fmt = "yuv420p"
        tag_colours(stream.codec_context)
        stream.time_base = stream.codec_context.time_base = Fraction(1, self._fps)
        stream.codec_context.gop_size = 10 * self._fps  # `add` says where key frames are
        stream.codec_context.thread_count = 1
        stream.options = {**ENCODER}
        return container, stream

    def __enter__(self) -> "FilmSegments":
        return self

    def __exit__(self, *exception: object) -> None:
        self._mux([*self._stream.encode(None)])
        self._container.mux(self._held)
        self._container.close()

    def add(self, picture: Image, at: int) -> None:
        """Append a picture.

        Args:
            picture: RGB; one of another size is stretched.
            at: when it is shown, in frames since the beginning; later than the last.
        """
        import cv2
        from av import VideoFrame
        from av.video.frame import PictureType

        if picture.shape[1::-1] != self._size_px:
            picture = cv2.resize(picture, self._size_px, interpolation=cv2.INTER_LINEAR)
        frame = VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24").reformat(format="yuv420p")
        second = at // self._fps
        frame.pts, frame.time_base = at, Fraction(1, self._fps)
        frame.pict_type = PictureType.I if second != self._second else PictureType.NONE  # where segments can be cut
        self._second = second
        self._mux(self._stream.encode(frame))

    def _mux(self, packets: "list[Packet]") -> None:
        """Write packets, each once the next is there: only then it is known how long it lasts.

        A segment begins, for the muxer, where the last packet before it ends.
        """
        for packet in packets:
            for held in self._held:
                assert packet.pts is not None and held.pts is not None, "the encoder keeps times"
                held.duration = packet.pts - held.pts
            self._container.mux(self._held)
            self._held = [packet]

    def file(self, name: str) -> bytes | None:
        """The playlist, the beginning of every segment, or a segment; None where there is none of that name."""
        return None if name == PLAYLIST and len(self._segments) < FIRST else self._files.get(name)

    def _file(self, url: str, flags: int, options: dict[str, str]) -> "_File":
        return _File(url.removeprefix("memory://"), self)

    def keep(self, name: str, content: bytes) -> None:
        """Have a file that is written; the oldest segments make room."""
        if name.endswith(".m4s"):
            self._segments.append(name)
            while len(self._segments) > KEPT:
                self._files.pop(self._segments.popleft(), None)
        self._files[name] = content


class _File(BytesIO):
    """A file that the muxer writes: there, and whole, once it is closed."""

    def __init__(self, name: str, film: FilmSegments) -> None:
        super().__init__()
        self._name, self._film = name, film

    def close(self) -> None:
        if not self.closed:
            self._film.keep(self._name, self.getvalue())
        super().close()
