"""Finds a camera that is inconsistent with the others: in its masks, its pose, or its timing.

Each test leaves cameras out in turn and looks at how well the others agree.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from torch.nn import functional as F

from viewmend.data.errors import Issue
from viewmend.data.resize import limit_size
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.hull import FOREGROUND, HullConfig
from viewmend.geometry.line_of_sight import LinesOfSight, Rig
from viewmend.geometry.proxy import reconstruct
from viewmend.types import MultiViewFrame

HULL = HullConfig(resolution=64)

LONGEST_PX = 256
"""Size of the images on which hulls are compared."""
MIN_CAMERAS = 4
"""With fewer cameras the faulty one cannot be determined."""
MAX_PEERS = 10
"""Number of other cameras in which the effect of a camera on the hull is measured."""
MAX_REMOVED, LEAVE_OUT_REMOVED = 0.004, 0.06
"""A camera is an outlier if it alone removes this share of the others' masks, beyond 1.5 times the mean. From the
larger share on it is left out: a smaller error costs less than a missing camera."""
MAX_OUTSIDE, LEAVE_OUT_OUTSIDE = 0.15, 0.3
"""It is also one if this share of its mask is outside the others' hull, beyond 3 times the median."""

MAX_DELAY = 4
"""Largest delay that is searched, in frames."""
MIN_DELAY_GAIN = 0.008
"""A camera may be delayed if the share of its mask outside the others' hull is this much lower in another frame."""
MAX_DELAY_CANDIDATES = 3
"""The camera opposite a delayed one looks delayed too, so several are tried."""
MIN_EXPLAINED = 0.002
"""A camera is delayed if its mask of another frame lets the hull explain this much more of all masks."""
SHARPER = 1.015
"""Images are delayed if those of another frame have this much stronger edges along the outlines of the masks."""
MIN_OUTLINE_FRAMES = 3
"""Edges are compared by the median of this many frames or more, since one frame may be damaged."""

OUTLINE_LONGEST_PX = 384
"""Size of the images whose outlines are compared."""
OUTLINE_POINTS, MAX_OUTLINE_POINTS = 40, 400
"""Maximum number of points per outline, and in total."""
BOX_MARGIN = 1.5
"""Growth of the search box over that of the hull, which a faulty camera reduces."""
MIN_OUTLINE_CAMERAS = 5
"""With fewer, the outlines of the remaining cameras always agree too well."""
MIN_RESIDUAL_PX = 0.2
"""Outlines with a smaller residual agree: in clean rigs of 128 to 256 pixels it is up to 0.16."""
RESOLUTION_PX = 0.01
"""Smaller residuals are not distinguished."""
SUSPECT_RATIO, MAX_SUSPECTS = 1.25, 3
"""Cameras are suspects if the residual of their own outline is this many times the median; this many are tried."""
MAX_LEFT = 0.5
"""A suspect is the outlier if at most this share of the residual is left without it."""
MAX_LEFT_ROUGH, MIN_LEFT_OTHERS, ROUGH_PX = 0.67, 1.25, 0.4
"""In rigs with at least the last residual: at most the first share, if leaving out any other suspect leaves the second
number of times more."""
AMBIGUOUS = 0.7
"""The second suspect is named too if the ratio of the best residual to its own is higher."""


@dataclass(frozen=True)
class LeaveOneOut:
    """Each camera compared with the hull of all others. That hull contains the subject, so it contains good masks."""

    silhouettes: Bool[Tensor, "view height width"]
    """Silhouette of the others' hull in each camera."""
    removed: Float[Tensor, "view"]
    """The share of the others' masks that this camera alone removes from the hull."""
    outside: Float[Tensor, "view"]
    """The share of its own mask that lies outside the others' hull."""


def leave_one_out(frame: MultiViewFrame, bounds: Bounds | None) -> LeaveOneOut | None:
    """Compute a small hull without each camera in turn; None if too few cameras have any foreground.

    The images should be small (`LONGEST_PX`).
    """
    names, mask = frame.cameras.names, frame.mask
    if mask is None or len(names) < MIN_CAMERAS:
        return None
    inside, step = mask > FOREGROUND, max(1, -(-len(names) // MAX_PEERS))
    try:
        missed = _missed(inside, reconstruct(mask, frame.cameras, bounds, HULL).depth(frame.cameras) > 0)
        silhouettes, removed = [], []
        for view, name in enumerate(names):
            others, peers = frame.without([name]), [v for v in range(0, len(names), step) if v != view]
            assert others.mask is not None
            proxy = reconstruct(others.mask, others.cameras, bounds, HULL)
            covered = _pad_like(proxy.depth(frame.cameras[[view, *peers]]) > 0, mask)
            removed.append((missed[peers] - _missed(inside[peers], covered[1:])).nanmean())
            silhouettes.append(covered[0])
    except ValueError:  # without this camera, nothing is in front of all others
        return None
    covered = torch.stack(silhouettes)
    return LeaveOneOut(covered, torch.stack(removed).nan_to_num(0.0), _missed(inside, covered).nan_to_num(0.0))


def _missed(
    inside: Bool[Tensor, "view height width"], covered: Bool[Tensor, "view height width"]
) -> Float[Tensor, "view"]:
    """The share of each mask that a silhouette does not cover; NaN for an empty mask."""
    return (inside & ~covered).sum((1, 2)) / inside.sum((1, 2))


def _pad_like(
    covered: Bool[Tensor, "view _height _width"], mask: UInt8[Tensor, "_view height width"]
) -> Bool[Tensor, "view height width"]:
    return F.pad(covered, (0, mask.shape[2] - covered.shape[2], 0, mask.shape[1] - covered.shape[1]))


def find_outlier_by_hull(frame: MultiViewFrame, bounds: Bounds | None) -> tuple[Issue, ...]:
    """Find a camera whose mask is much larger than the others' hull, or removes what all others see."""
    small = limit_size(frame, LONGEST_PX)
    found = leave_one_out(small, bounds)
    if found is None:
        return ()
    names = small.cameras.names
    view = int(found.outside.argmax())
    share = float(found.outside[view])
    if share > MAX_OUTSIDE + 3 * float(found.outside.median()):
        text = f"camera '{names[view]}': {100 * share:.0f} % of its mask is outside the hull of all others"
        return (_outlier(text, names[view], share > LEAVE_OUT_OUTSIDE),)
    view = int(found.removed.argmax())
    share = float(found.removed[view])
    typical = max(0.0, float((found.removed.sum() - found.removed[view]) / (len(names) - 1)))
    if share > MAX_REMOVED + 1.5 * typical:
        text = f"camera '{names[view]}' alone removes {100 * share:.1f} % of the subject that the others see"
        return (_outlier(text, names[view], share > LEAVE_OUT_REMOVED),)
    return ()


def _outlier(text: str, camera: str, leave_out: bool) -> Issue:
    advice = "check its mask, its calibration and its synchronisation"
    if leave_out:
        return Issue(f"{text}, so it is left out; {advice}", camera=camera, always=True)
    return Issue(f"{text}; {advice}")


def find_desynchronised_camera(
    frames: Sequence[MultiViewFrame], middle: int, bounds: Bounds | None
) -> tuple[Issue, ...]:
    """Find the camera whose mask of another frame fits the others' masks of `frames[middle]` best.

    If the masks are in sync, looks for images that are out of sync with their own masks.

    Args:
        frames: consecutive frames.
        middle: index of the frame to check.
        bounds: the bounds of the capture.
    """
    small = [limit_size(frame, LONGEST_PX) for frame in frames]
    names = [name for name in small[middle].cameras.names if all(name in frame.cameras.names for frame in small)]
    small = [frame.select(names) for frame in small]
    found = leave_one_out(small[middle], bounds)
    if found is None or len(frames) < 2:
        return ()
    outside = torch.stack(
        [_missed(frame.mask > FOREGROUND, found.silhouettes) for frame in small if frame.mask is not None]
    ).nan_to_num(1.0)
    gain, best = outside[middle] - outside.amin(0), outside.argmin(0).tolist()
    views = gain.argsort(descending=True)[:MAX_DELAY_CANDIDATES].tolist()
    unexplained = {
        view: _unexplained(_with_mask_of(small, middle, view, best[view]), bounds)
        for view in views
        if float(gain[view]) > MIN_DELAY_GAIN
    }
    if unexplained:
        view = min(unexplained, key=lambda view: unexplained[view])
        if unexplained[view] < _unexplained(small[middle], bounds) - MIN_EXPLAINED:
            delay = describe_delay(best[view] - middle)
            return (
                Issue(f"camera '{names[view]}': {delay}, compared with the others' masks; shift its files in time"),
            )
    return check_image_mask_sync(small)


def _with_mask_of(frames: Sequence[MultiViewFrame], middle: int, view: int, time: int) -> MultiViewFrame:
    """The frame in the middle, with one camera's mask from another frame."""
    frame, other = frames[middle], frames[time]
    assert frame.mask is not None and other.mask is not None
    mask = frame.mask.clone()
    mask[view] = other.mask[view]
    return replace(frame, mask=mask)


def _unexplained(frame: MultiViewFrame, bounds: Bounds | None) -> float:
    """The share of the masks that the hull does not cover, mean of all cameras."""
    assert frame.mask is not None
    try:
        covered = reconstruct(frame.mask, frame.cameras, bounds, HULL).depth(frame.cameras) > 0
    except ValueError:
        return 1.0
    return float(_missed(frame.mask > FOREGROUND, _pad_like(covered, frame.mask)).nanmean().nan_to_num(1.0))


def describe_delay(frames: int) -> str:
    """A delay of a camera by this number of frames, in words."""
    return f"{'late' if frames > 0 else 'early'} by about {abs(frames)} frame{'s' if abs(frames) > 1 else ''}"


def check_image_mask_sync(frames: Sequence[MultiViewFrame]) -> tuple[Issue, ...]:
    """Find cameras whose images have stronger edges along the outlines of their own masks in another frame.

    `frames` are consecutive, of the same cameras, and should be small.
    """
    if any(frame.mask is None for frame in frames):
        return ()
    masks = [frame.mask for frame in frames if frame.mask is not None]
    edges = torch.stack([_gradient(frame.rgb.float()) for frame in frames])
    outlines = torch.stack([_gradient((mask > FOREGROUND).float()[:, None]) for mask in masks])
    outlines = F.normalize(outlines, dim=3)  # unit normals of the outline; 0 elsewhere
    reach = min(len(frames) // 2, len(frames) - MIN_OUTLINE_FRAMES)
    delays = [delay for delay in range(-reach, reach + 1) if delay]
    if not delays:
        return ()
    ratios = torch.stack([_edge_ratio(edges, outlines, delay) for delay in delays])
    text = "the images of camera '{}': {} compared with its masks; shift its images or its masks in time"
    return tuple(
        Issue(text.format(name, describe_delay(delays[int(own.argmax())])))
        for name, own in zip(frames[0].cameras.names, ratios.unbind(1), strict=True)
        if float(own.max()) > SHARPER
    )


def _gradient(image: Float[Tensor, "view channel height width"]) -> Float[Tensor, "view channel 2 height width"]:
    """Central differences in x and y."""
    padded = F.pad(image, (1, 1, 1, 1), mode="replicate")
    return torch.stack(
        [padded[..., 1:-1, 2:] - padded[..., 1:-1, :-2], padded[..., 2:, 1:-1] - padded[..., :-2, 1:-1]], 2
    )


def _edge_ratio(
    edges: Float[Tensor, "time view channel 2 height width"],
    outlines: Float[Tensor, "time view 1 2 height width"],
    delay: int,
) -> Float[Tensor, "view"]:
    """Strength of the edges across an outline in the image `delay` frames later, relative to its own; the median."""
    first, count = max(0, -delay), len(edges) - abs(delay)
    own, shifted = (edges[start : start + count] for start in (first, first + delay))
    normals = outlines[first : first + count]
    later, now = ((image * normals).sum(3).abs().sum((2, 3, 4)) for image in (shifted, own))
    return (later / now.clamp(min=1.0)).median(0).values


def find_outlier_by_outlines(frame: MultiViewFrame, bounds: Bounds | None) -> tuple[tuple[str, ...], float] | None:
    """Find the camera that keeps the outlines from agreeing, and how many times smaller the residual is without it.

    The line of sight through a point of an outline touches the subject, so one of its points lies inside all other
    masks. The residual is how far outside the best point is. This detects pose errors of a few pixels. Two cameras are
    named if it may be either; None if no camera is an outlier.
    """
    names = frame.cameras.names
    small = limit_size(frame, OUTLINE_LONGEST_PX)
    if small.mask is None or len(names) < MIN_OUTLINE_CAMERAS:
        return None
    try:
        box = reconstruct(small.mask, small.cameras, bounds, HULL).bounds
        box = Bounds(box.center - BOX_MARGIN * box.size_m / 2, box.center + BOX_MARGIN * box.size_m / 2)
        residual, own = _outline_residuals_px(small, box)
        order = np.argsort(-own)[:MAX_SUSPECTS].tolist()
        suspects = [view for view in order if own[view] > SUSPECT_RATIO * np.median(own)]
        if residual < MIN_RESIDUAL_PX or not suspects:
            return None
        left = [_outline_residuals_px(small.without([names[view]]), box)[0] for view in suspects]
    except ValueError:  # no hull, or no outlines
        return None
    order = np.argsort(left)
    best = left[order[0]]
    second = left[order[1]] if len(order) > 1 else residual
    rough = residual >= ROUGH_PX and best <= MAX_LEFT_ROUGH * residual and second >= MIN_LEFT_OTHERS * best
    if best > MAX_LEFT * residual and not rough:
        return None
    named = [index for index in order[:2] if best > AMBIGUOUS * left[index] or index == order[0]]
    return tuple(names[suspects[index]] for index in named), residual / max(best, RESOLUTION_PX)


def _outline_residuals_px(frame: MultiViewFrame, box: Bounds) -> tuple[float, np.ndarray]:
    """RMS residual of all outlines, and of each camera's own outline, `(view,)`."""
    assert frame.mask is not None
    points = min(OUTLINE_POINTS, MAX_OUTLINE_POINTS // len(frame.cameras))
    lines = LinesOfSight.from_masks(frame.mask, frame.cameras, box, max(1, points))
    squared = lines.least_residuals(Rig.from_cameras(frame.cameras))
    count = np.bincount(lines.view, minlength=len(frame.cameras))
    own = np.bincount(lines.view, squared, minlength=len(frame.cameras)) / np.maximum(count, 1)
    return float(np.sqrt(squared.mean())), np.sqrt(own)
