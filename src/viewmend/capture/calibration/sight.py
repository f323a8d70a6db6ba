"""Lines of sight through the points of outlines, and what the other cameras' masks say of each place along them."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int

from viewmend.capture.calibration.outlines import find_outline, look_up
from viewmend.capture.errors import CaptureError
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras
from viewmend.views import MultiViewFrame

POINTS = 120
"""Points of each outline."""
PLACES = 96
"""Places that are tried along each line of sight at first."""
HALVINGS = 4
"""A step from a place that was the best one is halved so often; after a search twice more."""
NEAR_M = 1e-3
"""What is nearer to a camera, or behind it, is not seen."""
OUTLIER_PX = 1.0
"""What is missed by more than this counts less: masks are wrong in places."""


@dataclass(frozen=True)
class Rig:
    """Cameras as arrays of doubles."""

    K: Float64[np.ndarray, "view 3 3"]
    R: Float64[np.ndarray, "view 3 3"]
    t: Float64[np.ndarray, "view 3"]

    @classmethod
    def of(cls, cameras: Cameras) -> "Rig":
        """The same cameras."""
        pose = cameras.camera_from_world.double().cpu().numpy()
        return cls(cameras.K.double().cpu().numpy(), pose[:, :3, :3], pose[:, :3, 3])


@dataclass(frozen=True)
class Seen:
    """Places along lines of sight as all cameras see them."""

    in_camera: Float64[np.ndarray, "point place view 3"]
    """In each camera's frame."""
    outside_px: Float64[np.ndarray, "point place view"]
    """How far outside of each mask; 0 inside, where a camera does not see it, and in the line's own camera."""
    slope: Float64[np.ndarray, "point place view 2"]
    """How that grows to the right and downwards."""

    @property
    def missed(self) -> Float64[np.ndarray, "point place"]:
        """What the place is outside of all masks, squared pixels, of which large ones count less."""
        return 2 * OUTLIER_PX**2 * (np.sqrt(1 + (self.outside_px / OUTLIER_PX) ** 2) - 1).sum(-1)

    def by_place(self, rig: Rig) -> Float64[np.ndarray, "point place view 3"]:
        """How `outside_px` grows when the place moves in each camera's frame."""
        z = np.where(self.in_camera[..., 2:] > NEAR_M, self.in_camera[..., 2:], 1.0)
        across = self.slope * rig.K[:, [0, 1], [0, 1]] / z
        return np.concatenate([across, -(across * self.in_camera[..., :2]).sum(-1, keepdims=True) / z], -1)


@dataclass(frozen=True)
class Sight:
    """The points of all outlines of one time, and all masks as distances to their outlines."""

    view: Int[np.ndarray, "point"]
    """Whose outline it is."""
    uv_px: Float64[np.ndarray, "point 2"]
    outside_px: Float32[np.ndarray, "pixel"]
    """All masks' distances, one after the other."""
    largest_px: tuple[int, int]
    size_px: Int[np.ndarray, "view 2"]
    middle: Float64[np.ndarray, "3"]
    radius_m: float

    @classmethod
    def of(cls, frame: MultiViewFrame, bounds: Bounds, points: int = POINTS) -> "Sight":
        """The sight of one frame, whose subject is in this box, with about so many points of each outline.

        Raises:
            CaptureError: the frame has no masks, or none with an outline.
        """
        if frame.mask is None:
            raise CaptureError("expected frames with masks, got none; make them with viewmend masks")
        width, height = frame.cameras.max_size_px
        distances = np.full((len(frame.cameras), height, width), -1.0, np.float32)
        views, found = [], []
        for view, (w, h) in enumerate(frame.cameras.size_px.tolist()):
            outline = find_outline(frame.mask[view, :h, :w].contiguous().cpu().numpy(), points)
            if outline is not None:
                distances[view, :h, :w] = outline.outside_px
                views.append(np.full(len(outline.points), view))
                found.append(outline.points)
        if not found:
            raise CaptureError("expected a subject's outline in the masks, got none; choose other frames")
        return cls(
            np.concatenate(views),
            np.concatenate(found),
            distances.ravel(),
            (width, height),
            frame.cameras.size_px.cpu().numpy(),
            bounds.center.double().cpu().numpy(),
            0.5 * float(bounds.size_m.norm()),
        )

    def rays(self, rig: Rig) -> Float64[np.ndarray, "point 3"]:
        """Each point's direction in its own camera, z = 1."""
        homogeneous = np.concatenate([self.uv_px, np.ones((len(self.uv_px), 1))], 1)
        return np.einsum("pij,pj->pi", np.linalg.inv(rig.K)[self.view], homogeneous)

    def look(self, rig: Rig, depth: Float64[np.ndarray, "point place"]) -> Seen:
        """The places at these z-depths in their own cameras."""
        own = self.rays(rig)[:, None] * depth[..., None]
        world = np.einsum("pji,pkj->pki", rig.R[self.view], own - rig.t[self.view][:, None])
        in_camera = np.einsum("vij,pkj->pkvi", rig.R, world) + rig.t
        z = in_camera[..., 2]
        homogeneous = np.einsum("vij,pkvj->pkvi", rig.K, in_camera)
        uv = homogeneous[..., :2] / np.where(z > NEAR_M, z, 1.0)[..., None]
        width, height = self.largest_px
        views = np.arange(len(rig.K))
        value, slope = look_up(self.outside_px, views * (width * height), self.largest_px, uv)
        counts = (z > NEAR_M) & (uv > 0).all(-1) & (uv < self.size_px).all(-1) & (value > 0)
        counts &= self.view[:, None, None] != views
        return Seen(in_camera, np.where(counts, value, 0.0), np.where(counts[..., None], slope, 0.0))

    def searched(self, rig: Rig) -> Float64[np.ndarray, "point"]:
        """The z-depth at which each line of sight is least outside of the masks, of those within the box."""
        far = (rig.R @ self.middle + rig.t)[self.view, 2]
        steps = np.linspace(-self.radius_m, self.radius_m, PLACES)
        depth = np.maximum(far[:, None] + steps, NEAR_M)
        best = depth[np.arange(len(far)), self.look(rig, depth).missed.argmin(1)]
        return self.refined(rig, best, halvings=2 + HALVINGS)

    def least_missed(self, rig: Rig) -> Float64[np.ndarray, "point"]:
        """What the best place of each line of sight is outside of all masks, as `Seen.missed`."""
        return self.look(rig, self.searched(rig)[:, None]).missed[:, 0]

    def refined(
        self, rig: Rig, depth: Float64[np.ndarray, "point"], halvings: int = HALVINGS
    ) -> Float64[np.ndarray, "point"]:
        """The best z-depth about the given one."""
        step = 2 * self.radius_m / PLACES / 2 ** (HALVINGS + 2 - halvings)
        for _ in range(halvings):
            tried = depth[:, None] + step * np.array([0.0, -1.0, 1.0])
            depth = tried[np.arange(len(depth)), self.look(rig, tried).missed.argmin(1)]
            step /= 2
        return depth
