"""An endless video as HLS: segments of one second, in memory."""

from collections import deque
from fractions import Fraction
from functools import partial
from io import BytesIO
from typing import TYPE_CHECKING

import numpy as np

from viewmend.data.videos import tag_colours
from viewmend.live.encoding import Image

if TYPE_CHECKING:
    from av import Packet

PLAYLIST = "live.m3u8"
"""The playlist's name."""
INIT = "init.mp4"
"""The name of the file that precedes all segments."""
MIN_SEGMENTS = 3
"""The playlist is served once it has this many segments: some players refuse a shorter one."""
LISTED_SEGMENTS = 6
"""The playlist names at most this many segments."""
KEPT_SEGMENTS = 10
"""This many segments are kept, also for players with an older playlist."""
BITS_PER_S = 8_000_000
"""The encoder's peak bit rate; its buffer holds a second of it, so that a segment has at most 2 MB."""
MUXER_OPTIONS = {
    "hls_time": "1",
    "hls_list_size": str(LISTED_SEGMENTS),
    "hls_segment_type": "fmp4",
    "hls_fmp4_init_filename": INIT,
    "hls_segment_filename": "memory://%d.m4s",
    "hls_flags": "independent_segments+discont_start",
    "hls_start_number_source": "epoch",  # numbering continues after a restart: segment names are unique
}
"""FFmpeg's options for the playlist and its segments."""
ENCODER_OPTIONS = {
    "preset": "veryfast",
    "tune": "zerolatency",
    "profile": "main",
    "crf": "21",
    "maxrate": str(BITS_PER_S),
    "bufsize": str(BITS_PER_S),
}
"""FFmpeg's options for x264."""


class HlsSegmenter:
    """A playlist and segments of one second, H.264 in fragmented MP4, of one image size.

    A context manager. Its files can be read from any thread.
    """

    def __init__(self, size_px: tuple[int, int], fps: int) -> None:
        import av
        from av.video.stream import VideoStream

        self._size_px = size_px
        self._fps = fps
        self._files: dict[str, bytes] = {}
        self._segments: deque[str] = deque()
        self._second = -1
        """The second of the last image."""
        self._held: list[Packet] = []
        """The last packet, whose duration is not known yet."""
        open_file = partial(_File, self)
        self._container = av.open(
            f"memory://{PLAYLIST}", "w", format="hls", io_open=open_file, options=MUXER_OPTIONS
        )
        stream = self._container.add_stream("libx264", rate=fps)
        assert isinstance(stream, VideoStream), "that encoder is a video's"
        width, height = size_px
        stream.width = width
        stream.height = height
        stream.pix_fmt = "yuv420p"
        tag_colours(stream.codec_context)
        stream.time_base = Fraction(1, fps)
        stream.codec_context.time_base = Fraction(1, fps)
        stream.codec_context.gop_size = 10 * fps  # `add` says where key frames are
        stream.codec_context.thread_count = 1
        stream.options = dict(ENCODER_OPTIONS)
        self._stream = stream

    def __enter__(self) -> "HlsSegmenter":
        return self

    def __exit__(self, *exception: object) -> None:
        self._mux(self._stream.encode(None))
        self._container.mux(self._held)
        self._container.close()

    def add(self, picture: Image, at: int) -> None:
        """Append an image.

        Args:
            picture: RGB; one of another size is resized.
            at: its time, in frames since the beginning; later than the last.
        """
        import cv2
        from av import VideoFrame
        from av.video.frame import PictureType

        if picture.shape[1::-1] != self._size_px:
            picture = cv2.resize(picture, self._size_px, interpolation=cv2.INTER_LINEAR)
        # pyrefly: ignore[bad-argument-type]
        frame = VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
        frame = frame.reformat(format="yuv420p")
        frame.pts = at
        frame.time_base = Fraction(1, self._fps)
        second = at // self._fps
        starts_segment = second != self._second
        frame.pict_type = PictureType.I if starts_segment else PictureType.NONE
        self._second = second
        self._mux(self._stream.encode(frame))

    def _mux(self, packets: "list[Packet]") -> None:
        """Write packets, each when the next one arrives and so sets its duration.

        The muxer starts a segment where the last packet before it ends.
        """
        for packet in packets:
            for held in self._held:
                assert packet.pts is not None and held.pts is not None, "the encoder keeps times"
                held.duration = packet.pts - held.pts
            self._container.mux(self._held)
            self._held = [packet]

    def file(self, name: str) -> bytes | None:
        """The playlist, the header of all segments, or a segment; None if there is none of that name."""
        if name == PLAYLIST and len(self._segments) < MIN_SEGMENTS:
            return None
        return self._files.get(name)

    def keep(self, name: str, content: bytes) -> None:
        """Store a finished file; the oldest segments are dropped."""
        if name.endswith(".m4s"):
            self._segments.append(name)
            while len(self._segments) > KEPT_SEGMENTS:
                self._files.pop(self._segments.popleft(), None)
        self._files[name] = content


class _File(BytesIO):
    """A file that the muxer writes; stored when it is closed."""

    def __init__(self, segmenter: HlsSegmenter, url: str, flags: int, options: dict[str, str]) -> None:
        super().__init__()
        self._name = url.removeprefix("memory://")
        self._segmenter = segmenter

    def close(self) -> None:
        if not self.closed:
            self._segmenter.keep(self._name, self.getvalue())
        super().close()
