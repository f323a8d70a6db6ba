"""Refines cameras by silhouettes: each outline's lines of sight must touch what all other cameras see.

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
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras
from viewmend.geometry.line_of_sight import OUTLIER_PX, LinesOfSight, Rig
from viewmend.geometry.rigid import invert_rigid, rigid
from viewmend.types import MultiViewFrame

Places = Float64[np.ndarray, "point 3"]
MIN_CAMERAS = 3
"""Smallest rig that is refined: two masks alone always have points in common."""
PARAMETERS = 7
"""Number of parameters of a camera: rotation, translation and focal length, each scaled so that 1
moves the image by about a pixel."""
HOLDS = (1e-3, 0.1)
"""Weights of the prior that keeps cameras where they are, since outlines do not determine
everything. The larger one is for few frames and hard masks; held-out cameras decide which
is better."""
SEARCHES = 6
"""Largest number of searches for the best depths on the lines of sight."""
STEPS = 6
"""Largest number of Levenberg-Marquardt steps between two searches."""
MIN_GAIN = 0.02
"""The steps end when one reduces the cost by less than this fraction."""
DAMPING = 1e-3
"""Damping of the first Levenberg-Marquardt step."""
MAX_DAMPING = 1e4
"""The steps end when the damping exceeds this value."""
Moves = Float64[np.ndarray, "view parameter"]
Depths = list[Float64[np.ndarray, "_point"]]
"""The z-depth of the best point on each line of sight, metres, for each frame."""


def align_rig(rig: Cameras, reference: Cameras, points_world: Float[Tensor, "point 3"]) -> Cameras:
    """Rotate, move and scale a rig as a whole so that its cameras agree with `reference` on the points.

    `reference` has the same cameras in the frame that is wanted, in which `points_world` are where
    the subject may be. The rotation, translation and scale are Umeyama's, of the points in each
    camera's own frame (PAMI 1991).
    """
    points = torch.cat([points_world, torch.ones_like(points_world[:, :1])], 1).double()
    in_cameras = (
        points @ reference.camera_from_world.double().mT @ invert_rigid(rig.camera_from_world.double()).mT
    )
    source = in_cameras[..., :3].reshape(-1, 3).cpu().numpy()
    R, t, scale = _similarity(source, points_world.double().repeat(len(rig), 1).cpu().numpy())
    pose = rig.camera_from_world.double()
    turned = pose[:, :3, :3] @ torch.from_numpy(R.T).to(pose)
    moved = scale * pose[:, :3, 3] - turned @ torch.from_numpy(t).to(pose)
    return replace(rig, camera_from_world=rigid(turned, moved).to(rig.camera_from_world))


def _similarity(
    source: Places, target: Places
) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, "3"], float]:
    """Find R, t and s for which s R x + t is nearest to the targets."""
    a = source - source.mean(0)
    b = target - target.mean(0)
    u, s, vt = np.linalg.svd(b.T @ a)
    sign = np.array([1.0, 1.0, np.linalg.det(u) * np.linalg.det(vt)])
    R = (u * sign) @ vt
    scale = float((s * sign).sum() / (a**2).sum())
    return R, target.mean(0) - scale * R @ source.mean(0), scale


@dataclass(frozen=True)
class Refinement:
    """Refined cameras, and the residuals before and after."""

    cameras: Cameras
    before_px: float
    """Root mean square distance of the lines of sight from the other masks, at their best depths,
    before the refinement; pixels."""
    after_px: float
    """The same after the refinement."""


def refine_by_silhouettes(
    frames: Sequence[MultiViewFrame], bounds: Sequence[Bounds], hold: float
) -> Refinement:
    """Refine poses and focal lengths of at least `MIN_CAMERAS` cameras; several frames constrain them better.

    The rig as a whole stays where it was, and as large. `bounds` are boxes around the subject, one
    for each frame; `hold` is one of `HOLDS`. Here and below, a CaptureError is raised for frames
    without masks, and a ValueError for masks without outlines or without a common subject.
    """
    cameras = frames[0].cameras
    sights = [lines_of_sight(frame, box) for frame, box in zip(frames, bounds, strict=True)]
    problem = _Problem(sights, Rig.from_cameras(cameras), hold)
    x = np.zeros((len(cameras), PARAMETERS))
    depths = problem.search(x)
    before_px = problem.residual_px(x, depths)
    for _ in range(SEARCHES):
        cost = problem.cost(x, depths)
        x = problem.solve(x, depths)
        depths = problem.search(x)
        if problem.cost(x, depths) > (1 - MIN_GAIN) * cost:
            break
    rig = problem.rig(x)
    pose = cameras.camera_from_world.clone()
    pose[:, :3] = torch.from_numpy(np.concatenate([rig.R, rig.t[..., None]], 2)).to(pose)
    found = replace(cameras, K=torch.from_numpy(rig.K).to(cameras.K), camera_from_world=pose)
    corners = torch.cat([box.corners for box in bounds])
    return Refinement(align_rig(found, cameras, corners), before_px, problem.residual_px(x, depths))


def lines_of_sight(frame: MultiViewFrame, bounds: Bounds) -> LinesOfSight:
    """Compute the lines of sight through the outlines of one frame's masks."""
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
        self.units = np.empty((len(start.K), PARAMETERS))
        """Parameters that move a camera's image by about a pixel."""
        self.units[:, :3] = (m_per_px / far_m)[:, None]
        self.units[:, 3:6] = m_per_px[:, None]
        self.units[:, 6] = m_per_px / max(sight.radius_m for sight in sights)
        self.hold = hold * sum(len(sight.view) for sight in sights) / len(start.K)

    def rig(self, x: Moves) -> Rig:
        """Move the cameras by `x`."""
        by = x * self.units
        turn = Rotation.from_rotvec(by[:, :3]).as_matrix()
        K = self.start.K.copy()
        K[:, [0, 1], [0, 1]] *= np.exp(by[:, 6:])
        t = np.einsum("vij,vj->vi", turn, self.start.t) + by[:, 3:6]
        return Rig(K, turn @ self.start.R, t)

    def solve(self, x: Moves, depths: Depths) -> Moves:
        """Minimise the cost over the cameras (Levenberg-Marquardt); depths follow from the given ones."""
        cost = self.cost(x, depths)
        damping = DAMPING
        for _ in range(STEPS):
            H, g = self.normal_equations(x, depths)
            while damping < MAX_DAMPING:
                moved = x + np.linalg.solve(H + damping * np.diag(np.diag(H)), -g).reshape(x.shape)
                depths_there = self.refine(moved, depths)
                new = self.cost(moved, depths_there)
                if new < cost:
                    break
                damping *= 10
            else:
                break
            gain = 1 - new / cost
            x = moved
            depths = depths_there
            cost = new
            damping = damping / 10
            if gain < MIN_GAIN:
                break
        return x

    def search(self, x: Moves) -> Depths:
        """Search all depths for the best ones."""
        rig = self.rig(x)
        return [sight.search_depths(rig) for sight in self.sights]

    def refine(self, x: Moves, depths: Depths) -> Depths:
        """Refine the given depths locally."""
        rig = self.rig(x)
        return [sight.refine_depths(rig, depth) for sight, depth in zip(self.sights, depths, strict=True)]

    def cost(self, x: Moves, depths: Depths) -> float:
        """Half the sum of squared residuals, plus the prior."""
        return float(0.5 * sum(self._squared_residuals(x, depths)) + 0.5 * self.hold * (x**2).sum())

    def residual_px(self, x: Moves, depths: Depths) -> float:
        """Root mean square residual, pixels."""
        return float(
            np.sqrt(sum(self._squared_residuals(x, depths)) / sum(len(sight.view) for sight in self.sights))
        )

    def _squared_residuals(self, x: Moves, depths: Depths) -> list[float]:
        rig = self.rig(x)
        pairs = zip(self.sights, depths, strict=True)
        return [float(sight.sample(rig, depth[:, None]).residuals.sum()) for sight, depth in pairs]

    def normal_equations(
        self, x: Moves, depths: Depths
    ) -> tuple[Float64[np.ndarray, "n n"], Float64[np.ndarray, "n"]]:
        """Gauss-Newton's Hessian and gradient for the cameras; the depths, which follow, are eliminated."""
        rig = self.rig(x)
        H = self.hold * np.eye(x.size)
        g = self.hold * x.ravel()
        for sight, depth in zip(self.sights, depths, strict=True):
            J, r = self._linearize(sight, rig, depth)
            rows = J.reshape(-1, x.size)
            H += rows.T @ rows
            g += rows.T @ r.ravel()
        return H, g

    def _linearize(
        self, sight: LinesOfSight, rig: Rig, depth: Float64[np.ndarray, "point"]
    ) -> tuple[Float64[np.ndarray, "point view view parameter"], Float64[np.ndarray, "point view"]]:
        """Linearise the weighted residuals of each line of sight in the cameras' parameters.

        Returns the Jacobian, in which depths follow, and the residuals of each mask.
        """
        seen = sight.sample(rig, depth[:, None])
        place = seen.in_camera[:, 0]
        outside_px = seen.outside_px[:, 0]
        by_place = seen.gradient(rig)[:, 0]
        views = np.arange(len(rig.K))
        J = np.zeros((*outside_px.shape, len(views), PARAMETERS))
        J[:, views, views] = _camera_derivatives(place, by_place)
        # The line starts in its own camera, which moves the place itself, the other way.
        ray = sight.rays(rig)
        points = np.arange(len(depth))
        own = sight.view
        by_own = np.einsum("pvi,vij,pkj->pvk", by_place, rig.R, rig.R[own])
        J[points, :, own] -= _camera_derivatives((ray * depth[:, None])[:, None], by_own)
        weight = (1 + (outside_px / OUTLIER_PX) ** 2) ** -0.25
        J *= weight[..., None, None] * self.units
        r = outside_px * weight
        along = np.einsum("pvi,pi->pv", by_own, ray) * weight
        along /= np.linalg.norm(along, axis=1, keepdims=True) + 1e-12
        J -= along[:, :, None, None] * np.einsum("pv,pvcn->pcn", along, J)[:, None]
        return J, r - along * (along * r).sum(1, keepdims=True)


def _camera_derivatives(
    place: Float64[np.ndarray, "point #view 3"], by_place: Float64[np.ndarray, "point view 3"]
) -> Float64[np.ndarray, "point view parameter"]:
    """Chain rule from the derivative by a point in a camera's frame to that by the camera's parameters."""
    place = np.broadcast_to(place, by_place.shape)
    by_focal = (by_place[..., :2] * place[..., :2]).sum(-1, keepdims=True)
    return np.concatenate([np.cross(place, by_place), by_place, by_focal], -1)
