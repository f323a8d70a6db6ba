"""Views as images (each mode of the protocol), JPEG, packed depth, and the binary messages of frames."""

import time
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8, UInt16
from torch import Tensor

from viewmend.geometry.rim import rim_depth
from viewmend.geometry.threads import one_thread
from viewmend.live.poses import cameras_json
from viewmend.live.protocol import BLACK, COMPLETED_MODES, EXTRA_MODES, FrameTimes, Look, pack
from viewmend.live.renderer import RenderRequest, RenderResult
from viewmend.live.video import STRINGS, VideoStream
from viewmend.types import FAINT, CompletedView, IncompleteView

Image = UInt8[np.ndarray, "height width 3"]
HOLE = (1.0, 0.15, 0.55)
"""Colour of missing pixels: a pink that clothes and skin do not have."""
COLOURS = ((230, 120, 60), (70, 150, 230), (120, 200, 90), (200, 110, 210), (235, 200, 70), (90, 205, 200))
"""Colours of the source views in the mode `coverage`."""
DEPTH_STRIDES = ((160, 1), (400, 2))
"""Pairs (longest side, stride): image pixels per depth pixel, so that outlines of small images are
not ragged."""
COARSEST_STRIDE = 4
"""Image pixels per depth pixel in larger images."""
LARGE_ERROR = 0.25
"""Error of a channel, in [0, 1], that has the brightest colour in a map of errors."""


def draw_mode(
    completed: CompletedView, mode: str, background: str = BLACK, extra: Mapping[str, Tensor] | None = None
) -> Image:
    """Draw one of the protocol's modes as 8-bit RGB on a background (hexadecimal RGB).

    rendered: F. holes: F with the pixels that no camera colours in pink, whatever the error rule.
    completed: Fhat. depth: from red (near) to blue, over `depth_range`. error: from black to yellow
    (`LARGE_ERROR`). coverage: the colours of the source views, missing pixels in pink. confidence:
    from violet (low) to yellow (high); grey where the inpainter does not predict it, or has not
    yet. The others: as in `RenderResult.extra`.
    """
    own = (extra or {})[mode] if mode in EXTRA_MODES else None
    if mode == "error" and own is not None:
        return heat_map(own[0] / LARGE_ERROR, "inferno")
    image = _draw_on_black(completed, mode) if own is None else _to_8bit(own[:3])
    if background == BLACK:
        return image
    if mode == "depth":
        opacity = (completed.view.cut_depth > 0).float()
    elif mode in COMPLETED_MODES:
        opacity = completed.opacity
    else:
        opacity = completed.view.mask if own is None else own[3]
    transparency = (1 - opacity.clamp(0, 1)).cpu().numpy()
    channels = [np.rint(transparency * level).astype(np.uint8) for level in bytes.fromhex(background)]
    return cv2.add(image, cv2.merge(channels))


def _draw_on_black(completed: CompletedView, mode: str) -> Image:
    view = completed.view
    if mode == "completed":
        return _to_8bit(completed.rgb)
    if mode == "confidence":
        grey = completed.rgb.mean(0).expand(3, -1, -1)
        if completed.confidence is None:
            return _to_8bit(grey)
        heat = (
            torch.from_numpy(heat_map(completed.confidence, "viridis")).movedim(-1, 0).to(completed.rgb) / 255
        )
        return _to_8bit(torch.where(view.refine_mask, heat * completed.opacity, grey))
    if mode == "depth":
        depth = view.cut_depth
        near, far = depth_range(depth)
        colours = heat_map((far - depth) / max(far - near, 1e-6), "turbo")
        return colours * (depth > 0).cpu().numpy()[..., None]
    base = _draw_coverage(view) if mode == "coverage" else view.rgb
    if mode == "rendered":
        return _to_8bit(base)
    pink = torch.tensor(HOLE, device=base.device)[:, None, None]
    return _to_8bit(torch.lerp(base, pink.expand_as(base), view.holes.to(base)))


def surface_depth(completed: CompletedView) -> Float[Tensor, "height width"]:
    """Depth in metres, 0 for background, on soft outlines that of the surface; the proxy's if no depth is predicted."""
    if completed.depth is None:
        return completed.surface_depth
    return torch.where(completed.opacity > FAINT, rim_depth(completed.depth), 0.0)


def mean_confidence(completed: CompletedView) -> float | None:
    """Mean confidence of the predicted pixels, weighted by their opacity; None if there are none."""
    weight = completed.opacity * completed.view.refine_mask
    total = float(weight.sum())
    if completed.confidence is None or total == 0:
        return None
    return round(float((completed.confidence * weight).sum()) / total, 4)


def depth_range(depth: Float[Tensor, "height width"]) -> tuple[float, float]:
    """The smallest and the largest depth of the surface, metres; 0 without one."""
    surface = depth[depth > 0]
    near, far = surface.aminmax() if surface.numel() else (torch.zeros(()), torch.zeros(()))
    return float(near), float(far)


def heat_map(values: Float[Tensor, "height width"], colours: str) -> Image:
    """Values in [0, 1] in one of OpenCV's colour maps."""
    levels = (values.clamp(0, 1) * 255).round().byte().cpu().numpy()
    return cv2.applyColorMap(levels, getattr(cv2, f"COLORMAP_{colours.upper()}"))[..., ::-1].copy()


def _draw_coverage(view: IncompleteView) -> Float[Tensor, "3 height width"]:
    """The colours of the source views, mixed by their blending weights and shaded by the image's brightness."""
    colours = [COLOURS[n % len(COLOURS)] for n in range(len(view.source_views))]
    mixed = torch.einsum("chw,cr->rhw", view.weights, torch.tensor(colours, device=view.rgb.device) / 255)
    return mixed * (0.45 + 0.55 * view.rgb.mean(0))


def _to_8bit(rgb: Float[Tensor, "3 height width"]) -> Image:
    return (rgb.clamp(0, 1) * 255).round().byte().movedim(0, -1).contiguous().cpu().numpy()


def to_jpeg(image: Image, quality: int) -> bytes:
    """Encode as JPEG; without chroma subsampling from quality 90, to keep coloured edges."""
    options = [cv2.IMWRITE_JPEG_QUALITY, quality]
    if quality >= 90:
        options += [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    done, data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), options)
    assert done, "8-bit images can be encoded"
    return data.tobytes()


def from_jpeg(data: bytes) -> Image:
    """Decode a JPEG as RGB."""
    return np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR_RGB), np.uint8)


@dataclass(frozen=True)
class PackedDepth:
    """Depth in the protocol's form."""

    data: bytes
    width: int
    height: int
    stride: int
    """Image pixels per depth pixel, horizontally and vertically."""
    near_m: float
    far_m: float


def pack_depth(depth: Float[Tensor, "height width"], stride: int) -> PackedDepth:
    """Pack every `stride`-th pixel: inverse depth in 16 bits, horizontal differences, zlib."""
    height, width = depth.shape
    rows = (torch.arange(-(-height // stride)) * stride + stride // 2).clamp(max=height - 1)
    columns = (torch.arange(-(-width // stride)) * stride + stride // 2).clamp(max=width - 1)
    z = depth[rows.to(depth.device)[:, None], columns.to(depth.device)].double().cpu().numpy()
    surface = z > 0
    near, far = (float(z[surface].min()), float(z[surface].max())) if surface.any() else (1.0, 2.0)
    far = max(far, near * 1.001)
    inverse = 1 / np.where(surface, z, near)
    steps = 1 + np.rint(65534 * (inverse - 1 / far) / (1 / near - 1 / far))
    q = np.where(surface, steps, 0).astype(np.uint16)
    deltas = np.diff(q, axis=1, prepend=np.uint16(0))
    return PackedDepth(zlib.compress(deltas.tobytes(), 1), len(columns), len(rows), stride, near, far)


def _depth_stride(longest_px: int) -> int:
    """Image pixels per depth pixel, for an image whose longer side is this long."""
    return next((stride for limit_px, stride in DEPTH_STRIDES if longest_px <= limit_px), COARSEST_STRIDE)


def unpack_depth(packed: PackedDepth) -> Float[np.ndarray, "height width"]:
    """Depth in metres, 0 for background: the inverse of `pack_depth`."""
    deltas: UInt16[np.ndarray, "height width"] = np.frombuffer(zlib.decompress(packed.data), np.uint16)
    q = np.add.accumulate(deltas.reshape(packed.height, packed.width), axis=1, dtype=np.uint16)
    inverse = 1 / packed.far_m + (q.astype(float) - 1) / 65534 * (1 / packed.near_m - 1 / packed.far_m)
    return np.where(q > 0, 1 / inverse, 0.0)


class Encoders:
    """Encodes one viewer's images; keeps a video stream per eye and mode."""

    def __init__(self) -> None:
        self._streams: dict[tuple[int, str], VideoStream] = {}
        self.key_frame = False
        """Whether the next frame starts all streams again."""

    def encode(self, image: Image, eye: int, mode: str, look: Look) -> tuple[dict[str, Any], bytes]:
        """Encode an image; returns its entry in the header, and its data."""
        part: dict[str, Any] = {"kind": "image", "eye": eye, "mode": mode, "codec": look.codec}
        if look.codec == "jpeg":
            data = to_jpeg(image, look.quality)
        else:
            stream = self._streams.setdefault((eye, mode), VideoStream())
            data, part["key"] = stream.encode(image, look.codec, self.key_frame)
            part["codec_string"] = STRINGS[look.codec]
        return part | {"bytes": len(data)}, data


@one_thread()
def encode_frame(
    look: Look,
    request: RenderRequest,
    result: RenderResult,
    encoders: Encoders,
    wait_ms: float,
    **fields: Any,
) -> tuple[bytes, FrameTimes]:
    """Build the message of a frame, with more `fields` in its header; returns it with the times of all stages."""
    start = time.perf_counter()
    parts = []
    data = []
    for eye, (completed, extra) in enumerate(result.eyes):
        for mode in look.modes:
            image = draw_mode(completed, mode, look.background or result.background, extra)
            part, encoded = encoders.encode(image, eye, mode, look)
            parts.append(part)
            data.append(encoded)
        if look.depth:
            only_completed = COMPLETED_MODES.issuperset(look.modes)
            depth = surface_depth(completed) if only_completed else completed.view.depth
            packed = asdict(pack_depth(depth, _depth_stride(max(depth.shape))))
            data.append(packed.pop("data"))
            parts.append(
                {"kind": "depth", "eye": eye, "bytes": len(data[-1]), "encoding": "u16-delta-zlib", **packed}
            )
    encode_ms = 1000 * (time.perf_counter() - start)
    times = FrameTimes(encode=encode_ms, wait=wait_ms) + result.times
    first = result.completed[0].view
    header: dict[str, Any] = {
        "look": look.id,
        "sent_ms": look.sent_ms,
        "time": result.time,
        "width": first.mask.shape[1],
        "height": first.mask.shape[0],
        "cameras": [
            {k: c[k] for k in ("K", "R", "T")} for v in result.completed for c in cameras_json(v.view.camera)
        ],
        "source_views": list(first.source_views),
        "input_views": list(result.input_views or first.source_views),
        "colours": [COLOURS[n % len(COLOURS)] for n in range(len(first.source_views))],
        "holes": round(float(first.holes.sum()) / max(1.0, float((first.mask > 0).sum())), 5),
        "confidence": mean_confidence(result.completed[0]),
        "depth_m": [round(value, 3) for value in depth_range(first.cut_depth)],
        "top_k": request.quality.top_k,
        "context_times": request.quality.context_times,
        "refine_fraction": request.quality.refine_fraction,
        "stage_ms": times.as_json(),
        "parts": parts,
    }
    return pack(fields | header, data), times
