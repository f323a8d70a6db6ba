"""Compares the masks of one frame across cameras: which agree, and where others must look."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32, Int32, UInt8
from torch import Tensor

from viewmend.data.source import scale_cameras
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras
from viewmend.geometry.hull import FOREGROUND, HullConfig
from viewmend.geometry.proxy import reconstruct
from viewmend.preprocess.masks.maker import Inside, Mask, Rgb

Masks = UInt8[Tensor, "view height width"]
Silhouettes = Bool[Tensor, "view height width"]
Shares = Float32[np.ndarray, "chosen"]
MaskNear = Callable[[Rgb, Inside], Mask | None]
"""Makes the mask of an image whose subject lies in a silhouette; None if it finds none there."""

CARVED_PX = 480
"""Silhouettes are compared in images of this longer side."""
MARGIN_PX = 4
"""Dilation of silhouettes and hulls, for inexact calibration and voxels."""
HULL = HullConfig(resolution=64)
"""Hulls of a frame's masks have this resolution when masks are compared."""
MIN_SUPPORT = 0.2
"""Least share of a connected part that must lie in the hull of the other cameras."""
SPECK = 0.02
"""Parts that together have at most this share of a mask are specks, whose loss is not reported."""
LARGE_PART = 0.3
"""Parts of a mask count as large from this share of the largest part on."""
NOT_FOUND = "nothing found where the other cameras see the subject"
"""Why a camera has no mask: it was looked for where the hull of the others is."""
NO_HULL = "nothing found, and the masks of the other cameras do not show where the subject is"
"""Why a camera has no mask: there is no hull to look for it in."""


@dataclass(frozen=True)
class AgreementThresholds:
    """The rules by which masks agree, by the share of each that their hull covers, and new ones fit."""

    good: float = 0.8
    """Masks agree without further search if the hull covers this share of each."""
    least: float = 0.5
    """Masks agree if the hull covers this share of each."""
    gain: float = 0.05
    """A camera is left out of the hull if the mean share then rises by this much."""
    fewest_left: int = 3
    """A camera is left out of the hull only if at least this many remain: of two, neither is
    right."""
    cameras: float = 1 / 3
    """Masks are made from others only if at least this share of the cameras agree."""
    visible: float = 5e-4
    """The subject is out of view of a camera where the others' hull covers a smaller share of the
    image."""
    inside: float = 0.6
    """Share of a new mask that must lie in the hull of the others."""
    covered: float = 0.25
    """Share of the others' hull that a new mask must cover; hulls of few cameras are much larger
    than the subject."""


@dataclass(frozen=True)
class Settled:
    """The masks of one frame after comparison."""

    mask: Masks
    without: Mapping[str, str] = field(default_factory=dict)
    """Cameras that should see the subject and have no mask of it, and why: `NOT_FOUND` or
    `NO_HULL`."""
    remade: frozenset[str] = frozenset()
    """Cameras whose masks were made where the other cameras expect the subject."""
    kept_at: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    """Cameras in whose masks parts were dropped that other cameras do not support: where the rest
    lies, pixels."""
    several: bool = False
    """Whether at least half of the masks that agree have several large parts, such as several
    people."""


def settle_masks(
    mask: Masks, images: Sequence[Rgb], cameras: Cameras, bounds: Bounds | None, mask_near: MaskNear | None
) -> Settled:
    """Compare the masks of one frame, drop unsupported parts, and make the masks that are missing.

    Args:
        mask: masks of all cameras, padded at the right and bottom.
        images: the cameras' images, without padding.
        cameras: the cameras.
        bounds: the volume that contains the subject; None if unknown.
        mask_near: makes masks that are missing, or disagree with all others; None leaves such
            cameras without a mask.
    """
    small, small_cameras = reduced(mask, cameras)
    present = [view for view in range(len(cameras)) if bool((small[view] > FOREGROUND).any())]
    if not present:
        return Settled(mask)
    unplaced = {name: NO_HULL for view, name in enumerate(cameras.names) if view not in present}
    if len(present) == 1:
        return Settled(mask, unplaced)
    trusted, silhouettes = _agreeing(small, small_cameras, bounds, present)
    if silhouettes is None or len(trusted) < AgreementThresholds().cameras * len(cameras):
        return Settled(mask, unplaced)
    settled = mask.clone()
    kept_at = {}
    parts = []
    for view in trusted:
        own = cut(mask, cameras, view)
        kept = supported_parts(own, _enlarged(silhouettes[view], small_cameras, cameras, view))
        parts.append(_count_large_parts(kept))
        if _is_smaller(kept, own):
            kept_at[cameras.names[view]] = _center_px(kept)
        put(settled, view, kept)
    without = {}
    remade = set()
    for view in set(range(len(cameras))) - set(trusted):
        expected = _enlarged(silhouettes[view], small_cameras, cameras, view)
        found = _mask_expected(images[view], expected, mask_near)
        if found is None:
            without[cameras.names[view]] = NOT_FOUND
        elif found.any():
            remade.add(cameras.names[view])
        put(settled, view, np.zeros(expected.shape, np.uint8) if found is None else found)
    several = 2 * sum(count > 1 for count in parts) >= len(parts)
    return Settled(settled, without, frozenset(remade), kept_at, several)


def _mask_expected(image: Rgb, expected: Inside, mask_near: MaskNear | None) -> Mask | None:
    """The mask where others expect the subject: empty if that is out of view, None if none fits."""
    thresholds = AgreementThresholds()
    if expected.mean() < thresholds.visible:
        return np.zeros(expected.shape, np.uint8)
    found = None if mask_near is None else mask_near(image, expected)
    if found is None:
        return None
    found = supported_parts(found, expected)
    own = found > FOREGROUND
    both = float((own & expected).sum())
    fits = both >= thresholds.inside * float(own.sum()) and both >= thresholds.covered * float(expected.sum())
    return found if fits else None


def _agreeing(
    small: Masks, cameras: Cameras, bounds: Bounds | None, present: list[int]
) -> tuple[list[int], Silhouettes | None]:
    """The cameras whose masks agree, if any, and the silhouettes of their hull in all cameras.

    While masks disagree, the camera without which the others agree best is left out of the hull.
    """
    thresholds = AgreementThresholds()
    chosen = present
    silhouettes = _silhouettes(small, cameras, bounds, chosen)
    covered = _covered(small, silhouettes, chosen)
    while covered.min() < thresholds.good and len(chosen) > thresholds.fewest_left:
        tried = []
        for view in chosen:
            rest = [other for other in chosen if other != view]
            own = _silhouettes(small, cameras, bounds, rest)
            tried.append((_covered(small, own, rest), rest, own))
        best, rest, own = max(tried, key=lambda one: float(one[0].mean()))
        if best.mean() < covered.mean() + thresholds.gain:
            break
        covered = best
        chosen = rest
        silhouettes = own
    return (chosen, silhouettes) if covered.min() >= thresholds.least else ([], None)


def _silhouettes(small: Masks, cameras: Cameras, bounds: Bounds | None, views: list[int]) -> Silhouettes:
    """The silhouettes, in all cameras, of the hull of some of them; empty without a hull."""
    return silhouettes_of(small[views], cameras[views], bounds, cameras, HULL)


def silhouettes_of(
    mask: Masks, cameras: Cameras, bounds: Bounds | None, targets: Cameras, config: HullConfig
) -> Bool[Tensor, "target rows columns"]:
    """The silhouettes, in the targets, of the hull of masks; empty if the cameras look at no common place."""
    try:
        return reconstruct(mask, cameras, bounds, config).depth(targets) > 0
    except ValueError:
        width, height = targets.max_size_px
        return torch.zeros(len(targets), height, width, dtype=torch.bool)


def _covered(small: Masks, silhouettes: Silhouettes, views: list[int]) -> Shares:
    """The share of each of these masks that the silhouettes cover, without unsupported parts."""
    shares = []
    for view in views:
        own = small[view].numpy()
        inside = silhouettes[view].numpy()
        kept = supported_parts(own, inside)
        shares.append(float(kept[inside].sum(dtype=float)) / max(float(kept.sum(dtype=float)), 1.0))
    return np.array(shares, np.float32)


def supported_parts(own: Mask, supported: Inside) -> Mask:
    """The mask without connected parts that are hardly supported; unchanged if none is."""
    count, found = cv2.connectedComponents((own > 0).astype(np.uint8), connectivity=8)
    if count <= 2:
        return own
    labels: Int32[np.ndarray, "height width"] = np.asarray(found, np.int32)
    weight = np.bincount(labels.ravel(), own.ravel(), count)
    share = np.bincount(labels.ravel(), (own * supported).ravel(), count) / np.maximum(weight, 1)
    if not bool((share[1:] >= MIN_SUPPORT).any()):
        return own
    return np.where((share >= MIN_SUPPORT)[labels], own, 0).astype(np.uint8)


def _is_smaller(kept: Mask, own: Mask) -> bool:
    """Whether a mask has clearly lost something; specks do not count."""
    return float((kept > FOREGROUND).sum()) < (1 - SPECK) * float((own > FOREGROUND).sum())


def _count_large_parts(own: Mask) -> int:
    """The number of connected parts that are not much smaller than the largest."""
    inside = (own > FOREGROUND).astype(np.uint8)
    _, _, stats, _ = cv2.connectedComponentsWithStats(inside, connectivity=8)
    areas = np.asarray(stats)[1:, cv2.CC_STAT_AREA]
    return int((areas >= LARGE_PART * areas.max(initial=1)).sum())


def _center_px(own: Mask) -> tuple[int, int]:
    """The mean position of the foreground, x and y."""
    rows, columns = np.nonzero(own > FOREGROUND)
    return round(float(columns.mean())), round(float(rows.mean()))


def reduced(mask: Masks, cameras: Cameras) -> tuple[UInt8[Tensor, "view small_height small_width"], Cameras]:
    """Masks and cameras at the size that they are compared in, silhouettes widened."""
    small = scale_cameras(cameras, min(1.0, CARVED_PX / int(cameras.size_px.max())))
    width, height = small.max_size_px
    masks = torch.zeros(len(mask), height, width, dtype=torch.uint8)
    for view, size_px in enumerate(small.size_px.tolist()):
        own = np.asarray(cv2.resize(cut(mask, cameras, view), size_px, interpolation=cv2.INTER_AREA))
        put(masks, view, 255 * widened(own > FOREGROUND).astype(np.uint8))
    return masks, small


def _enlarged(
    silhouette: Bool[Tensor, "height width"], small: Cameras, cameras: Cameras, view: int
) -> Inside:
    """A silhouette in a reduced camera, widened, at the size of the camera's image."""
    width, height = small.size_px[view].tolist()
    size_px = cameras.size_px[view].tolist()
    inside = widened(silhouette[:height, :width].numpy()).astype(np.float32)
    return np.asarray(cv2.resize(inside, size_px)) > 0.5


def widened(inside: Inside) -> Inside:
    """A silhouette with a margin of `MARGIN_PX`."""
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * MARGIN_PX + 1, 2 * MARGIN_PX + 1))
    return np.asarray(cv2.dilate(inside.astype(np.uint8), disc)) > 0


def cut(mask: Masks, cameras: Cameras, view: int) -> UInt8[np.ndarray, "rows columns"]:
    """One camera's mask without its padding."""
    width, height = (int(side) for side in cameras.size_px[view])
    return mask[view, :height, :width].numpy()


def put(mask: Masks, view: int, own: UInt8[np.ndarray, "rows columns"]) -> None:
    """Write one camera's mask into the padded masks of all."""
    mask[view, : own.shape[0], : own.shape[1]] = torch.from_numpy(own)
