"""Lines of sight through the points of outlines, and the masks of the other cameras along them."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int, UInt8
from torch import Tensor

from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras
from viewmend.geometry.hull import FOREGROUND

POINTS = 120
"""An outline has about this many points."""
PLACES = 96
"""A search begins with this many places along each line of sight."""
HALVINGS = 4
"""The step around the best place is halved this many times; twice more after a search."""
NEAR_M = 1e-3
"""A camera does not see what is nearer than this, in metres."""
OUTLIER_PX = 1.0
"""Residuals of more than this many pixels count less, because masks are wrong in places."""
FINER = 3
"""Masks are enlarged by this factor, so that soft ones tell parts of a pixel."""
BORDER_PX = 3
"""An outline within this many pixels of its image's border is where the image ends, not the subject."""


@dataclass(frozen=True)
class Rig:
    """Cameras as arrays of doubles."""

    K: Float64[np.ndarray, "view 3 3"]
    R: Float64[np.ndarray, "view 3 3"]
    t: Float64[np.ndarray, "view 3"]

    @classmethod
    def from_cameras(cls, cameras: Cameras) -> "Rig":
        """The same cameras."""
        pose = cameras.camera_from_world.double().cpu().numpy()
        return cls(cameras.K.double().cpu().numpy(), pose[:, :3, :3], pose[:, :3, 3])


@dataclass(frozen=True)
class LineSamples:
    """Places along lines of sight as all cameras see them."""

    in_camera: Float64[np.ndarray, "point place view 3"]
    """The points in each camera's frame, metres."""
    outside_px: Float64[np.ndarray, "point place view"]
    """How far outside of each mask; 0 inside, where a camera does not see it, and in the
    line's own camera."""
    slope: Float64[np.ndarray, "point place view 2"]
    """How that grows to the right and downwards."""

    @property
    def residuals(self) -> Float64[np.ndarray, "point place"]:
        """How far the place is outside of all masks, squared pixels; large distances count less."""
        return 2 * OUTLIER_PX**2 * (np.sqrt(1 + (self.outside_px / OUTLIER_PX) ** 2) - 1).sum(-1)

    def gradient(self, rig: Rig) -> Float64[np.ndarray, "point place view 3"]:
        """How `outside_px` grows when the place moves in each camera's frame."""
        z = np.where(self.in_camera[..., 2:] > NEAR_M, self.in_camera[..., 2:], 1.0)
        across = self.slope * rig.K[:, [0, 1], [0, 1]] / z
        return np.concatenate([across, -(across * self.in_camera[..., :2]).sum(-1, keepdims=True) / z], -1)


@dataclass(frozen=True)
class LinesOfSight:
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
    def from_masks(
        cls, mask: UInt8[Tensor, "view height width"], cameras: Cameras, bounds: Bounds, points: int = POINTS
    ) -> "LinesOfSight":
        """The lines of sight of one frame, whose subject is in this box, with about `points` points per outline.

        Raises:
            ValueError: no mask has an outline.
        """
        width, height = cameras.max_size_px
        distances = np.full((len(cameras), height, width), -1.0, np.float32)
        views = []
        found = []
        for view, (w, h) in enumerate(cameras.size_px.tolist()):
            outline = _find_outline(mask[view, :h, :w].contiguous().cpu().numpy(), points)
            if outline is not None:
                own, distances[view, :h, :w] = outline
                views.append(np.full(len(own), view))
                found.append(own)
        if not found:
            raise ValueError("expected a subject's outline in the masks, got none; choose other frames")
        return cls(
            np.concatenate(views),
            np.concatenate(found),
            distances.ravel(),
            (width, height),
            cameras.size_px.cpu().numpy(),
            bounds.center.double().cpu().numpy(),
            0.5 * float(bounds.size_m.norm()),
        )

    def rays(self, rig: Rig) -> Float64[np.ndarray, "point 3"]:
        """Each point's direction in its own camera, z = 1."""
        return np.einsum("pij,pj->pi", np.linalg.inv(rig.K)[self.view], np.insert(self.uv_px, 2, 1, 1))

    def sample(self, rig: Rig, depth: Float64[np.ndarray, "point place"]) -> LineSamples:
        """The places at these z-depths in their own cameras."""
        own = self.rays(rig)[:, None] * depth[..., None]
        world = np.einsum("pji,pkj->pki", rig.R[self.view], own - rig.t[self.view][:, None])
        in_camera = np.einsum("vij,pkj->pkvi", rig.R, world) + rig.t
        z = in_camera[..., 2]
        homogeneous = np.einsum("vij,pkvj->pkvi", rig.K, in_camera)
        uv = homogeneous[..., :2] / np.where(z > NEAR_M, z, 1.0)[..., None]
        width, height = self.largest_px
        views = np.arange(len(rig.K))
        value, slope = _interpolate(self.outside_px, views * (width * height), self.largest_px, uv)
        counts = (z > NEAR_M) & (uv > 0).all(-1) & (uv < self.size_px).all(-1) & (value > 0)
        counts &= self.view[:, None, None] != views
        return LineSamples(in_camera, np.where(counts, value, 0.0), np.where(counts[..., None], slope, 0.0))

    def search_depths(self, rig: Rig) -> Float64[np.ndarray, "point"]:
        """The z-depth at which each line of sight is least outside of the masks, of those within the box."""
        far = (rig.R @ self.middle + rig.t)[self.view, 2]
        depth = np.maximum(far[:, None] + np.linspace(-self.radius_m, self.radius_m, PLACES), NEAR_M)
        best = depth[np.arange(len(far)), self.sample(rig, depth).residuals.argmin(1)]
        return self.refine_depths(rig, best, halvings=2 + HALVINGS)

    def least_residuals(self, rig: Rig) -> Float64[np.ndarray, "point"]:
        """The residual of the best place of each line of sight, as `LineSamples.residuals`."""
        return self.sample(rig, self.search_depths(rig)[:, None]).residuals[:, 0]

    def refine_depths(
        self, rig: Rig, depth: Float64[np.ndarray, "point"], halvings: int = HALVINGS
    ) -> Float64[np.ndarray, "point"]:
        """The best z-depth about the given one."""
        step = 2 * self.radius_m / PLACES / 2 ** (HALVINGS + 2 - halvings)
        for _ in range(halvings):
            tried = depth[:, None] + step * np.array([0.0, -1.0, 1.0])
            depth = tried[np.arange(len(depth)), self.sample(rig, tried).residuals.argmin(1)]
            step /= 2
        return depth


def _find_outline(
    mask: UInt8[np.ndarray, "height width"], count: int
) -> tuple[Float64[np.ndarray, "point 2"], Float32[np.ndarray, "height width"]] | None:
    """Find points on the foreground's outline, and how far outside of it each pixel's centre is.

    Returns about `count` points, evenly spaced along the outline. Distances are negative inside;
    the result is None without an outline.
    """
    import cv2

    height, width = mask.shape
    large = cv2.resize(mask, None, fx=FINER, fy=FINER, interpolation=cv2.INTER_LINEAR)
    inside = (large > FOREGROUND).astype(np.uint8)
    if not inside.any() or inside.all():
        return None
    away = cv2.distanceTransform(1 - inside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    within = cv2.distanceTransform(inside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    outside_px = cv2.resize((away - within) / FINER, (width, height), interpolation=cv2.INTER_AREA)
    contours = cv2.findContours(inside, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]
    along = np.concatenate([contour[:, 0] for contour in contours]).astype(np.float64)
    points = (along + 0.5) / FINER  # half a small pixel inside of the outline
    points = points[((points > BORDER_PX) & (points < np.array([width, height]) - BORDER_PX)).all(1)]
    points = points[:: max(1, len(points) // count)]
    value, slope = _interpolate(outside_px.ravel(), np.zeros(len(points), int), (width, height), points)
    return points - value[:, None] * slope / np.maximum((slope**2).sum(1, keepdims=True), 0.25), outside_px


def _interpolate(
    flat: Float32[np.ndarray, "_pixel"],
    first: np.ndarray,
    size: tuple[int, int],
    uv_px: Float64[np.ndarray, "*point 2"],
) -> tuple[np.ndarray, np.ndarray]:
    """Bilinear values at pixel positions (beyond the border the nearest of it), and their slopes in x and y.

    `flat` has the pixels of all images; the image of a position begins at `first`, and `size` is
    its width and height.
    """
    width, height = size
    x = np.clip(uv_px[..., 0] - 0.5, 0, width - 1.001)
    y = np.clip(uv_px[..., 1] - 0.5, 0, height - 1.001)
    left = x.astype(int)
    top = y.astype(int)
    right = x - left
    below = y - top

    # the four pixels around, row by row
    at = first + top * width + left
    a = flat[at]
    b = flat[at + 1]
    c = flat[at + width]
    d = flat[at + width + 1]

    upper = a + right * (b - a)
    lower = c + right * (d - c)
    slope_x = (b - a) + below * ((d - c) - (b - a))
    return upper + below * (lower - upper), np.stack([slope_x, lower - upper], -1)
