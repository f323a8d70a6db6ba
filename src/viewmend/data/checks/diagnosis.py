"""Finds and explains faults in the masks and the calibration of a frame, for `viewmend check` and `prepare`."""

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from viewmend.data.checks.colours import find_blank_images, find_odd_images
from viewmend.data.checks.leave_one_out import (
    find_cut_off_subject,
    find_outlier_by_hull,
    find_outlier_by_outlines,
)
from viewmend.data.errors import Issue
from viewmend.data.source import limit_size
from viewmend.geometry.alignment import LEAST_IOU, silhouette_iou
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras
from viewmend.geometry.hull import FOREGROUND, HullConfig
from viewmend.geometry.proxy import reconstruct
from viewmend.types import MultiViewFrame

INVERTED_BORDER = 0.75
"""A mask is inverted if a larger share of its border is foreground."""
FULL = 0.99
"""A mask with a larger share of foreground shows no subject."""
EMPTY_SHARE = 0.25
"""An empty mask is wrong if the others' hull would cover this share of what a typical mask covers."""
SAME_IOU = 0.02
"""A turned mask fits if hull and masks agree as well, by this difference, as without its camera."""
MIN_IMPROVEMENT = 0.1
"""A change of the calibration explains the fault if it improves the IoU of hull and masks by this much."""
LONGEST_PX = 384
"""Images are reduced to this size."""
MAX_CAMERAS_FOR_SWAPS = 24
"""Swapped pairs are only searched in rigs of at most this many cameras: each pair needs a hull."""
PAIRS_PX = 192
"""Swapped pairs are searched in images of at most this many pixels along their longer side."""
PAIRS_HULL = HullConfig(resolution=48)
"""Hulls of swapped pairs have this resolution."""
MIN_CAMERA_IOU = 0.5
"""A camera below this IoU is faulty, however well the others agree."""
MIN_SIZE_M = 0.05
"""Subjects smaller than this, metres, usually have the wrong unit."""
MAX_SIZE_M = 20.0
"""Subjects larger than this, metres, usually have the wrong unit."""
MIN_RIG_M = 0.05
"""Rigs whose longest side is shorter than this, metres, have the wrong unit."""
MAX_RIG_M = 500.0
"""Rigs whose longest side is longer than this, metres, have the wrong unit."""
CHECK_UNIT = "check metres_per_unit in cameras.json (viewmend convert writes one from any format)"
"""The next step after a wrong unit."""
FLIP = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
"""This matrix converts between OpenGL's and OpenCV's camera axes."""
TURNED: dict[str, Callable[[Tensor], Tensor]] = {
    "mirrored": lambda mask: mask.flip(1),
    "upside down": lambda mask: mask.flip(0),
    "rotated by 180 degrees": lambda mask: mask.flip(0, 1),
}
"""The ways in which masks may be turned, with functions that turn them back."""
TURNED_SQUARES: dict[str, Callable[[Tensor], Tensor]] = {
    "rotated by 90 degrees clockwise": lambda mask: mask.rot90(1),
    "rotated by 90 degrees counter-clockwise": lambda mask: mask.rot90(-1),
}
"""Square masks may also be turned in these ways; others are recognised by their size."""


def diagnose(frame: MultiViewFrame, bounds: Bounds | None = None) -> tuple[Issue, ...]:
    """Find the faults of one frame; empty for a good frame and for one without masks.

    If hull and masks disagree, common mistakes are undone one at a time, and the issue names the
    change that makes them agree. A good frame costs one hull and a small one per camera.
    """
    frame = limit_size(frame, LONGEST_PX)
    if frame.mask is None or len(frame.cameras) < 2 or not bool((frame.mask > FOREGROUND).any()):
        return ()
    issues = find_bad_masks(frame, frame.cameras.names, bounds)
    if any(issue.fatal for issue in issues):
        return issues
    frame = frame.without([issue.camera for issue in issues if issue.camera])
    if len(frame.cameras) < 2:
        return issues
    iou, size_m = _agreement(frame, frame.cameras, bounds)
    if iou < LEAST_IOU:
        return (*issues, _explain(frame, bounds, iou))
    if not MIN_SIZE_M <= size_m <= MAX_SIZE_M:
        expected = f"a subject of about {MIN_SIZE_M} to {MAX_SIZE_M:g} m"
        issues = (*issues, Issue(f"expected {expected}, got {size_m:.3g} m; {CHECK_UNIT}"))
    issues = (*issues, *_find_outlier(frame, bounds))
    issues = (*issues, *find_blank_images(frame.without([issue.camera for issue in issues if issue.camera])))
    consistent = frame.without([issue.camera for issue in issues if issue.camera])
    return (*issues, *find_odd_images(consistent, bounds))


def find_wrong_unit(cameras: Cameras, found: Sequence[Issue] = ()) -> tuple[Issue, ...]:
    """A rig whose size cannot be in metres; empty if an issue that was found already names the unit."""
    size_m = float((cameras.centers.amax(0) - cameras.centers.amin(0)).max())
    if MIN_RIG_M <= size_m <= MAX_RIG_M or any("metres_per_unit" in issue.text for issue in found):
        return ()
    expected = f"a rig of {MIN_RIG_M} to {MAX_RIG_M:g} m"
    return (Issue(f"expected {expected}, got one of {size_m:.3g} m; {CHECK_UNIT}"),)


def _find_outlier(frame: MultiViewFrame, bounds: Bounds | None) -> tuple[Issue, ...]:
    """The camera that is inconsistent with the others, by the hull, unless the outlines point to another camera."""
    by_hull = find_outlier_by_hull(frame, bounds) or find_cut_off_subject(frame)
    by_outlines = find_outlier_by_outlines(frame, bounds)
    if by_outlines is None or (by_hull and any(f"'{name}'" in by_hull[0].text for name in by_outlines[0])):
        return by_hull
    names = " or ".join(f"'{name}'" for name in by_outlines[0])
    factor = by_outlines[1]
    text = f"without camera {names} the outlines of the other cameras agree {factor:.2g} times better"
    return (Issue(f"{text}; check its calibration, its mask and its synchronisation", timing=True),)


def find_bad_masks(frame: MultiViewFrame, inputs: Sequence[str], bounds: Bounds | None) -> tuple[Issue, ...]:
    """Find masks that are inverted, or empty although the other input cameras see the subject there.

    Returns one issue per camera, or a single fatal one if at least half of the masks are inverted.
    A camera that is not an input is not left out, since results are scored against it; it does not affect
    the judgement of other cameras.
    """
    if frame.mask is None:
        return ()
    names = frame.cameras.names
    inverted: dict[str, tuple[str, str]] = {}
    for view, (width, height) in enumerate(frame.cameras.size_px.tolist()):
        own = (frame.mask[view, :height, :width] > FOREGROUND).float()
        if float(torch.cat([own[0], own[-1], own[:, 0], own[:, -1]]).mean()) > INVERTED_BORDER:
            full = float(own.mean()) > FULL
            inverted[names[view]] = ("full", "segment it again") if full else ("inverted", "write 255 - mask")
    bad = [name for name in inverted if name in inputs]
    if bad and 2 * len(bad) >= sum(name in inputs for name in names):
        what, next_step = next(iter(inverted.values()))
        got = f"foreground along the image borders in {len(bad)} of {len(inputs)} cameras: they are {what}"
        return (Issue(f"expected masks of 255 on the subject, got {got}; {next_step}", fatal=True),)
    issues = []
    for name, (what, next_step) in inverted.items():
        effect = "it is left out" if name in inputs else "scores against it are meaningless"
        text = f"camera '{name}': its mask is {what}, so {effect}; {next_step}"
        issues.append(Issue(text, camera=name if name in inputs else None))
    judged = [name for name in names if name not in inverted]
    good = [name for name in judged if name in inputs]
    return (*issues, *(_find_empty_masks(frame.select(judged), good, bounds) if len(good) > 2 else ()))


def _find_empty_masks(frame: MultiViewFrame, inputs: Sequence[str], bounds: Bounds | None) -> Iterator[Issue]:
    """The cameras whose masks are empty although the hull of the other inputs is in their image."""
    assert frame.mask is not None
    share = (frame.mask > FOREGROUND).sum((1, 2)) / frame.cameras.size_px.prod(-1).to(frame.mask.device)
    share_of = dict(zip(frame.cameras.names, share.tolist(), strict=True))
    empty = [name for name in frame.cameras.names if share_of[name] == 0]
    others = frame.select([name for name in inputs if share_of[name] > 0])
    if not empty or len(others.cameras) < 2 or others.mask is None:
        return
    try:
        proxy = reconstruct(others.mask, others.cameras, bounds)
    except ValueError:  # the calibration is wrong too, so that masks cannot be judged by it
        return
    enough = EMPTY_SHARE * float(torch.tensor([share_of[name] for name in others.cameras.names]).median())
    for name in empty:
        camera = frame.cameras.select([name])
        covered = float((proxy.depth(camera) > 0).sum() / camera.size_px.prod())
        if covered < enough:
            continue
        if name in inputs:
            expected = f"the subject should cover {100 * covered:.1f} % of the image"
            text = f"camera '{name}': its mask is empty, but {expected}, so it is left out; segment it again"
            yield Issue(text, camera=name)
        else:
            expected = "the other cameras see the subject"
            effect = "scores against it are meaningless there"
            yield Issue(f"camera '{name}': its mask is empty, but {expected}, so {effect}; segment it again")


def _agreement(
    frame: MultiViewFrame, cameras: Cameras, bounds: Bounds | None, config: HullConfig | None = None
) -> tuple[float, float]:
    """IoU of hull and masks with these cameras, and the longest side of the hull in metres; zeros without a hull.

    The IoU is the mean of all cameras, or the lowest if that is below `MIN_CAMERA_IOU`, ignoring small masks.
    """
    assert frame.mask is not None
    try:
        proxy = reconstruct(frame.mask, cameras, bounds, config)
    except ValueError:
        return 0.0, 0.0
    vertices = proxy.mesh.vertices
    if not len(vertices):
        return 0.0, 0.0
    iou = silhouette_iou(proxy.depth(cameras) > 0, frame.mask)
    covered = (frame.mask > FOREGROUND).sum((1, 2))
    lowest = float(iou[covered >= covered.median() / 4].nan_to_num(1.0).min())
    mean = float(iou.nanmean().nan_to_num(0.0))
    return mean if lowest >= MIN_CAMERA_IOU else lowest, float((vertices.amax(0) - vertices.amin(0)).max())


def _explain(frame: MultiViewFrame, bounds: Bounds | None, iou: float) -> Issue:
    """The change that makes hull and masks agree; if there is none, a warning, or a fatal issue without any hull."""
    tried = list(_changes(frame, bounds))
    if (
        max((score for score, _ in tried), default=0.0) < LEAST_IOU
        and len(frame.cameras) <= MAX_CAMERAS_FOR_SWAPS
    ):
        tried += list(_swaps(frame, bounds))
    best, issue = max(tried, key=lambda change: change[0], default=(0.0, Issue("")))
    if issue.camera is not None:
        view = frame.cameras.names.index(issue.camera)
        for how in _turns(frame):
            if _agreement(_turned(frame, [view], how), frame.cameras, bounds)[0] >= best - SAME_IOU:
                text = f"the mask of camera '{issue.camera}' is {how}, so it is left out; turn it back"
                issue = replace(issue, text=text)
    agreement = f"hull and masks agree only to an IoU of {iou:.3f}"
    if best >= max(LEAST_IOU, iou + MIN_IMPROVEMENT):
        return replace(issue, text=f"{agreement}; a correction would raise it to {best:.3f}: {issue.text}")
    text = f"{agreement}: check axes, units, K and masks; viewmend check --out draws them"
    return Issue(text, fatal=iou == 0.0)


def _changes(frame: MultiViewFrame, bounds: Bounds | None) -> Iterator[tuple[float, Issue]]:
    """Common mistakes: the IoU after each is undone, and the issue that it would be."""
    for mistake, pose in _poses(frame.cameras):
        text = f"{mistake}; cameras.json needs R and t that map world to camera in OpenCV axes: convert them"
        yield (
            _agreement(frame, replace(frame.cameras, camera_from_world=pose), bounds)[0],
            Issue(text, fatal=True),
        )
    for factor in (0.5, 2.0):
        text = (
            f"K is for images {factor:g} times as large; scale fx, fy, cx, cy and the skew by {1 / factor:g}"
        )
        K = frame.cameras.K.clone()
        K[:, :2] /= factor
        yield _agreement(frame, replace(frame.cameras, K=K), bounds)[0], Issue(text, fatal=True)
    for how in _turns(frame):
        turned = _turned(frame, range(len(frame.cameras)), how)
        text = f"all masks are {how}, judging by the calibration; turn them back, and the images too if they are {how}"
        yield _agreement(turned, frame.cameras, bounds)[0], Issue(text, fatal=True)
    if bounds is not None:
        iou, size_m = _agreement(frame, frame.cameras, None)
        text = f"the bounds do not contain the subject of {size_m:.3g} m; check metres_per_unit, t's unit and bounds"
        yield iou, Issue(text, fatal=True)
    if len(frame.cameras) >= 4:
        for name in frame.cameras.names:
            text = f"camera '{name}' disagrees with all others, so it is left out; check its calibration and mask"
            others = frame.without([name])
            yield _agreement(others, others.cameras, bounds)[0], Issue(text, camera=name, always=True)


def _turned(frame: MultiViewFrame, views: Iterable[int], how: str) -> MultiViewFrame:
    """The frame with the masks of these cameras turned back."""
    assert frame.mask is not None
    mask = frame.mask.clone()
    for view in views:
        width, height = frame.cameras.size_px[view].tolist()
        mask[view, :height, :width] = _turns(frame)[how](frame.mask[view, :height, :width])
    return replace(frame, mask=mask)


def _turns(frame: MultiViewFrame) -> dict[str, Callable[[Tensor], Tensor]]:
    """The ways in which the frame's masks may be turned."""
    is_square = bool((frame.cameras.size_px[:, 0] == frame.cameras.size_px[:, 1]).all())
    return TURNED | TURNED_SQUARES if is_square else TURNED


def _swaps(frame: MultiViewFrame, bounds: Bounds | None) -> Iterator[tuple[float, Issue]]:
    """Each pair of cameras with exchanged calibrations, as in `_changes`."""
    names = frame.cameras.names
    frame = limit_size(frame, PAIRS_PX)
    for first, second in itertools.combinations(range(len(names)), 2):
        order = list(range(len(names)))
        order[first] = second
        order[second] = first
        if frame.cameras.size_px[first].tolist() != frame.cameras.size_px[second].tolist():
            continue
        cameras = replace(frame.cameras[order], names=names)
        text = f"cameras '{names[first]}' and '{names[second]}' are swapped; exchange their files or calibrations"
        yield _agreement(frame, cameras, bounds, PAIRS_HULL)[0], Issue(text, fatal=True)


def _poses(cameras: Cameras) -> Iterator[tuple[str, Float[Tensor, "view 4 4"]]]:
    """What camera_from_world may have been confused with, and the corrected camera_from_world."""
    stored = cameras.camera_from_world
    flip = FLIP.to(cameras.K)
    transposed = stored.clone()
    transposed[:, :3, :3] = stored[:, :3, :3].mT
    yield "R and t are camera-to-world", cameras.world_from_camera
    yield "R and t have OpenGL axes (y up, z back)", flip @ stored
    yield "R and t are camera-to-world with OpenGL axes (y up, z back)", flip @ cameras.world_from_camera
    yield "R is camera-to-world (transposed)", transposed
    centred = stored.clone()
    centred[:, :3, 3:] = -stored[:, :3, :3] @ stored[:, :3, 3:]
    yield "t is the camera's centre", centred
