"""Rendered views as the binary messages that are sent."""

import time
from dataclasses import asdict, dataclass
from typing import Any

from viewmend.geometry.threads import light_operations
from viewmend.live.pictures import (
    COLOURS,
    Picture,
    depth_stride,
    mean_confidence,
    pack_depth,
    picture,
    surface_depth,
    to_jpeg,
)
from viewmend.live.poses import cameras_json
from viewmend.live.protocol import MENDED_MODES, FrameTimes, Look, pack
from viewmend.live.renderer import RenderRequest, RenderResult
from viewmend.live.video import STRINGS, VideoStream


@dataclass(frozen=True)
class FrameInfo:
    """What a frame's header says besides its pictures."""

    frame: int
    full: bool
    wait_ms: float
    dropped: int
    key: bool
    """Video streams begin anew."""


class Encoders:
    """How one viewer's pictures are encoded; video streams remember what came before."""

    def __init__(self) -> None:
        self._streams: dict[tuple[int, str], VideoStream] = {}

    def encode(self, image: Picture, eye: int, mode: str, look: Look, key: bool) -> tuple[dict[str, Any], bytes]:
        """The part's description, and its data."""
        part: dict[str, Any] = {"kind": "image", "eye": eye, "mode": mode, "codec": look.codec}
        if look.codec == "jpeg":
            data = to_jpeg(image, look.quality)
        else:
            stream = self._streams.setdefault((eye, mode), VideoStream())
            data, part["key"] = stream.encode(image, look.codec, key)
            part["codec_string"] = STRINGS[look.codec]
        return part | {"bytes": len(data)}, data


@light_operations()
def frame_message(
    look: Look, request: RenderRequest, result: RenderResult, info: FrameInfo, encoders: Encoders
) -> tuple[bytes, FrameTimes]:
    """The message, and the milliseconds of every stage."""
    start = time.perf_counter()
    parts, data = [], []
    for eye, (completed, hulls) in enumerate(result.eyes):
        for mode in look.modes:
            shown = picture(completed, mode, look.background or result.background, hulls)
            part, encoded = encoders.encode(shown, eye, mode, look, info.key)
            parts.append(part)
            data.append(encoded)
        if look.depth:
            depth = surface_depth(completed) if MENDED_MODES.issuperset(look.modes) else completed.view.depth
            packed = asdict(pack_depth(depth, depth_stride(*depth.shape)))
            data.append(packed.pop("data"))
            parts.append({"kind": "depth", "eye": eye, "bytes": len(data[-1]), "encoding": "u16-delta-zlib", **packed})
    encode_ms = 1000 * (time.perf_counter() - start)
    times = FrameTimes(**vars(result.times), encode=encode_ms, wait=info.wait_ms)
    first = result.completed[0].view
    keys = ("K", "R", "T")
    header: dict[str, Any] = {
        "frame": info.frame,
        "look": look.id,
        "sent_ms": look.sent_ms,
        "time": result.time,
        "width": first.mask.shape[1],
        "height": first.mask.shape[0],
        "full": info.full,
        "cameras": [{k: c[k] for k in keys} for v in result.completed for c in cameras_json(v.view.camera)],
        "source_views": list(first.source_views),
        "colours": [COLOURS[n % len(COLOURS)] for n in range(len(first.source_views))],
        "holes": round(float(first.holes.sum()) / max(1.0, float((first.mask > 0).sum())), 5),
        "confidence": mean_confidence(result.completed[0]),
        "top_k": request.quality.top_k,
        "context_times": request.quality.context_times,
        "read_fraction": request.quality.read_fraction,
        "stage_ms": times.as_json(),
        "dropped": info.dropped,
        "parts": parts,
    }
    return pack(header, data), times
