"""Cameras refined by silhouettes: the line of sight of each point of an outline must touch what all others see.

A point of an outline lies on the subject's surface. So somewhere along its line of sight there is a
place that no other camera sees outside of its mask. How far outside the best one is, in pixels, is
what the calibration misses (after Hernandez, Schmitt and Cipolla, "Silhouette coherence for camera
calibration under circular motion", PAMI 2007, and Boyer, "On using silhouettes for camera
calibration", ACCV 2006). Gauss and Newton's method moves all cameras, and each place along its
line, until little is missed. No surface is carved, so that parts of a pixel count.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Float64
from scipy.spatial.transform import Rotation
from torch import Tensor

from viewmend.data.errors import CaptureError
from viewmend.geometry.alignment import silhouette_iou
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras
from viewmend.geometry.line_of_sight import OUTLIER_PX, LinesOfSight, Rig
from viewmend.geometry.proxy import reconstruct
from viewmend.geometry.rigid import invert_rigid, rigid
from viewmend.types import MultiViewFrame

Places = Float64[np.ndarray, "point 3"]
LEAST_CAMERAS = 3
"""Fewer cameras do not constrain each other: two masks always have common points."""
CAMERA = 7
"""Parameters of a camera: rotation, translation, focal length; each in pixels that it moves what is seen."""
HOLDS = (1e-3, 0.1)
"""Strength of the prior on the present cameras, since outlines do not determine everything. The
second value is for few frames and hard masks; held-out cameras decide which is better."""
SEARCHES = 6
"""The best places on the lines of sight are searched at most this many times."""
STEPS = 6
"""The cameras move in at most this many steps between two searches."""
ENOUGH = 0.02
"""The steps end when one reduces the residual by less than this share."""
DAMPING = 1e-3
"""The damping of Levenberg and Marquardt begins with this value."""
MOST_DAMPING = 1e4
"""The steps end when the damping of Levenberg and Marquardt exceeds this value."""
Moves = Float64[np.ndarray, "view parameter"]
Depths = list[Float64[np.ndarray, "_point"]]
"""The z-depth of each line of sight's place, for each time."""
LEFT_OUT = 3
"""Number of cameras that are held out in turn, spread over the rig."""
LEFT_OUT_TIMES = 2
"""Number of frames that are held out in turn, if there are several."""
MARGIN = 0.1
"""How much larger than the hull the box is that may hold the subject, to each side."""


def brought_to(rig: Cameras, reference: Cameras, points_world: Float[Tensor, "point 3"]) -> Cameras:
    """The rig turned, moved and scaled as a whole, so that its cameras agree with `reference` on the points.

    `reference` has the same cameras in the frame that is wanted, in which `points_world` are where
    the subject may be. The rotation, translation and scale are Umeyama's, of the points in each
    camera's own frame (PAMI 1991).
    """
    there = torch.cat([points_world, torch.ones_like(points_world[:, :1])], 1).double()
    here = there @ reference.camera_from_world.double().mT @ invert_rigid(rig.camera_from_world.double()).mT
    source = here[..., :3].reshape(-1, 3).cpu().numpy()
    R, t, scale = _similarity(source, points_world.double().repeat(len(rig), 1).cpu().numpy())
    pose = rig.camera_from_world.double()
    turned = pose[:, :3, :3] @ torch.from_numpy(R.T).to(pose)
    moved = scale * pose[:, :3, 3] - turned @ torch.from_numpy(t).to(pose)
    return replace(rig, camera_from_world=rigid(turned, moved).to(rig.camera_from_world))


def _similarity(
    source: Places, target: Places
) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, "3"], float]:
    """R, t and s for which s R x + t is nearest to the targets."""
    a = source - source.mean(0)
    b = target - target.mean(0)
    u, s, vt = np.linalg.svd(b.T @ a)
    sign = np.array([1.0, 1.0, np.linalg.det(u) * np.linalg.det(vt)])
    R = (u * sign) @ vt
    scale = float((s * sign).sum() / (a**2).sum())
    return R, target.mean(0) - scale * R @ source.mean(0), scale


@dataclass(frozen=True)
class Refinement:
    """Refined cameras, and what they miss."""

    cameras: Cameras
    before_px: float
    """How far a line of sight of an outline is outside the other masks at best, root mean square,
    as calibrated."""
    after_px: float
    """The same, refined."""


def refine_by_silhouettes(
    frames: Sequence[MultiViewFrame], bounds: Sequence[Bounds], hold: float
) -> Refinement:
    """Refine poses and focal lengths of `LEAST_CAMERAS` or more; several frames constrain them better than one.

    The rig as a whole stays where it was, and as large. `bounds` are boxes around the subject, one
    for each frame; `hold` is one of `HOLDS`. Here and below, a CaptureError is raised for frames
    without masks, and a ValueError for masks without outlines or without a common subject.
    """
    cameras = frames[0].cameras
    sights = [lines_of_sight(frame, box) for frame, box in zip(frames, bounds, strict=True)]
    problem = _Problem(sights, Rig.from_cameras(cameras), hold)
    x = np.zeros((len(cameras), CAMERA))
    depths = problem.searched(x)
    before_px = problem.missed_px(x, depths)
    for _ in range(SEARCHES):
        cost = problem.cost(x, depths)
        x = problem.solved(x, depths)
        depths = problem.searched(x)
        if problem.cost(x, depths) > (1 - ENOUGH) * cost:
            break
    rig = problem.rig(x)
    pose = cameras.camera_from_world.clone()
    pose[:, :3] = torch.from_numpy(np.concatenate([rig.R, rig.t[..., None]], 2)).to(pose)
    found = replace(cameras, K=torch.from_numpy(rig.K).to(cameras.K), camera_from_world=pose)
    corners = torch.cat([box.corners for box in bounds])
    return Refinement(brought_to(found, cameras, corners), before_px, problem.missed_px(x, depths))


def lines_of_sight(frame: MultiViewFrame, bounds: Bounds) -> LinesOfSight:
    """The lines of sight through the outlines of one frame's masks."""
    if frame.mask is None:
        raise CaptureError("expected frames with masks, got none; make them with viewmend masks")
    return LinesOfSight.from_masks(frame.mask, frame.cameras, bounds)


class _Problem:
    """Residuals of the outlines of some frames as functions of camera motion."""

    def __init__(self, sights: Sequence[LinesOfSight], start: Rig, hold: float):
        self.sights = sights
        self.start = start
        middle = np.mean([sight.middle for sight in sights], 0)
        far_m = np.linalg.norm(start.R @ middle + start.t, axis=1)
        m_per_px = far_m / start.K[:, 0, 0]
        self.units = np.empty((len(start.K), CAMERA))
        """What moves a camera's image by about a pixel."""
        self.units[:, :3] = (m_per_px / far_m)[:, None]
        self.units[:, 3:6] = m_per_px[:, None]
        self.units[:, 6] = m_per_px / max(sight.radius_m for sight in sights)
        self.hold = hold * sum(len(sight.view) for sight in sights) / len(start.K)

    def rig(self, x: Moves) -> Rig:
        """The cameras, moved by `x`."""
        by = x * self.units
        turn = Rotation.from_rotvec(by[:, :3]).as_matrix()
        K = self.start.K.copy()
        K[:, [0, 1], [0, 1]] *= np.exp(by[:, 6:])
        t = np.einsum("vij,vj->vi", turn, self.start.t) + by[:, 3:6]
        return Rig(K, turn @ self.start.R, t)

    def solved(self, x: Moves, depths: Depths) -> Moves:
        """The moves at which least is missed, of places near the given ones (Levenberg and Marquardt)."""
        cost = self.cost(x, depths)
        damping = DAMPING
        for _ in range(STEPS):
            H, g = self.normal_equations(x, depths)
            while damping < MOST_DAMPING:
                moved = x + np.linalg.solve(H + damping * np.diag(np.diag(H)), -g).reshape(x.shape)
                tried = self.refined(moved, depths)
                new = self.cost(moved, tried)
                if new < cost:
                    break
                damping *= 10
            else:
                break
            gain = 1 - new / cost
            x = moved
            depths = tried
            cost = new
            damping = damping / 10
            if gain < ENOUGH:
                break
        return x

    def searched(self, x: Moves) -> Depths:
        """The best places of all."""
        rig = self.rig(x)
        return [sight.search_depths(rig) for sight in self.sights]

    def refined(self, x: Moves, depths: Depths) -> Depths:
        """The best places about the given ones."""
        rig = self.rig(x)
        return [sight.refine_depths(rig, depth) for sight, depth in zip(self.sights, depths, strict=True)]

    def cost(self, x: Moves, depths: Depths) -> float:
        """Half the sum of squared distances to the masks, plus the cost of moving the cameras."""
        return float(0.5 * sum(self._missed(x, depths)) + 0.5 * self.hold * (x**2).sum())

    def missed_px(self, x: Moves, depths: Depths) -> float:
        """Root mean square distance of the places to the masks."""
        return float(np.sqrt(sum(self._missed(x, depths)) / sum(len(sight.view) for sight in self.sights)))

    def _missed(self, x: Moves, depths: Depths) -> list[float]:
        rig = self.rig(x)
        looks = zip(self.sights, depths, strict=True)
        return [float(sight.sample(rig, depth[:, None]).residuals.sum()) for sight, depth in looks]

    def normal_equations(
        self, x: Moves, depths: Depths
    ) -> tuple[Float64[np.ndarray, "n n"], Float64[np.ndarray, "n"]]:
        """Gauss and Newton's, without the places' own depths, which follow."""
        rig = self.rig(x)
        H = self.hold * np.eye(x.size)
        g = self.hold * x.ravel()
        for sight, depth in zip(self.sights, depths, strict=True):
            J, r = self._rows(sight, rig, depth)
            rows = J.reshape(-1, x.size)
            H += rows.T @ rows
            g += rows.T @ r.ravel()
        return H, g

    def _rows(
        self, sight: LinesOfSight, rig: Rig, depth: Float64[np.ndarray, "point"]
    ) -> tuple[Float64[np.ndarray, "point view view parameter"], Float64[np.ndarray, "point view"]]:
        """What each place is outside of each mask, weighted, and how the cameras change it where its depth follows."""
        seen = sight.sample(rig, depth[:, None])
        place = seen.in_camera[:, 0]
        outside_px = seen.outside_px[:, 0]
        by_place = seen.gradient(rig)[:, 0]
        views = np.arange(len(rig.K))
        J = np.zeros((*outside_px.shape, len(views), CAMERA))
        J[:, views, views] = _by_camera(place, by_place)
        # The line starts in its own camera, which moves the place itself, the other way.
        ray = sight.rays(rig)
        points = np.arange(len(depth))
        own = sight.view
        by_own = np.einsum("pvi,vij,pkj->pvk", by_place, rig.R, rig.R[own])
        J[points, :, own] -= _by_camera((ray * depth[:, None])[:, None], by_own)
        weight = (1 + (outside_px / OUTLIER_PX) ** 2) ** -0.25
        J *= weight[..., None, None] * self.units
        r = outside_px * weight
        along = np.einsum("pvi,pi->pv", by_own, ray) * weight
        along /= np.linalg.norm(along, axis=1, keepdims=True) + 1e-12
        J -= along[:, :, None, None] * np.einsum("pv,pvcn->pcn", along, J)[:, None]
        return J, r - along * (along * r).sum(1, keepdims=True)


def _by_camera(
    place: Float64[np.ndarray, "point #view 3"], by_place: Float64[np.ndarray, "point view 3"]
) -> Float64[np.ndarray, "point view parameter"]:
    """Derivatives by a camera's parameters of a value whose derivative by a place in its frame is known."""
    place = np.broadcast_to(place, by_place.shape)
    by_focal = (by_place[..., :2] * place[..., :2]).sum(-1, keepdims=True)
    return np.concatenate([np.cross(place, by_place), by_place, by_focal], -1)


@dataclass(frozen=True)
class HeldOutIou:
    """How a hull of the others' masks agrees with the mask of a camera that was left out."""

    camera: str
    before: float
    """Intersection over union of its silhouette and the mask, with the cameras as given."""
    after: float
    """The same, with the other cameras refined by their masks alone and this camera unchanged."""


def refined_without(
    frames: Sequence[MultiViewFrame], name: str, bounds: Bounds | None, hold: float
) -> HeldOutIou:
    """Refine all cameras but one, and look at the hull through that one."""
    others = [frame.without([name]) for frame in frames]
    held = [frame.select([name]) for frame in frames]
    refined = refined_all(others, bounds, hold).cameras
    before, after = (_iou(others, held, cameras, bounds) for cameras in (others[0].cameras, refined))
    return HeldOutIou(name, before, after)


def missed_px(frames: Sequence[MultiViewFrame], left: int, bounds: Bounds | None, hold: float) -> float:
    """What outlines miss at the time `frames[left]`, pixels, root mean square, with cameras refined by the others."""
    refined = refined_all([frame for time, frame in enumerate(frames) if time != left], bounds, hold).cameras
    sight = lines_of_sight(frames[left], _around_subject(frames[left], bounds))
    return float(np.sqrt(sight.least_residuals(Rig.from_cameras(refined)).mean()))


def refined_all(frames: Sequence[MultiViewFrame], bounds: Bounds | None, hold: float) -> Refinement:
    """Refine all cameras of the frames; `bounds` are the capture's, where it has any, `hold` one of `HOLDS`."""
    return refine_by_silhouettes(frames, [_around_subject(frame, bounds) for frame in frames], hold)


def best_hold(frames: Sequence[MultiViewFrame], bounds: Bounds | None) -> float:
    """The one of `HOLDS` that serves left-out frames best; with a single frame, left-out cameras."""
    if len(frames) > 1:
        times = range(min(LEFT_OUT_TIMES, len(frames)))
        return min(HOLDS, key=lambda hold: sum(missed_px(frames, time, bounds, hold) for time in times))
    names = left_out(frames[0].cameras.names)
    return max(
        HOLDS, key=lambda hold: sum(refined_without(frames, name, bounds, hold).after for name in names)
    )


def left_out(names: Sequence[str]) -> list[str]:
    """The cameras to leave out in turn."""
    count = min(LEFT_OUT, len(names))
    return [names[len(names) * number // count] for number in range(count)]


def _around_subject(frame: MultiViewFrame, bounds: Bounds | None) -> Bounds:
    assert frame.mask is not None
    found = reconstruct(frame.mask, frame.cameras, bounds).bounds
    return Bounds(found.low - MARGIN * found.size_m, found.high + MARGIN * found.size_m)


def _iou(
    others: Sequence[MultiViewFrame], held: Sequence[MultiViewFrame], cameras: Cameras, bounds: Bounds | None
) -> float:
    scores = []
    for frame, own in zip(others, held, strict=True):
        assert frame.mask is not None and own.mask is not None
        proxy = reconstruct(frame.mask, cameras, bounds)
        scores.append(float(silhouette_iou(proxy.depth(own.cameras) > 0, own.mask).nan_to_num(1.0).mean()))
    return sum(scores) / len(scores)
