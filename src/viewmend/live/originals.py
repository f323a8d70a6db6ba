"""What a camera took itself, to be seen beside the view from its place."""

from typing import Literal

from msgspec import Struct

from viewmend.live import protocol
from viewmend.live.pictures import to_jpeg
from viewmend.live.protocol import ProtocolError, ShortText, read_message
from viewmend.views import MultiViewFrame

QUALITY = 90


class OriginalQuery(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The query of `GET /camera.jpg`."""

    name: ShortText
    """The camera's."""
    time: Literal["live"] | protocol.Count = "live"
    token: str = ""


def parse_original(query: dict[str, str]) -> OriginalQuery:
    """What the query of a camera's picture asks for.

    Raises:
        ProtocolError: a key is missing or unknown, or a value does not fit.
    """
    return read_message(query, OriginalQuery, strict=False)


def original_jpeg(frame: MultiViewFrame, name: str) -> bytes:
    """The camera's undistorted image at the frame's time, as JPEG.

    Raises:
        ProtocolError: the frame has no such camera.
    """
    if name not in frame.cameras.names:
        raise ProtocolError(
            f"expected a camera of this time, one of {', '.join(frame.cameras.names)[:200]}, got another"
        )
    image = frame.select([name]).rgb[0]
    return to_jpeg(image.movedim(0, -1).contiguous().cpu().numpy(), QUALITY)
