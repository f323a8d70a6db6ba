"""Finds cameras whose images or masks are late or early, by comparing outlines in neighbouring frames."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from viewmend.data.checks.leave_one_out import (
    HULL,
    LONGEST_PX,
    MIN_CAMERAS,
    leave_one_out,
    missed_share,
    pad_like,
)
from viewmend.data.errors import Issue
from viewmend.data.source import CaptureSource, limit_size
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.hull import FOREGROUND
from viewmend.geometry.proxy import reconstruct
from viewmend.types import MultiViewFrame

MAX_DELAY = 4
"""Largest delay that is searched, in frames."""
MIN_DELAY_GAIN = 0.008
"""A camera may be delayed if the share of its mask outside the others' hull is this much lower in
another frame."""
MAX_DELAY_CANDIDATES = 3
"""The camera opposite a delayed one looks delayed too, so several are tried."""
MIN_EXPLAINED = 0.002
"""A camera is delayed if its mask of another frame lets the hull explain more of all masks, by this
share of them."""
MIN_EXPLAINED_SHARE = 0.3
"""The mask of another frame must also explain this share of what the hull left unexplained: if the
calibration is wrong, other frames fit a little better by chance."""
SHARPER = 1.015
"""Images are delayed if the images of another frame have stronger edges along the outlines of the
masks, by this factor."""
MIN_OUTLINE_FRAMES = 3
"""Edges are compared by the median of this many frames or more, since one frame may be damaged."""


def find_desynchronised_cameras(
    source: CaptureSource, frame: MultiViewFrame, last: int | None = None
) -> tuple[Issue, ...]:
    """Find cameras of a frame that are late or early around it, or else around a later one at index `last`.

    A camera that is in step in the first place only has lost frames on the way.
    """
    if frame.mask is None or len(frame.cameras) < MIN_CAMERAS:
        return ()
    issues = find_desynchronised_camera(*_frames_around(source, frame, frame.time), source.bounds, source.fps)
    if issues or last is None or last <= frame.time + MAX_DELAY:
        return issues
    later = find_desynchronised_camera(*_frames_around(source, frame, last), source.bounds, source.fps)
    text = "{} (at frame '{}', but not at frame '{}': frames were lost or repeated in between)"
    first_id = source.frame_ids[frame.time]
    last_id = source.frame_ids[last]
    return tuple(replace(issue, text=text.format(issue.text, last_id, first_id)) for issue in later)


def _frames_around(
    source: CaptureSource, frame: MultiViewFrame, time: int
) -> tuple[list[MultiViewFrame], int]:
    """Frames around a time, of the cameras of `frame` that all of them have, and the position of the one to judge.

    That is the nearest one with as many frames before as after it, if there are enough, and with a
    subject, if any has.
    """
    count = len(source.frame_ids)
    time = min(max(time, min(MAX_DELAY, count // 2)), max(count - 1 - MAX_DELAY, count // 2))
    times = list(range(max(0, time - MAX_DELAY), min(count, time + MAX_DELAY + 1)))
    frames = [frame if other == frame.time else source.read(other) for other in times]
    seen = [at for at, other in enumerate(frames) if other.has_subject]
    wanted = set(frame.cameras.names)
    middle = min(seen or [0], key=lambda at: abs(times[at] - time))
    # Leave out frames in which some cameras have ended, or have not begun
    while middle < len(frames) - 2 and not wanted <= set(frames[-1].cameras.names):
        frames.pop()
    while middle > 1 and not wanted <= set(frames[0].cameras.names):
        frames.pop(0)
        middle -= 1
    names = [name for name in frame.cameras.names if all(name in other.cameras.names for other in frames)]
    return [other.select(names) for other in frames], middle


def find_desynchronised_camera(
    frames: Sequence[MultiViewFrame], middle: int, bounds: Bounds | None, fps: float | None = None
) -> tuple[Issue, ...]:
    """Find the camera whose mask of another one of consecutive frames fits the others' of `frames[middle]` best.

    If the masks are in sync, looks for images that are out of sync with their own masks. With
    `fps`, frames per second, delays are stated in milliseconds too.
    """
    now = frames[middle]
    if now.mask is None:
        return ()
    # A camera whose mask is empty cannot be compared, and would leave the others without a hull
    seeing = (now.mask > FOREGROUND).any(-1).any(-1).tolist()
    names = [
        name
        for name, sees in zip(now.cameras.names, seeing, strict=True)
        if sees and all(name in frame.cameras.names for frame in frames)
    ]
    if len(names) < MIN_CAMERAS:
        return ()
    small = [limit_size(frame.select(names), LONGEST_PX) for frame in frames]
    found = leave_one_out(small[middle], bounds)
    if found is None or len(frames) < 2:
        return ()
    shares = [
        missed_share(frame.mask > FOREGROUND, found.silhouettes) for frame in small if frame.mask is not None
    ]
    outside = torch.stack(shares).nan_to_num(1.0)
    gain = outside[middle] - outside.amin(0)
    best = outside.argmin(0).tolist()
    views = gain.argsort(descending=True)[:MAX_DELAY_CANDIDATES].tolist()
    tried = [view for view in views if float(gain[view]) > MIN_DELAY_GAIN]
    unexplained = {
        view: _unexplained(_with_mask_of(small, middle, view, best[view]), bounds) for view in tried
    }
    if unexplained:
        view = min(unexplained, key=lambda view: unexplained[view])
        before = _unexplained(small[middle], bounds)
        if unexplained[view] < min(before - MIN_EXPLAINED, before * (1 - MIN_EXPLAINED_SHARE)):
            frames_late = best[view] - middle
            shift = "shift its files in time"
            if fps is not None:
                change = "raise" if frames_late > 0 else "lower"
                by_ms = abs(1000 * frames_late / fps)
                shift += f", or {change} its offset_ms in cameras.json by {by_ms:.0f}"
            delay = describe_delay(frames_late)
            return (Issue(f"camera '{names[view]}': {delay}, compared with the others' masks; {shift}"),)
    return check_image_mask_sync(small)


def _with_mask_of(frames: Sequence[MultiViewFrame], middle: int, view: int, time: int) -> MultiViewFrame:
    """The frame in the middle, with one camera's mask from another frame."""
    own = frames[middle].mask
    other = frames[time].mask
    assert own is not None and other is not None
    return replace(frames[middle], mask=torch.cat([own[:view], other[view, None], own[view + 1 :]]))


def _unexplained(frame: MultiViewFrame, bounds: Bounds | None) -> float:
    """The share of the masks that the hull does not cover, mean of all cameras."""
    assert frame.mask is not None
    try:
        covered = reconstruct(frame.mask, frame.cameras, bounds, HULL).depth(frame.cameras) > 0
    except ValueError:
        return 1.0
    return float(
        missed_share(frame.mask > FOREGROUND, pad_like(covered, frame.mask)).nanmean().nan_to_num(1.0)
    )


def describe_delay(frames: int) -> str:
    """A delay of a camera by this number of frames, in words."""
    return f"{'late' if frames > 0 else 'early'} by about {abs(frames)} frame{'s' if abs(frames) > 1 else ''}"


def check_image_mask_sync(frames: Sequence[MultiViewFrame]) -> tuple[Issue, ...]:
    """Find cameras whose images have stronger edges along the outlines of their own masks in another small frame."""
    masks = [frame.mask for frame in frames if frame.mask is not None]
    if len(masks) < len(frames):
        return ()
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


def _gradient(
    image: Float[Tensor, "view channel height width"],
) -> Float[Tensor, "view channel 2 height width"]:
    """Central differences in x and y."""
    padded = F.pad(image, (1, 1, 1, 1), mode="replicate")
    x = padded[..., 1:-1, 2:] - padded[..., 1:-1, :-2]
    y = padded[..., 2:, 1:-1] - padded[..., :-2, 1:-1]
    return torch.stack([x, y], 2)


def _edge_ratio(
    edges: Float[Tensor, "time view channel 2 height width"],
    outlines: Float[Tensor, "time view 1 2 height width"],
    delay: int,
) -> Float[Tensor, "view"]:
    """Strength of the edges across an outline in the image `delay` frames later, relative to its own; the median."""
    first = max(0, -delay)
    count = len(edges) - abs(delay)
    own, shifted = (edges[start : start + count] for start in (first, first + delay))
    normals = outlines[first : first + count]
    later, now = ((image * normals).sum(3).abs().sum((2, 3, 4)) for image in (shifted, own))
    return (later / now.clamp(min=1.0)).median(0).values
