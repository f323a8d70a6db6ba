"""Frames as video streams that a browser decodes (WebCodecs), encoded with PyAV (the extra `viewmend[video]`)."""

from fractions import Fraction
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from viewmend.capture.video_writer import say_colours
from viewmend.live.pictures import Picture

if TYPE_CHECKING:
    from av.video.codeccontext import VideoCodecContext

ENCODERS = {"vp9": "libvpx-vp9", "h264": "libx264"}
STRINGS = {"vp9": "vp09.00.41.08.01.01.01.06.00", "h264": "avc1.42E02A"}
"""What VideoDecoder.configure is told: profile and level hold every size that the limits allow. Of VP9 browsers believe
this, not the stream, about how colours are to be read (`say_colours`)."""
OPTIONS = {
    "vp9": {"deadline": "realtime", "cpu-used": "8", "lag-in-frames": "0", "row-mt": "1", "crf": "24", "b": "0"},
    "h264": {"preset": "ultrafast", "tune": "zerolatency", "crf": "21", "profile": "baseline", "level": "4.2"},
}
KEY_EVERY = 240
"""Frames between key frames, at most."""


@cache
def video_codecs() -> tuple[str, ...]:
    """Codecs that can be encoded here."""
    try:
        import av
    except ImportError:
        return ()
    return tuple(codec for codec, encoder in ENCODERS.items() if encoder in av.codecs_available)


class VideoStream:
    """One eye's and mode's stream; every frame comes out at once. Another size, or another codec, begins anew."""

    def __init__(self) -> None:
        self._context: VideoCodecContext | None = None
        self._kind: tuple[str, int, int] | None = None
        self._count = 0

    def encode(self, image: Picture, codec: str, key: bool) -> tuple[bytes, bool]:
        """A frame as one chunk, and whether it is a key frame; `key` asks for one.

        Odd sizes are padded right and below by their last row and column.
        """
        from av import VideoFrame
        from av.video.frame import PictureType

        image = np.pad(image, ((0, image.shape[0] % 2), (0, image.shape[1] % 2), (0, 0)), mode="edge")
        kind = (codec, image.shape[1], image.shape[0])
        if self._context is None or kind != self._kind:
            self._context, self._kind, self._count = _open(*kind), kind, 0
        frame = VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24").reformat(format="yuv420p")
        frame.pts = self._count
        frame.pict_type = PictureType.I if key or self._count % KEY_EVERY == 0 else PictureType.NONE
        self._count += 1
        packets = self._context.encode(frame)
        assert packets, "streams without lookahead give a frame for a frame"
        return b"".join(bytes(packet) for packet in packets), any(packet.is_keyframe for packet in packets)


def _open(codec: str, width: int, height: int) -> "VideoCodecContext":
    import av

    context = av.CodecContext.create(ENCODERS[codec], "w")
    assert isinstance(context, av.VideoCodecContext)
    context.width, context.height = width, height
    context.pix_fmt = "yuv420p"
    say_colours(context)
    context.time_base = Fraction(1, 30)
    context.gop_size = KEY_EVERY
    context.thread_count = 1
    context.options = OPTIONS[codec]
    return context
