"""Each camera judged by its peers: by the hull that the others' masks leave, in space and in time."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from viewmend.capture.finding import Finding
from viewmend.capture.own_outlines import delay_text, images_out_of_time
from viewmend.capture.reduction import reduced
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.hull import FOREGROUND, HullConfig
from viewmend.geometry.proxy import reconstruct
from viewmend.views import MultiViewFrame

LONGEST_PX = 256
"""Cameras are judged on images of this size."""
HULL = HullConfig(resolution=64)
LEAST_CAMERAS = 4
"""With fewer, nobody can tell who is wrong."""
MOST_PEERS = 10
"""So many other cameras tell whether a camera spoils the hull."""
TAKES, TAKING_LEFT_OUT = 0.004, 0.06
"""A camera is odd if it alone takes away such a share of the others' masks, beyond one and a half times what is usual;
and left out from the larger share on: a smaller error costs less than a camera."""
TOO_LARGE, LARGE_LEFT_OUT = 0.15, 0.3
"""With such a share of its mask outside the others' hull, beyond three times what is usual, it is odd, too."""
REACH = 4
"""Cameras may be late or early by so many frames at most."""
LATE = 0.008
"""A camera may be late if that much less of its mask lies outside of the others' hull at another time."""
CANDIDATES = 3
"""So many cameras are tried: the one across the rig looks late, too."""
WORTH_SHIFTING = 0.002
"""The camera is late if the masks with its own of another time are explained by that much more."""


@dataclass(frozen=True)
class Peers:
    """What the others say of each camera. The true subject lies within every hull, so good masks do, too."""

    silhouettes: Bool[Tensor, "view height width"]
    """What the hull of all others covers in it."""
    takes: Float[Tensor, "view"]
    """The share of the others' masks that this camera alone takes away from the hull."""
    sticks_out: Float[Tensor, "view"]
    """The share of its own mask that lies outside the others' hull."""


def ask_peers(frame: MultiViewFrame, bounds: Bounds | None) -> Peers | None:
    """Carve a small hull without each of the cameras in turn; None where too few have any foreground.

    The frame's images should be small (`LONGEST_PX`).
    """
    names, mask = frame.cameras.names, frame.mask
    if mask is None or len(names) < LEAST_CAMERAS:
        return None
    inside, every = mask > FOREGROUND, max(1, -(-len(names) // MOST_PEERS))
    try:
        missed = _missed(inside, reconstruct(mask, frame.cameras, bounds, HULL).depth(frame.cameras) > 0)
        silhouettes, takes = [], []
        for view, name in enumerate(names):
            rest, asked = frame.without([name]), [v for v in range(0, len(names), every) if v != view]
            assert rest.mask is not None
            proxy = reconstruct(rest.mask, rest.cameras, bounds, HULL)
            covered = _padded(proxy.depth(frame.cameras[[view, *asked]]) > 0, mask)
            takes.append((missed[asked] - _missed(inside[asked], covered[1:])).nanmean())
            silhouettes.append(covered[0])
    except ValueError:  # nothing is left in front of all others
        return None
    of_peers = torch.stack(silhouettes)
    return Peers(of_peers, torch.stack(takes).nan_to_num(0.0), _missed(inside, of_peers).nan_to_num(0.0))


def _missed(
    inside: Bool[Tensor, "view height width"], covered: Bool[Tensor, "view height width"]
) -> Float[Tensor, "view"]:
    """The share of each mask that a silhouette does not cover; NaN for an empty mask."""
    return (inside & ~covered).sum((1, 2)) / inside.sum((1, 2))


def _padded(
    covered: Bool[Tensor, "view _height _width"], mask: UInt8[Tensor, "_view height width"]
) -> Bool[Tensor, "view height width"]:
    """Silhouettes as wide and high as the masks."""
    right, below = mask.shape[2] - covered.shape[2], mask.shape[1] - covered.shape[1]
    return torch.nn.functional.pad(covered, (0, right, 0, below))


def odd_camera(frame: MultiViewFrame, bounds: Bounds | None) -> tuple[Finding, ...]:
    """The camera whose mask does not go with the others', as a finding; () for none.

    Its mask is much larger than what the others' hull allows, or it takes away what all others see.
    """
    small = reduced(frame, LONGEST_PX)
    peers = ask_peers(small, bounds)
    if peers is None:
        return ()
    names = small.cameras.names
    view = int(peers.sticks_out.argmax())
    share = float(peers.sticks_out[view])
    if share > TOO_LARGE + 3 * float(peers.sticks_out.median()):
        text = f"camera '{names[view]}': {100 * share:.0f} % of its mask lie outside the hull of all others"
        return (_odd(text, names[view], share > LARGE_LEFT_OUT),)
    view = int(peers.takes.argmax())
    share = float(peers.takes[view])
    usual = max(0.0, float((peers.takes.sum() - peers.takes[view]) / (len(names) - 1)))
    if share > TAKES + 1.5 * usual:
        text = f"camera '{names[view]}' alone takes {100 * share:.1f} % of the subject away that the others see"
        return (_odd(text, names[view], share > TAKING_LEFT_OUT),)
    return ()


def _odd(text: str, camera: str, leave_out: bool) -> Finding:
    advice = "check its mask, its calibration and whether it is in time"
    if leave_out:
        return Finding(f"{text}, and it is left out; {advice}", camera=camera, always=True)
    return Finding(f"{text}; {advice}")


def late_camera(frames: Sequence[MultiViewFrame], middle: int, bounds: Bounds | None) -> tuple[Finding, ...]:
    """The camera whose masks of another time go best with the others' of `frames[middle]`, or whose images are late.

    `frames` follow each other in time. The hull of the others holds the mask of the same time, whatever moves; () if
    all are in time.
    """
    small = [reduced(frame, LONGEST_PX) for frame in frames]
    there = [name for name in small[middle].cameras.names if all(name in frame.cameras.names for frame in small)]
    small = [frame.select(there) for frame in small]
    peers = ask_peers(small[middle], bounds)
    if peers is None or len(frames) < 2:
        return ()
    outside = torch.stack(
        [_missed(frame.mask > FOREGROUND, peers.silhouettes) for frame in small if frame.mask is not None]
    ).nan_to_num(1.0)
    gain = outside[middle] - outside.amin(0)
    candidates = [view for view in gain.argsort(descending=True)[:CANDIDATES].tolist() if float(gain[view]) > LATE]
    moved = {view: _with_mask_of(small, middle, view, int(outside[:, view].argmin())) for view in candidates}
    left = {view: _unexplained(frame, bounds) for view, frame in moved.items()}
    if left:
        view = min(left, key=lambda view: left[view])
        if left[view] < _unexplained(small[middle], bounds) - WORTH_SHIFTING:
            return (_late(there[view], int(outside[:, view].argmin()) - middle),)
    return images_out_of_time(small)


def _with_mask_of(frames: Sequence[MultiViewFrame], middle: int, view: int, time: int) -> MultiViewFrame:
    """The frame in the middle, with one camera's mask of another time."""
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
    return float(_missed(frame.mask > FOREGROUND, _padded(covered, frame.mask)).nanmean().nan_to_num(1.0))


def _late(name: str, by: int) -> Finding:
    """`by` is at which time, from the middle's, what fits is found."""
    fit = "its masks fit the others'; shift its files in time"
    return Finding(f"camera '{name}': {delay_text(by)}, by when {fit}")
