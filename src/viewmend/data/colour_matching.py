"""Colour matching of a rig: one affine RGB map per camera, fitted on surface points that several cameras see.

The maps are fitted jointly by iteratively reweighted least squares (Huber, "Robust estimation of a
location parameter", 1964; for overlapping photographs: Brown and Lowe, "Automatic panoramic image
stitching", 2007, section 4), so that all cameras agree on the colour of a point. The mean map is
the identity, because no camera is known to be right. `SurfacePoints` and `best_agreement` are also
used by the capture checks.
"""

from collections.abc import Collection
from dataclasses import dataclass, replace

import torch
from einops import rearrange
from jaxtyping import Bool, Float, Shaped, UInt8
from torch import Tensor

from viewmend.data.source import limit_size
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import project
from viewmend.geometry.hull import HullConfig
from viewmend.geometry.proxy import GeometryProxy, reconstruct
from viewmend.geometry.sampling import in_view, sample_bilinear
from viewmend.types import MultiViewFrame

MAX_POINTS = 6000
"""Maximum number of surface points."""
MIN_COSINE = 0.35
"""Smallest cosine between a surface's normal and the direction to a camera that is used."""
MIN_MASK = 0.99
"""Points with a lower mask value are too close to the outline."""
DEPTH_TOLERANCE = 0.01
"""A point is occluded if it lies farther than this behind the proxy's depth, relative to the
subject's size."""
MIN_SHARED_POINTS = 80
"""Points that two cameras must share to be compared."""

LONGEST_PX = 256
"""Images are reduced to this size, in which the error of the hull is only a few pixels."""
HULL = HullConfig(resolution=64)
"""The hull whose surface is compared."""
MIN_CAMERAS = 4
"""Smallest rig that is matched: fewer cameras share too little surface to validate the maps."""
INLIER = 0.03
"""Colours farther from the mean get less weight: highlights, and surface that the hull misplaces."""
CLIPPED = 0.98
"""Values above are saturated."""
IDENTITY_WEIGHT = 1e-4
"""Weight of the regularisation towards the identity, relative to the number of points."""
ITERATIONS = 8
"""The maps are fitted this many times with new weights."""
FOLDS = 4
"""Cross-validation folds. Points are in spatial order, so each fold is another part of the surface."""
MAX_RATIO = 0.9
"""Maps are used if they reduce the disagreement on held-out points to less than this share."""
MAX_ODD = 2.0
"""A camera with an odd image gets a map if, with it, it disagrees with the others at most this many times as
much as they disagree among themselves."""
MIN_DISAGREEMENT = 0.012
"""A smaller disagreement is not corrected, as the error of the hull alone causes that much."""
TINY = 1e-9
"""Sums of weights are at least this, so that none is divided by 0."""

Maps = Float[Tensor, "view 3 4"]
Colours = Float[Tensor, "view point 3"]


@dataclass(frozen=True)
class SurfaceColours:
    """Colours of surface points in every camera."""

    rgb: Float[Tensor, "view point 3"]
    """Colours as stored in the images, in [0, 1]."""
    seen: Bool[Tensor, "view point"]
    """Whether a camera sees the point well."""


@dataclass(frozen=True)
class SurfacePoints:
    """Surface points, projected to every camera."""

    uv_px: Float[Tensor, "view point 2"]
    seen: Bool[Tensor, "view point"]
    """Whether a camera sees the point well."""

    @classmethod
    def from_proxy(cls, frame: MultiViewFrame, proxy: GeometryProxy) -> "SurfacePoints":
        """Select points of the proxy's surface and project them to all cameras of a frame with masks."""
        assert frame.mask is not None, "a proxy needs masks"
        step = max(1, len(proxy.mesh.vertices) // MAX_POINTS)
        points = proxy.mesh.vertices[::step]
        normals = proxy.normals[::step]
        uv, z = project(points, frame.cameras)
        depth = proxy.depth(frame.cameras)
        height, width = depth.shape[1:]
        column, row = uv.floor().long().unbind(-1)
        view = torch.arange(len(uv), device=uv.device)[:, None]
        nearest = depth[view, row.clamp(0, height - 1), column.clamp(0, width - 1)]
        opacity = sample_bilinear(frame.mask[:, None].float() / 255, uv, "border")[..., 0]
        to_camera = torch.nn.functional.normalize(frame.cameras.centers[:, None] - points, dim=-1)
        margin = DEPTH_TOLERANCE * float(proxy.bounds.size_m.norm())
        seen = in_view(uv, z, frame.cameras) & (nearest > 0) & (z <= nearest + margin)
        return cls(uv, seen & ((normals * to_camera).sum(-1) > MIN_COSINE) & (opacity > MIN_MASK))

    def colours(self, rgb: UInt8[Tensor, "view 3 height width"]) -> SurfaceColours:
        """Sample images of these cameras at the points."""
        return SurfaceColours(sample_bilinear(rgb.float() / 255, self.uv_px, "border"), self.seen)


@dataclass(frozen=True)
class BestAgreement:
    """How well each camera's colours agree with the other camera that they agree with best.

    A faulty camera disagrees with all others; a correct one does not. Values are NaN where too few
    points are shared.
    """

    distance: Float[Tensor, "view"]
    """The smallest RMS distance of RGB from another camera, over the points that both see."""
    correlation: Float[Tensor, "view"]
    """The highest correlation with another camera."""
    peer_distance: Float[Tensor, "view"]
    """The smallest distance of the camera of `distance` from a third one."""


def best_agreement(colours: SurfaceColours) -> BestAgreement:
    """Compare each camera's colours with those of all others."""
    shared = zip(colours.rgb, colours.seen[:, None] & colours.seen, strict=True)
    pairs = [compare(own, both, colours, view) for view, (own, both) in enumerate(shared)]
    distances, correlations = (torch.stack(values) for values in zip(*pairs, strict=True))
    peer = distances.nan_to_num(torch.inf).argmin(1)
    of_peer = distances[peer].fill_diagonal_(torch.nan)
    return BestAgreement(_least(distances), -_least(-correlations), _least(of_peer))


def compare(
    own: Float[Tensor, "point 3"], shared: Bool[Tensor, "view point"], others: SurfaceColours, view: int
) -> tuple[Float[Tensor, "view"], Float[Tensor, "view"]]:
    """RMS distance of RGB, and correlation, of the colours `own` with each camera's, over shared points.

    NaN for the camera `view`, whose colours they are, and for cameras that share too few points.
    """
    both = shared.float()
    both[view] = 0
    count = both.sum(1)
    enough = count >= MIN_SHARED_POINTS
    both = both[enough, :, None]
    count = count[enough, None, None]
    rgb = others.rgb[enough]
    a, b = (x - (x * both).sum(1, keepdim=True) / count for x in (own.expand_as(rgb), rgb))
    products = [(x * y * both).sum((1, 2)) for x, y in ((a, b), (a, a), (b, b))]
    distance = own.new_full(enough.shape, torch.nan)
    distance[enough] = (((own - rgb).square() * both).sum((1, 2)) / (3 * count[:, 0, 0])).sqrt()
    correlation = own.new_full(enough.shape, torch.nan)
    correlation[enough] = products[0] / (products[1] * products[2]).sqrt().clamp(min=1e-6)
    return distance, correlation


def _least(values: Float[Tensor, "view other"]) -> Float[Tensor, "view"]:
    """The smallest value of each row; NaN where all are."""
    least = values.nan_to_num(torch.inf).amin(1)
    return torch.where(least.isfinite(), least, torch.nan)


@dataclass(frozen=True)
class ColourMatch:
    """Colour maps of the cameras of a rig, and the disagreement without and with them."""

    names: tuple[str, ...]
    """The cameras that have a map."""
    maps: Maps
    """Matrices that map (r, g, b, 1) to (r, g, b), values in [0, 1]."""
    before: float
    """Mean RGB distance of the colours of a point to their mean."""
    after: float
    """The same after matching, on points that the maps were not fitted to."""

    @property
    def helps(self) -> bool:
        """Whether the cameras agree better on held-out points."""
        return self.before > MIN_DISAGREEMENT and self.after < MAX_RATIO * self.before

    @property
    def summary(self) -> str:
        """What was changed, for the user."""
        return (
            f"matched the colours of {len(self.names)} cameras: their mean disagreement on the same surface fell from "
            f"{100 * self.before:.1f} % to {100 * self.after:.1f} %; use --no-match-colours to keep the originals"
        )

    def apply(self, frame: MultiViewFrame) -> MultiViewFrame:
        """Correct the colours of a frame; cameras without a map are unchanged."""
        rgb = frame.rgb.clone()
        for view, name in enumerate(frame.cameras.names):
            if name in self.names:
                own = self.maps[self.names.index(name)].to(rgb.device)
                values = own[:, :3] @ rgb[view].flatten(1).float() + 255 * own[:, 3:]
                rgb[view] = values.round().clamp(0, 255).to(torch.uint8).view_as(rgb[view])
        return replace(frame, rgb=rgb)


def match_colours(
    frame: MultiViewFrame, bounds: Bounds | None, odd: Collection[str] = ()
) -> ColourMatch | None:
    """Fit colour maps to the cameras of one frame with masks; None if too few cameras share surface.

    `odd` cameras have no effect on the others: they are matched to them afterwards, if a map can do it.
    """
    small = limit_size(frame, LONGEST_PX)
    if small.mask is None or len(small.cameras) < MIN_CAMERAS:
        return None
    try:
        proxy = reconstruct(small.mask, small.cameras, bounds, HULL)
    except ValueError:
        return None
    colours = SurfacePoints.from_proxy(small, proxy).colours(small.rgb)
    seen = colours.seen & (colours.rgb.amax(-1) < CLIPPED)
    seen &= seen.sum(0) > 1
    enough = seen.sum(1) >= MIN_SHARED_POINTS
    if int(enough.sum()) < MIN_CAMERAS:
        return None
    is_odd = torch.tensor([name in odd for name in small.cameras.names]).to(enough)
    is_good = enough & ~is_odd
    good = SurfaceColours(colours.rgb[is_good].double(), seen[is_good])
    if len(good.rgb) < MIN_CAMERAS:
        return None
    before, after = _cross_validate(good)
    maps = _fit(good.rgb, good.seen)

    # The maps of good cameras, and of odd ones that a map makes agree with them
    matched = _map(good.rgb, maps)
    map_of_view = dict(zip(is_good.nonzero()[:, 0].tolist(), maps, strict=True))
    for view in (enough & is_odd).nonzero()[:, 0].tolist():
        odd_map = _fit_to(matched, good.seen, colours.rgb[view].double(), seen[view], after)
        if odd_map is not None:
            map_of_view[view] = odd_map
    views = sorted(map_of_view)
    names = tuple(small.cameras.names[view] for view in views)
    return ColourMatch(names, torch.stack([map_of_view[view] for view in views]).float(), before, after)


def _fit_to(
    matched: Colours,
    seen: Bool[Tensor, "view point"],
    rgb: Float[Tensor, "point 3"],
    own: Bool[Tensor, "point"],
    typical: float,
) -> Float[Tensor, "3 4"] | None:
    """The map of one more camera to the mean colours of cameras that are matched; None if no map makes it agree."""
    both = own & seen.any(0)
    mean = ((seen[..., None] * matched).sum(0) / seen.sum(0).clamp(min=1)[:, None])[both]
    values = torch.cat([rgb, torch.ones_like(rgb[:, :1])], -1)[both]
    if len(values) < MIN_SHARED_POINTS:
        return None
    found = torch.linalg.lstsq(values, mean).solution.mT
    return found if float((values @ found.mT - mean).norm(dim=-1).mean()) <= MAX_ODD * typical else None


def _cross_validate(colours: SurfaceColours) -> tuple[float, float]:
    """Mean disagreement as it is, and with maps fitted to the other folds."""
    before = []
    after = []
    fold = torch.arange(colours.rgb.shape[1]) * FOLDS // colours.rgb.shape[1]
    for number in range(FOLDS):
        rgb = colours.rgb[:, fold == number]
        seen = colours.seen[:, fold == number]
        maps = _fit(colours.rgb[:, fold != number], colours.seen[:, fold != number])
        before.append(_disagreement(rgb, seen)[seen])
        after.append(_disagreement(_map(rgb, maps), seen)[seen])
    return float(torch.cat(before).mean()), float(torch.cat(after).mean())


def _disagreement(rgb: Colours, weight: Shaped[Tensor, "view point"]) -> Float[Tensor, "view point"]:
    """Distance of each colour from the weighted mean of its point."""
    mean = (weight[..., None] * rgb).sum(0) / weight.sum(0).clamp(min=TINY)[:, None]
    return (rgb - mean).norm(dim=-1)


def _fit(rgb: Colours, seen: Bool[Tensor, "view point"]) -> Maps:
    """The maps that minimise the disagreement of all points that two cameras or more see."""
    seen = seen & (seen.sum(0) > 1)
    values = torch.cat([rgb, torch.ones_like(rgb[..., :1])], -1)
    weight = seen.to(rgb)
    maps = _solve(values, weight)
    for _ in range(ITERATIONS):
        weight = seen / (_disagreement(_map(rgb, maps), weight) / INLIER).clamp(min=1)
        maps = _solve(values, weight)
    return maps


def _solve(values: Float[Tensor, "view point 4"], weight: Float[Tensor, "view point"]) -> Maps:
    """Weighted least squares of the distances to each point's weighted mean, which depends on the maps too."""
    views, points = weight.shape
    share = weight / weight.sum(0).clamp(min=TINY).sqrt()
    each = rearrange(share[..., None] * values, "view point k -> point (view k)")
    normal = torch.block_diag(*(values.mT @ (weight[..., None] * values))) - each.mT @ each
    regularisation = IDENTITY_WEIGHT * points * torch.eye(4 * views).to(normal)
    identity = torch.eye(4).to(normal).repeat(views, 1)
    mean = torch.eye(4).to(normal).repeat(1, views)
    constraint = torch.cat([mean, mean.new_zeros(4, 4)], 1)  # the mean map is the identity
    system = torch.cat([torch.cat([normal + regularisation, mean.mT], 1), constraint])
    change = torch.linalg.solve(system, torch.cat([-normal @ identity[:, :3], identity.new_zeros(4, 3)]))[
        : 4 * views
    ]
    return rearrange(identity[:, :3] + change, "(view k) channel -> view channel k", k=4)


def _map(rgb: Colours, maps: Maps) -> Colours:
    return rgb @ maps[..., :3].mT + maps[..., 3][:, None]
