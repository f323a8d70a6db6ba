"""What is sent of a view: pictures of several kinds, JPEG, and depth for re-projection."""

import zlib
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt8, UInt16
from torch import Tensor

from viewmend.inpainting.sweep.cells import rim_depth
from viewmend.live.protocol import BLACK, HULL_MODES, MENDED_MODES
from viewmend.views import FAINT, CompletedView, IncompleteView

Picture = UInt8[np.ndarray, "height width 3"]
HOLE = (1.0, 0.15, 0.55)
"""What marks missing pixels: no cloth nor skin is of that pink."""
COLOURS = ((230, 120, 60), (70, 150, 230), (120, 200, 90), (200, 110, 210), (235, 200, 70), (90, 205, 200))
"""Colours of the first, second, ... source view in `coverage`."""
DEPTH_STRIDES = ((160, 1), (400, 2))
"""Pairs (longest side, stride): image pixels a depth pixel, both ways, for pictures at most so long."""
COARSEST_STRIDE = 4
"""Image pixels a depth pixel in longer pictures."""


def picture(
    completed: CompletedView, mode: str, background: str = BLACK, hulls: Mapping[str, Tensor] | None = None
) -> Picture:
    """One of the protocol's modes as 8-bit RGB, on a background (hexadecimal RGB).

    rendered: F. holes: F with the pixels that no camera colours in pink, by any error rule. mended: Fhat. depth: near
    is bright. coverage: which camera coloured what, missing pixels pink. confidence: from violet, a guess, to
    yellow, sure; grey where the inpainter does not tell. hull and points: as `hulls` has them (`RenderResult.hulls`).
    """
    hull = (hulls or {})[mode] if mode in HULL_MODES else None
    shown = _on_black(completed, mode) if hull is None else _eight_bit(hull[:3])
    if background == BLACK:
        return shown
    import cv2

    opacity = completed.opacity if mode in MENDED_MODES else completed.view.mask if hull is None else hull[3]
    bare = (1 - opacity.clamp(0, 1)).cpu().numpy()
    colour = bytes.fromhex(background)
    return cv2.add(shown, cv2.merge([np.rint(bare * level).astype(np.uint8) for level in colour]))


def _on_black(completed: CompletedView, mode: str) -> Picture:
    view = completed.view
    if mode == "mended":
        return _eight_bit(completed.rgb)
    if mode == "confidence":
        return _confidence(completed)
    if mode == "depth":
        return _eight_bit(_shade(view.depth).expand(3, -1, -1))
    base = _coverage(view) if mode == "coverage" else view.rgb
    if mode == "rendered":
        return _eight_bit(base)
    pink = torch.tensor(HOLE, device=base.device)[:, None, None]
    return _eight_bit(torch.lerp(base, pink.expand_as(base), view.holes.to(base)))


def surface_depth(completed: CompletedView) -> Float[Tensor, "height width"]:
    """Depth of what the mended picture shows, metres, 0 elsewhere; the proxy's where the inpainter tells none.

    Soft outlines lie on the surface beside them.
    """
    if completed.depth is None:
        return completed.view.depth
    return torch.where(completed.opacity > FAINT, rim_depth(completed.depth), 0.0)


def mean_confidence(completed: CompletedView) -> float | None:
    """The mean confidence of the subject's pixels; None where the inpainter does not tell."""
    if completed.confidence is None:
        return None
    return round(float((completed.confidence * completed.opacity).sum() / completed.opacity.sum().clamp(min=1)), 4)


def _confidence(completed: CompletedView) -> Picture:
    import cv2

    if completed.confidence is None:
        return _eight_bit(completed.rgb.mean(0).expand(3, -1, -1))
    told = (completed.confidence.clamp(0, 1) * 255).round().byte().cpu().numpy()
    heat = torch.from_numpy(cv2.applyColorMap(told, cv2.COLORMAP_VIRIDIS)[..., ::-1].copy())
    return _eight_bit(heat.movedim(-1, 0).to(completed.rgb) / 255 * completed.opacity)


def _coverage(view: IncompleteView) -> Float[Tensor, "3 height width"]:
    """The colours of the source views, mixed by their blending weights, with the picture's own light and dark."""
    palette = (
        torch.tensor([COLOURS[n % len(COLOURS)] for n in range(len(view.source_views))], device=view.rgb.device) / 255
    )
    mixed = torch.einsum("chw,cr->rhw", view.weights, palette)
    return mixed * (0.45 + 0.55 * view.rgb.mean(0))


def _shade(depth: Float[Tensor, "height width"]) -> Float[Tensor, "height width"]:
    surface = depth > 0
    if not bool(surface.any()):
        return torch.zeros_like(depth)
    near, far = depth[surface].aminmax()
    return torch.where(surface, 1 - 0.8 * (depth - near) / (far - near).clamp(min=1e-6), 0.0)


def _eight_bit(rgb: Float[Tensor, "3 height width"]) -> Picture:
    return (rgb.clamp(0, 1) * 255).round().byte().movedim(0, -1).contiguous().cpu().numpy()


def to_jpeg(image: Picture, quality: int) -> bytes:
    """JPEG, 4:4:4 from quality 90 on: coloured edges of cloth."""
    import cv2

    options = [cv2.IMWRITE_JPEG_QUALITY, quality]
    if quality >= 90:
        options += [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    done, data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), options)
    assert done, "images of 8 bit can be encoded"
    return data.tobytes()


def from_jpeg(data: bytes) -> Picture:
    """Inverse of `to_jpeg`, nearly."""
    import cv2

    return np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR_RGB), np.uint8)


@dataclass(frozen=True)
class PackedDepth:
    """Depth as the protocol sends it."""

    data: bytes
    width: int
    height: int
    stride: int
    """Image pixels a depth pixel, both ways."""
    near_m: float
    far_m: float


def depth_stride(height: int, width: int) -> int:
    """Image pixels a depth pixel, both ways: small pictures need fine depth, or their outlines are ragged."""
    return next((stride for longest, stride in DEPTH_STRIDES if max(height, width) <= longest), COARSEST_STRIDE)


def pack_depth(depth: Float[Tensor, "height width"], stride: int) -> PackedDepth:
    """Every `stride`-th pixel: inverse depth in 16 bit, differences along rows, zlib."""
    height, width = depth.shape
    rows = (torch.arange(-(-height // stride)) * stride + stride // 2).clamp(max=height - 1)
    columns = (torch.arange(-(-width // stride)) * stride + stride // 2).clamp(max=width - 1)
    z = depth[rows.to(depth.device)[:, None], columns.to(depth.device)].double().cpu().numpy()
    surface = z > 0
    near, far = (float(z[surface].min()), float(z[surface].max())) if surface.any() else (1.0, 2.0)
    far = max(far, near * 1.001)
    inverse = 1 / np.where(surface, z, near)
    q = np.where(surface, 1 + np.rint(65534 * (inverse - 1 / far) / (1 / near - 1 / far)), 0).astype(np.uint16)
    deltas = np.diff(q, axis=1, prepend=np.uint16(0))
    return PackedDepth(zlib.compress(deltas.tobytes(), 1), len(columns), len(rows), stride, near, far)


def unpack_depth(packed: PackedDepth) -> Float[np.ndarray, "height width"]:
    """Inverse of `pack_depth`, metres; 0 where there is no surface."""
    deltas: UInt16[np.ndarray, "height width"] = np.frombuffer(zlib.decompress(packed.data), np.uint16)
    q = np.add.accumulate(deltas.reshape(packed.height, packed.width), axis=1, dtype=np.uint16)
    inverse = 1 / packed.far_m + (q.astype(float) - 1) / 65534 * (1 / packed.near_m - 1 / packed.far_m)
    return np.where(q > 0, 1 / inverse, 0.0)
