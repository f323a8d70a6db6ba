"""Video streams for browsers (WebCodecs), encoded with PyAV."""

from fractions import Fraction
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import UInt8

from viewmend.data.videos import tag_colours

if TYPE_CHECKING:
    from av.video.codeccontext import VideoCodecContext

ENCODERS = {"vp9": "libvpx-vp9", "h264": "libx264"}
STRINGS = {"vp9": "vp09.00.41.08.01.01.01.06.00", "h264": "avc1.42E02A"}
"""Codec strings for VideoDecoder.configure, with profiles and levels for every size within the
limits. For VP9, browsers take the colour space from this string, not from the stream."""
OPTIONS = {
    "vp9": {
        "deadline": "realtime",
        "cpu-used": "8",
        "lag-in-frames": "0",
        "row-mt": "1",
        "crf": "24",
        "b": "0",
    },
    "h264": {
        "preset": "ultrafast",
        "tune": "zerolatency",
        "crf": "21",
        "profile": "baseline",
        "level": "4.2",
    },
}
MAX_KEY_INTERVAL = 240
"""Frames from one key frame to the next."""


@cache
def video_codecs() -> tuple[str, ...]:
    """The codecs that can be encoded here."""
    import av

    return tuple(codec for codec, encoder in ENCODERS.items() if encoder in av.codecs_available)


class VideoStream:
    """The stream of one eye and mode, without delay. Another size or codec starts a new stream."""

    def __init__(self) -> None:
        self._context: VideoCodecContext | None = None
        self._kind: tuple[str, int, int] | None = None
        self._count = 0

    def encode(self, image: UInt8[np.ndarray, "height width 3"], codec: str, key: bool) -> tuple[bytes, bool]:
        """Encode an RGB image, as a key frame if `key`; returns one chunk, and whether it is a key frame.

        Images with odd sides are padded to the right and below by their last column and row.
        """
        from av import VideoFrame
        from av.video.frame import PictureType

        image = np.pad(image, ((0, image.shape[0] % 2), (0, image.shape[1] % 2), (0, 0)), mode="edge")
        kind = (codec, image.shape[1], image.shape[0])
        if self._context is None or kind != self._kind:
            self._context = _open(*kind)
            self._kind = kind
            self._count = 0
        frame = VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24").reformat(
            format="yuv420p"
        )
        frame.pts = self._count
        frame.pict_type = PictureType.I if key or self._count % MAX_KEY_INTERVAL == 0 else PictureType.NONE
        self._count += 1
        packets = self._context.encode(frame)
        assert packets, "encoders without lookahead return a packet per frame"
        return b"".join(bytes(packet) for packet in packets), any(packet.is_keyframe for packet in packets)


def _open(codec: str, width: int, height: int) -> "VideoCodecContext":
    import av

    context = av.CodecContext.create(ENCODERS[codec], "w")
    assert isinstance(context, av.VideoCodecContext)
    context.width = width
    context.height = height
    context.pix_fmt = "yuv420p"
    tag_colours(context)
    context.time_base = Fraction(1, 30)
    context.gop_size = MAX_KEY_INTERVAL
    context.thread_count = 1
    context.options = OPTIONS[codec]
    return context
