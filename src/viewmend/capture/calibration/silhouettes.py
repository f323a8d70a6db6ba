"""Cameras refined by silhouettes: the line of sight of each point of an outline must touch what all others see.

A point of an outline lies on the subject's surface. So somewhere along its line of sight there is a place that no other
camera sees outside of its mask. How far outside the best one is, in pixels, is what the calibration misses (after
Hernandez, Schmitt and Cipolla, "Silhouette coherence for camera calibration under circular motion", PAMI 2007, and
Boyer, "On using silhouettes for camera calibration", ACCV 2006). Gauss and Newton's method moves all cameras, and each
place along its line, until little is missed. No surface is carved, so that parts of a pixel count.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float64

from viewmend.capture.calibration.gauge import brought_to
from viewmend.capture.calibration.sight import OUTLIER_PX, Rig, Sight
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras
from viewmend.views import MultiViewFrame

LEAST_CAMERAS = 3
"""Fewer say nothing of each other: wherever two cameras stand, there are places that both see inside of their masks."""
CAMERA = 7
"""Parameters of a camera: rotation, translation, focal length; each in pixels that it moves what is seen."""
HOLDS = (1e-3, 0.1)
"""How strongly cameras are held where they are, beside what the outlines say: these cannot tell all. The second is for
few times and hard masks; cameras that are left out say which is better."""
SEARCHES, STEPS, ENOUGH = 6, 6, 0.02
"""So often places are searched anew, with so many steps in between at most; less is enough where one gains less than
this share of what is missed."""
DAMPING, MOST_DAMPING = 1e-3, 1e4
"""Levenberg and Marquardt's, at the start, and where no smaller step would help."""

Moves = Float64[np.ndarray, "view parameter"]
Depths = list[Float64[np.ndarray, "_point"]]
"""The z-depth of each line of sight's place, for each time."""


@dataclass(frozen=True)
class Refinement:
    """Refined cameras, and what they miss."""

    cameras: Cameras
    before_px: float
    """How far a line of sight of an outline is outside the other masks at best, root mean square, as calibrated."""
    after_px: float
    """The same, refined."""


def refine_by_silhouettes(frames: Sequence[MultiViewFrame], bounds: Sequence[Bounds], hold: float) -> Refinement:
    """Refine poses and focal lengths of cameras; several times tell more than one.

    The rig as a whole stays where it was, and as large.

    Args:
        frames: some times with masks, of the same cameras, `LEAST_CAMERAS` or more.
        bounds: a box around the subject at each time.
        hold: one of `HOLDS`.

    Raises:
        CaptureError: a frame has no masks, or none has any foreground.
    """
    cameras = frames[0].cameras
    sights = [Sight.of(frame, box) for frame, box in zip(frames, bounds, strict=True)]
    problem = _Problem(sights, Rig.of(cameras), hold)
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


class _Problem:
    """What the outlines of some times say of the cameras, as functions of how far these are moved."""

    def __init__(self, sights: Sequence[Sight], start: Rig, hold: float):
        self.sights, self.start = sights, start
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
        from scipy.spatial.transform import Rotation

        by = x * self.units
        turn = Rotation.from_rotvec(by[:, :3]).as_matrix()
        K = self.start.K.copy()
        K[:, [0, 1], [0, 1]] *= np.exp(by[:, 6:])
        t = np.einsum("vij,vj->vi", turn, self.start.t) + by[:, 3:6]
        return Rig(K, turn @ self.start.R, t)

    def solved(self, x: Moves, depths: Depths) -> Moves:
        """The moves at which least is missed, of places near the given ones (Levenberg and Marquardt)."""
        cost, damping = self.cost(x, depths), DAMPING
        for _ in range(STEPS):
            H, g = self.normal_equations(x, depths)
            while damping < MOST_DAMPING:
                moved = x + np.linalg.solve(H + damping * np.diag(np.diag(H)), -g).reshape(x.shape)
                tried = self.refined(moved, depths)
                if (new := self.cost(moved, tried)) < cost:
                    break
                damping *= 10
            else:
                break
            gain, x, depths, cost, damping = 1 - new / cost, moved, tried, new, damping / 10
            if gain < ENOUGH:
                break
        return x

    def searched(self, x: Moves) -> Depths:
        """The best places of all."""
        rig = self.rig(x)
        return [sight.searched(rig) for sight in self.sights]

    def refined(self, x: Moves, depths: Depths) -> Depths:
        """The best places about the given ones."""
        rig = self.rig(x)
        return [sight.refined(rig, depth) for sight, depth in zip(self.sights, depths, strict=True)]

    def cost(self, x: Moves, depths: Depths) -> float:
        """What all places are outside of masks, half of its squares, and what it costs to be moved."""
        return float(0.5 * sum(self._missed(x, depths)) + 0.5 * self.hold * (x**2).sum())

    def missed_px(self, x: Moves, depths: Depths) -> float:
        """Root mean square of what the places are outside of masks."""
        return float(np.sqrt(sum(self._missed(x, depths)) / sum(len(sight.view) for sight in self.sights)))

    def _missed(self, x: Moves, depths: Depths) -> list[float]:
        rig = self.rig(x)
        looks = zip(self.sights, depths, strict=True)
        return [float(sight.look(rig, depth[:, None]).missed.sum()) for sight, depth in looks]

    def normal_equations(
        self, x: Moves, depths: Depths
    ) -> tuple[Float64[np.ndarray, "unknown unknown"], Float64[np.ndarray, "unknown"]]:
        """Gauss and Newton's, without the places' own depths, which follow."""
        rig = self.rig(x)
        H, g = self.hold * np.eye(x.size), self.hold * x.ravel()
        for sight, depth in zip(self.sights, depths, strict=True):
            J, r = self._rows(sight, rig, depth)
            rows = J.reshape(-1, x.size)
            H += rows.T @ rows
            g += rows.T @ r.ravel()
        return H, g

    def _rows(
        self, sight: Sight, rig: Rig, depth: Float64[np.ndarray, "point"]
    ) -> tuple[Float64[np.ndarray, "point view view parameter"], Float64[np.ndarray, "point view"]]:
        """What each place is outside of each mask, weighted, and how the cameras change it where its depth follows."""
        seen = sight.look(rig, depth[:, None])
        place, outside_px = seen.in_camera[:, 0], seen.outside_px[:, 0]
        by_place = seen.by_place(rig)[:, 0]
        views = np.arange(len(rig.K))
        J = np.zeros((*outside_px.shape, len(views), CAMERA))
        J[:, views, views] = _by_camera(place, by_place)
        # The line starts in its own camera, which moves the place itself, the other way.
        ray, points, own = sight.rays(rig), np.arange(len(depth)), sight.view
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
