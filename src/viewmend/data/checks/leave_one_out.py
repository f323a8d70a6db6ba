"""Finds a camera whose masks or pose do not fit: without it, the others agree better."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from torch.nn import functional as F

from viewmend.data.errors import Issue
from viewmend.data.source import limit_size
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.hull import FOREGROUND, HullConfig, are_cut_off, count_cut_off
from viewmend.geometry.line_of_sight import LinesOfSight, Rig
from viewmend.geometry.proxy import reconstruct
from viewmend.types import MultiViewFrame

HULL = HullConfig(resolution=64)
"""Hulls have this resolution in the first comparison."""
FINE_HULL = HullConfig(resolution=128)
"""Hulls have this resolution in the second comparison, because coarse hulls lose thin parts."""
LONGEST_PX = 256
"""Images of the first comparison have at most this many pixels along their longer side."""
FINE_PX = 384
"""Images of the second comparison have at most this many pixels along their longer side."""
MIN_CAMERAS = 4
"""The faulty camera can be determined in rigs of at least this many cameras."""
MAX_PEERS = 10
"""The effect of a camera on the hull is measured in at most this many other cameras."""
FEW_CAMERAS = 5
"""Smaller rigs than this, and rigs of this many cameras, suffer most from a missing camera."""
OUTLINE_LONGEST_PX = 384
"""Outlines are compared in images of at most this many pixels along their longer side."""
OUTLINE_POINTS = 40
"""Each outline has at most this many points."""
MAX_OUTLINE_POINTS = 400
"""All outlines together have at most about this many points."""
BOX_MARGIN = 1.5
"""The search box is this many times as large as that of the hull, which a faulty camera makes too small."""
MIN_OUTLINE_CAMERAS = 5
"""Outlines are compared in rigs of at least this many cameras: the rest of smaller rigs always
agrees too well."""
WORST_POINTS = 0.01
"""The worst points, this share of all, are not counted: single points miss thin parts in clean rigs,
too."""
MIN_RESIDUAL_PX = 0.16
"""Outlines with a smaller residual, pixels, agree; clean rigs of 8 to 20 cameras stay below it."""
RESOLUTION_PX = 0.01
"""Residuals below this many pixels are not distinguished."""
SUSPECT_RATIO = 1.25
"""A camera is a suspect if the residual of its own outline is more than this many times the median."""
MAX_SUSPECTS = 3
"""The largest number of suspects that are tried."""
MAX_LEFT = 0.5
"""A suspect is the outlier if at most this share of the residual remains without it."""
AMBIGUOUS = 0.7
"""The second suspect is named too if the ratio of the best residual to its own is higher than this."""

Silhouettes = Bool[Tensor, "view height width"]


@dataclass(frozen=True)
class OutlierThresholds:
    """Shares from which a camera that does not fit the hull of the others is an outlier, and is left out.

    A smaller fault costs less than a missing camera, so the second share of each pair is higher.
    """

    removed: float = 0.004
    """An outlier alone removes more than this share of the others' masks, beyond 1.5 times the mean.

    The share is for images of `FINE_PX` or more. It doubles in small images, because those lose thin parts.
    """
    left_out_removed: float = 0.06
    """An outlier that removes more than this share is left out."""
    left_out_removed_of_few: float = 0.2
    """`left_out_removed` in rigs of at most `FEW_CAMERAS` cameras."""
    outside: float = 0.15
    """An outlier has more than this share of its mask outside the others' hull, beyond 3 times the median."""
    left_out_outside: float = 0.3
    """An outlier with more than this share of its mask outside is left out."""


@dataclass(frozen=True)
class RoughRigThresholds:
    """The rule for rigs of rough calibration, in which a large residual remains without the outlier, too."""

    min_residual_px: float = 0.4
    """A rig is rough if its outlines have at least this residual, pixels."""
    max_left: float = 0.67
    """A suspect may be the outlier if at most this share of the residual remains without it."""
    min_left_of_others: float = 1.25
    """Leaving out any other suspect must leave at least this many times the residual that remains
    without it."""


@dataclass(frozen=True)
class OthersHulls:
    """Each camera compared with the hull of all others. That hull contains the subject, so it contains good masks."""

    silhouettes: Silhouettes
    """Silhouette of the others' hull in each camera."""
    removed: Float[Tensor, "view"]
    """The share of the others' masks that this camera alone removes from the hull."""
    outside: Float[Tensor, "view"]
    """The share of its own mask that lies outside the others' hull."""


def leave_one_out(
    frame: MultiViewFrame, bounds: Bounds | None, hull: HullConfig = HULL
) -> OthersHulls | None:
    """Compute a small hull without each camera in turn; None if too few cameras have any foreground."""
    names = frame.cameras.names
    mask = frame.mask
    if mask is None or len(names) < MIN_CAMERAS:
        return None
    inside = mask > FOREGROUND
    step = max(1, -(-len(names) // MAX_PEERS))
    if int(inside.flatten(1).any(1).sum()) < 2:
        return None
    try:
        missed = missed_share(inside, reconstruct(mask, frame.cameras, bounds, hull).depth(frame.cameras) > 0)
        silhouettes = []
        removed = []
        for view, name in enumerate(names):
            others = frame.without([name])
            peers = [v for v in range(0, len(names), step) if v != view]
            assert others.mask is not None
            proxy = reconstruct(others.mask, others.cameras, bounds, hull)
            covered = pad_like(proxy.depth(frame.cameras[[view, *peers]]) > 0, mask)
            removed.append((missed[peers] - missed_share(inside[peers], covered[1:])).nanmean())
            silhouettes.append(covered[0])
    except ValueError:  # without this camera, nothing is in front of all others
        return None
    covered = torch.stack(silhouettes)
    return OthersHulls(
        covered, torch.stack(removed).nan_to_num(0.0), missed_share(inside, covered).nan_to_num(0.0)
    )


def missed_share(inside: Silhouettes, covered: Silhouettes) -> Float[Tensor, "view"]:
    """The share of each mask that a silhouette does not cover; NaN for an empty mask."""
    return (inside & ~covered).sum((1, 2)) / inside.sum((1, 2))


def pad_like(
    covered: Bool[Tensor, "view _height _width"], mask: UInt8[Tensor, "_view height width"]
) -> Silhouettes:
    """A silhouette padded with False at the right and bottom, to the size of the masks."""
    return F.pad(covered, (0, mask.shape[2] - covered.shape[2], 0, mask.shape[1] - covered.shape[1]))


def find_outlier_by_hull(frame: MultiViewFrame, bounds: Bounds | None) -> tuple[Issue, ...]:
    """Find a camera whose mask is much larger than the others' hull, or removes what all others see."""
    issues = _outlier_by_hull(frame, bounds, LONGEST_PX, HULL)
    if any(issue.camera is None for issue in issues):
        return _outlier_by_hull(frame, bounds, FINE_PX, FINE_HULL)
    return issues


def _outlier_by_hull(
    frame: MultiViewFrame, bounds: Bounds | None, px: int, hull: HullConfig
) -> tuple[Issue, ...]:
    small = limit_size(frame, px)
    found = leave_one_out(small, bounds, hull)
    if found is None:
        return ()
    thresholds = OutlierThresholds()
    names = small.cameras.names
    few = len(small.cameras) <= FEW_CAMERAS
    view = int(found.outside.argmax())
    share = float(found.outside[view])
    if share > thresholds.outside + 3 * float(found.outside.median()):
        if _is_explained_by_borders(small, bounds, view):
            return (Issue(_cut_off_text(small)),)
        text = f"camera '{names[view]}': {100 * share:.0f} % of its mask is outside the hull of all others"
        return (_outlier(text, names[view], share > thresholds.left_out_outside),)
    view = int(found.removed.argmax())
    share = float(found.removed[view])
    typical = max(0.0, float((found.removed.sum() - found.removed[view]) / (len(names) - 1)))
    coarser = min(2.0, FINE_PX / min(FINE_PX, int(frame.cameras.size_px.amax())))
    if share > thresholds.removed * coarser + 1.5 * typical:
        text = f"camera '{names[view]}' alone removes {100 * share:.1f} % of the subject that the others see"
        bound = thresholds.left_out_removed_of_few if few else thresholds.left_out_removed
        return (_outlier(text, names[view], share > bound),)
    return ()


def _is_explained_by_borders(frame: MultiViewFrame, bounds: Bounds | None, view: int) -> bool:
    """Whether a camera's mask fits the others wherever these look: their borders cut the subject off."""
    name = frame.cameras.names[view]
    others = frame.without([name])
    own = frame.select([name])
    assert others.mask is not None
    assert own.mask is not None
    if not count_cut_off(others.mask, others.cameras):
        return False
    try:
        proxy = reconstruct(others.mask, others.cameras, bounds, replace(HULL, min_views=0, min_fraction=0.0))
    except ValueError:
        return False
    covered = pad_like(proxy.depth(own.cameras) > 0, own.mask)
    return float(missed_share(own.mask > FOREGROUND, covered)[0]) <= OutlierThresholds().outside


def find_cut_off_subject(frame: MultiViewFrame) -> tuple[Issue, ...]:
    """An issue if fewer than two cameras see the whole subject within their borders."""
    if frame.mask is None or count_cut_off(frame.mask, frame.cameras) < len(frame.cameras) - 1:
        return ()
    return (Issue(_cut_off_text(frame)),)


def _cut_off_text(frame: MultiViewFrame) -> str:
    """Which cameras see a part of the subject only, and what follows."""
    assert frame.mask is not None
    cut = are_cut_off(frame.mask, frame.cameras).tolist()
    names = [name for name, is_cut in zip(frame.cameras.names, cut, strict=True) if is_cut]
    who = f"camera{'s' if len(names) > 1 else ''} {', '.join(names)}"
    who = f"all cameras but {frame.cameras.names[cut.index(False)]}" if cut.count(False) == 1 else who
    who = "all cameras" if all(cut) else who
    return (
        f"the subject is cut off by the image border of {who}; parts "
        "that fewer than two cameras see are missing in views: move these cameras back, or turn them to the subject"
    )


def _outlier(text: str, camera: str, leave_out: bool) -> Issue:
    advice = "check its mask, its calibration and its synchronisation"
    if leave_out:
        return Issue(f"{text}, so it is left out; {advice}", camera=camera, always=True)
    return Issue(f"{text}; {advice}", timing=True)


def find_outlier_by_outlines(
    frame: MultiViewFrame, bounds: Bounds | None
) -> tuple[tuple[str, ...], float] | None:
    """Find the camera that keeps the outlines from agreeing, and how many times smaller the residual is without it.

    The line of sight through a point of an outline touches the subject, so one of its
    points lies inside all other masks. The residual is how far outside the best point is.
    This detects pose errors of a few pixels. Two cameras are named if it may be either;
    None if no camera is an outlier.
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
    rule = RoughRigThresholds()
    rough = (
        residual >= rule.min_residual_px
        and best <= rule.max_left * residual
        and second >= rule.min_left_of_others * best
    )
    if best > MAX_LEFT * residual and not rough:
        return None
    named = [index for index in order[:2] if best > AMBIGUOUS * left[index] or index == order[0]]
    return tuple(names[suspects[index]] for index in named), residual / max(best, RESOLUTION_PX)


def _outline_residuals_px(frame: MultiViewFrame, box: Bounds) -> tuple[float, np.ndarray]:
    """RMS residual of all outlines but their worst points, and of each camera's own outline, `(view,)`."""
    assert frame.mask is not None
    points = min(OUTLINE_POINTS, MAX_OUTLINE_POINTS // len(frame.cameras))
    lines = LinesOfSight.from_masks(frame.mask, frame.cameras, box, max(1, points))
    squared = lines.least_residuals(Rig.from_cameras(frame.cameras))
    count = np.bincount(lines.view, minlength=len(frame.cameras))
    own = np.bincount(lines.view, squared, minlength=len(frame.cameras)) / np.maximum(count, 1)
    counted = np.sort(squared)[: len(squared) - int(np.ceil(WORST_POINTS * len(squared)))]
    return float(np.sqrt(counted.mean())), np.sqrt(own)
