"""What is wrong with a capture's masks and calibration, in words.

`viewmend info` says it, and `prepare` refuses or warns by it.
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from viewmend.capture.colour_check import odd_colours
from viewmend.capture.finding import Finding
from viewmend.capture.outline_check import odd_outline
from viewmend.capture.peers import odd_camera
from viewmend.capture.reduction import reduced
from viewmend.geometry.alignment import LEAST_IOU, silhouette_iou
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras
from viewmend.geometry.hull import FOREGROUND, HullConfig
from viewmend.geometry.proxy import reconstruct
from viewmend.views import MultiViewFrame

INVERTED_BORDER = 0.75
"""A mask with more of its image's border than this in the foreground is inverted: subjects do not frame an image."""
EMPTIED_SHARE = 0.25
"""An empty mask is wrong where the other cameras' hull would cover this share of what their own masks cover."""
EXPLAINS = 0.1
"""A change of the calibration explains what is wrong if hull and masks then agree better by this much (IoU)."""
LONGEST_PX = 384
"""Larger images are reduced first: what is looked for here is no matter of a pixel."""
SWAPPED_CAMERAS = 24
"""In larger rigs pairs are not tried, since each costs a hull."""
PAIRS_PX = 192
PAIRS_HULL = HullConfig(resolution=48)
LEAST_CAMERA_IOU = 0.5
"""A camera whose mask and hull agree less is wrong itself, however well the others agree."""
SMALLEST_M, LARGEST_M = 0.05, 20.0
"""Subjects outside of these are of another unit more often than not."""
_FLIP = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))


def diagnose(frame: MultiViewFrame, bounds: Bounds | None = None) -> tuple[Finding, ...]:
    """What is wrong with one frame of a capture; () for a good one and for one without masks.

    A good frame costs a hull, and a small one for each camera. Of a bad one the usual mistakes are undone, one at a
    time: what makes hull and masks agree is what the finding names. `bounds` are the capture's.
    """
    frame = reduced(frame, LONGEST_PX)
    if frame.mask is None or len(frame.cameras) < 2 or not bool((frame.mask > FOREGROUND).any()):
        return ()
    found = faulty_masks(frame, frame.cameras.names, bounds)
    if any(finding.fatal for finding in found):
        return found
    left = frame.without([finding.camera for finding in found if finding.camera])
    if len(left.cameras) < 2:
        return found
    iou, size_m = _agreement(left, left.cameras, bounds)
    if iou < LEAST_IOU:
        return (*found, _explained(left, bounds, iou))
    if not SMALLEST_M <= size_m <= LARGEST_M:
        text = f"expected a subject of about {SMALLEST_M} to {LARGEST_M:g} m, got {size_m:.3g} m; check metres_per_unit"
        found = (*found, Finding(text))
    found = (*found, *_odd(left, bounds))
    return (*found, *odd_colours(left.without([finding.camera for finding in found if finding.camera]), bounds))


def _odd(frame: MultiViewFrame, bounds: Bounds | None) -> tuple[Finding, ...]:
    """The camera that does not go with its peers: as the hull says it, unless the outlines name another one."""
    by_hull, by_outlines = odd_camera(frame, bounds), odd_outline(frame, bounds)
    if by_outlines is None or (by_hull and any(f"'{name}'" in by_hull[0].text for name in by_outlines[0])):
        return by_hull
    names, times = " or ".join(f"'{name}'" for name in by_outlines[0]), by_outlines[1]
    text = f"without camera {names} the outlines of all others fit together {times:.2g} times better"
    return (Finding(f"{text}; check its calibration, its mask and whether it is in time"),)


def faulty_masks(frame: MultiViewFrame, inputs: Sequence[str], bounds: Bounds | None) -> tuple[Finding, ...]:
    """Masks that are inverted, or empty although the other `inputs` see a subject there, one finding a camera.

    One fatal finding stands for all where half of the masks or more are inverted. A camera that is no input
    is judged by its own mask alone and stays: it is what scores are taken against. Nobody is judged by it.
    """
    if frame.mask is None:
        return ()
    names = frame.cameras.names
    inverted = [name for view, name in enumerate(names) if _border_share(frame, view) > INVERTED_BORDER]
    bad = [name for name in inverted if name in inputs]
    if bad and 2 * len(bad) >= sum(name in inputs for name in names):
        text = (
            f"expected masks of 255 on the subject, got foreground along the images' borders in {len(bad)} of "
            f"{len(inputs)} cameras: they are inverted; write 255 - mask"
        )
        return (Finding(text, fatal=True),)
    wrong = [
        Finding(f"camera '{name}': its mask is inverted and is left out; write 255 - mask", camera=name) for name in bad
    ]
    wrong += [
        Finding(f"camera '{name}': its mask is inverted: scores against it mean nothing; write 255 - mask")
        for name in inverted
        if name not in inputs
    ]
    seen = [name for name in names if name in inputs and name not in inverted]
    return (*wrong, *(_emptied(frame.select(seen), bounds) if len(seen) > 2 else ()))


def _border_share(frame: MultiViewFrame, view: int) -> float:
    assert frame.mask is not None
    width, height = frame.cameras.size_px[view].tolist()
    mask = frame.mask[view, :height, :width] > FOREGROUND
    return float(torch.cat([mask[0], mask[-1], mask[:, 0], mask[:, -1]]).float().mean())


def _emptied(frame: MultiViewFrame, bounds: Bounds | None) -> Iterator[Finding]:
    assert frame.mask is not None
    share = (frame.mask > FOREGROUND).sum((1, 2)) / frame.cameras.size_px.prod(-1).to(frame.mask.device)
    names = [name for name, covered in zip(frame.cameras.names, share.tolist(), strict=True) if covered == 0]
    others = frame.without(names)
    if not names or len(others.cameras) < 2 or others.mask is None:
        return
    try:
        proxy = reconstruct(others.mask, others.cameras, bounds)
    except ValueError:  # the calibration is wrong, too: the masks cannot be judged by it
        return
    enough = EMPTIED_SHARE * float(share[share > 0].median())
    for name in names:
        camera = frame.cameras.select([name])
        covered = float((proxy.depth(camera) > 0).sum() / camera.size_px.prod())
        if covered >= enough:
            text = f"camera '{name}': its mask is empty where {100 * covered:.1f} % of the image must show the subject"
            yield Finding(f"{text}, and is left out; segment it again", camera=name)


def _agreement(
    frame: MultiViewFrame, cameras: Cameras, bounds: Bounds | None, config: HullConfig | None = None
) -> tuple[float, float]:
    """IoU of hull and masks with these cameras, and the longest side of the hull in metres; zeros without one.

    It is the mean, or that of a camera below `LEAST_CAMERA_IOU` unless its mask is small.
    """
    assert frame.mask is not None
    try:
        proxy = reconstruct(frame.mask, cameras, bounds, config)
    except ValueError:
        return 0.0, 0.0
    if not len(proxy.mesh.vertices):
        return 0.0, 0.0
    vertices = proxy.mesh.vertices
    iou = silhouette_iou(proxy.depth(cameras) > 0, frame.mask)
    covered = (frame.mask > FOREGROUND).sum((1, 2))
    lowest = float(iou[covered >= covered.median() / 4].nan_to_num(1.0).min())
    mean = float(iou.nanmean().nan_to_num(0.0))
    return mean if lowest >= LEAST_CAMERA_IOU else lowest, float((vertices.amax(0) - vertices.amin(0)).max())


def _explained(frame: MultiViewFrame, bounds: Bounds | None, iou: float) -> Finding:
    """The change that makes hull and masks agree, as a finding; a warning, or fatal without a hull, where none does."""
    tried: list[tuple[float, Finding]] = []
    for what, pose in _poses(frame.cameras):
        text = f"{what}; cameras.json wants R and t that map world to camera in OpenCV axes: convert them"
        cameras = replace(frame.cameras, camera_from_world=pose)
        tried.append((_agreement(frame, cameras, bounds)[0], Finding(text, fatal=True)))
    for factor in (0.5, 2.0):
        text = f"K is of images {factor:g} times as large; scale fx, fy, cx, cy and the skew by {1 / factor:g}"
        K = frame.cameras.K.clone()
        K[:, :2] /= factor
        tried.append((_agreement(frame, replace(frame.cameras, K=K), bounds)[0], Finding(text, fatal=True)))
    if bounds is not None:
        free, size_m = _agreement(frame, frame.cameras, None)
        text = f"the bounds do not hold the subject of {size_m:.3g} m; check metres_per_unit, t's unit and the bounds"
        tried.append((free, Finding(text, fatal=True)))
    if len(frame.cameras) >= 4:
        for name in frame.cameras.names:
            text = f"camera '{name}' disagrees with all others and is left out; check its calibration and mask"
            left = frame.without([name])
            tried.append((_agreement(left, left.cameras, bounds)[0], Finding(text, camera=name, always=True)))
    if max((score for score, _ in tried), default=0.0) < LEAST_IOU and len(frame.cameras) <= SWAPPED_CAMERAS:
        tried += list(_swaps(frame, bounds))
    best, finding = max(tried, key=lambda one: one[0], default=(0.0, Finding("")))
    if best >= max(LEAST_IOU, iou + EXPLAINS):
        said = f"hull and masks agree to an IoU of {iou:.3f} only, and of {best:.3f} otherwise: {finding.text}"
        return replace(finding, text=said)
    text = f"hull and masks agree to an IoU of {iou:.3f} only: check axes, units, K and masks; see viewmend info --out"
    return Finding(text, fatal=iou == 0.0)


def _swaps(frame: MultiViewFrame, bounds: Bounds | None) -> Iterator[tuple[float, Finding]]:
    """Every pair of cameras with the other's calibration: the IoU then, and what would be wrong."""
    names, frame = frame.cameras.names, reduced(frame, PAIRS_PX)
    for first, second in itertools.combinations(range(len(names)), 2):
        order = list(range(len(names)))
        order[first], order[second] = second, first
        if frame.cameras.size_px[first].tolist() != frame.cameras.size_px[second].tolist():
            continue
        cameras = replace(frame.cameras[order], names=names)
        text = f"cameras '{names[first]}' and '{names[second]}' are swapped; exchange their files or calibrations"
        yield _agreement(frame, cameras, bounds, PAIRS_HULL)[0], Finding(text, fatal=True)


def _poses(cameras: Cameras) -> Iterator[tuple[str, Float[Tensor, "view 4 4"]]]:
    """What camera_from_world may have been given as, and what it is then."""
    given, flip = cameras.camera_from_world, _FLIP.to(cameras.K)
    turned = given.clone()
    turned[:, :3, :3] = given[:, :3, :3].mT
    yield "R and t are camera-to-world", cameras.world_from_camera
    yield "R and t are of OpenGL axes (y up, z back)", flip @ given
    yield "R and t are camera-to-world of OpenGL axes (y up, z back)", flip @ cameras.world_from_camera
    yield "R is camera-to-world (transposed)", turned
    centred = given.clone()
    centred[:, :3, 3:] = -given[:, :3, :3] @ given[:, :3, 3:]
    yield "t is the camera's centre", centred
