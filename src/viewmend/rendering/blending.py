"""Image-based blending of a few cameras on the surface of a novel view (RIFTCast, section 3.3)."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F
from torch.nn.functional import normalize

from viewmend.geometry.cameras import Cameras, pixel_centers, project, unproject
from viewmend.geometry.sampling import bilinear_taps, in_view
from viewmend.geometry.threads import parallel_for
from viewmend.types import ContextViews

GRAZING = 0.1
"""The slope term of the depth test stays constant below this cosine between normal and camera."""
ROWS = 16
"""A thread's task on the CPU has this many rows of the novel view; few, because the subject
fills only some."""


@dataclass(frozen=True, kw_only=True)
class BlendConfig:
    """Weight of a camera's colour at a surface point.

    weight = usable * (n . v)^normal_power * (cosine between camera and viewer)^view_power

    where `usable` is the bilinear weight of those of the four pixels around the sample that are
    foreground and visible.
    """

    normal_power: int = 2
    """Exponent of the cosine between the surface's normal and the direction to the camera."""
    view_power: int = 16
    """Exponent of the cosine between the directions to the camera and to the viewer."""
    depth_bias: float = 0.005
    """A point is hidden if it lies this far behind the proxy's depth, as a fraction of the subject's size."""
    slope_px: float = 1.0
    """Added to the bias on oblique surfaces: the change of depth over this many pixels of the camera."""


@dataclass(frozen=True)
class Blend:
    """Blended colour, weights and disagreement of the source cameras in each pixel of a novel view."""

    rgb: Float[Tensor, "3 height width"]
    """Weighted mean of the samples, in [0, 1]; black where no camera has weight."""
    weights: Float[Tensor, "source height width"]
    """Raw weights, not normalised."""
    disagreement: Float[Tensor, "height width"]
    """Weighted standard deviation of the samples, mean of the channels; 0 for a single camera."""

    @cached_property
    def total_weight(self) -> Float[Tensor, "height width"]:
        """The sum of the weights."""
        return self.weights.sum(0)


def blend(
    camera: Cameras,
    depth: Float[Tensor, "height width"],
    normals: Float[Tensor, "height width 3"],
    sources: ContextViews,
    bias_m: float,
    config: BlendConfig,
) -> Blend:
    """Colour the surface visible in `camera` from the images of `sources`.

    Samples are bilinear. Of the four pixels only those count that are foreground (by the soft mask)
    and from which the point is visible, so that neither background nor an occluder's rim bleeds in.
    A camera does not contribute to points behind it, outside its image, or facing away from it.

    Args:
        camera: the novel view (one).
        depth: z-depth of its surface, metres, 0 where there is none.
        normals: outward, of any length, world axes.
        sources: the source cameras, with the proxy's depth in each.
        bias_m: tolerance of the depth test, metres.
        config: exponents and tolerances.
    """
    blend_on = _blend_cpu if depth.device.type == "cpu" else blend_torch
    return blend_on(camera, depth, normals, sources, bias_m, config)


def _blend_cpu(
    camera: Cameras,
    depth: Float[Tensor, "height width"],
    normals: Float[Tensor, "height width 3"],
    sources: ContextViews,
    bias_m: float,
    config: BlendConfig,
) -> Blend:
    """`blend` by the kernel in numba."""
    from viewmend.rendering._blend_numba import blend_rows

    frame = sources.frame
    rig = frame.cameras
    height = len(depth)

    # the novel view's rays, and the cameras' projections
    pose = camera.world_from_camera[0].double()
    world_from_pixel = pose[:3, :3] @ torch.linalg.inv(camera.K[0].double())
    mask = torch.zeros(0, 0, 0, dtype=torch.uint8) if frame.mask is None else frame.mask
    inputs = (
        depth.numpy(),
        normals.numpy(),
        world_from_pixel.numpy(),
        pose[:3, 3].numpy(),
        frame.rgb.numpy(),
        mask.numpy(),
        sources.depth.numpy(),
        rig.projection.numpy(),
        rig.centers.double().numpy(),
        rig.K[:, 0, 0].double().numpy(),
        rig.size_px.numpy(),
        np.array([bias_m, config.slope_px, GRAZING]),
        np.array([config.normal_power, config.view_power]),
    )

    # bands of rows, shared among the threads
    blended = Blend(
        torch.zeros(3, *depth.shape), torch.zeros(len(rig), *depth.shape), torch.zeros(depth.shape)
    )
    outputs = (blended.rgb.numpy(), blended.weights.numpy(), blended.disagreement.numpy())

    def work(band: int) -> None:
        blend_rows(band * ROWS, min(height, (band + 1) * ROWS), *inputs, *outputs)

    parallel_for(work, -(-height // ROWS))
    return blended


def blend_torch(
    camera: Cameras,
    depth: Float[Tensor, "height width"],
    normals: Float[Tensor, "height width 3"],
    sources: ContextViews,
    bias_m: float,
    config: BlendConfig,
) -> Blend:
    """`blend` in torch, for any device."""
    # the points of all pixels, those without a surface at depth 1: to find the others would wait
    # for the device
    uv_px = pixel_centers(depth.shape[1], depth.shape[0], depth.device).view(1, -1, 2)
    covered = depth.flatten() > 0
    points = unproject(uv_px, F.threshold(depth.flatten(), 0.0, 1.0)[None], camera)[0]
    directions = normalize(torch.stack([normals.flatten(0, 1), camera.centers[0] - points], 1), dim=-1)

    # each camera's colour and weight there
    weight, colour = _sample(points, directions, sources, bias_m, config)
    weight = weight * covered

    # their weighted mean and variance
    total = weight.sum(0).clamp(min=torch.finfo(weight.dtype).tiny)
    mean = (weight[:, None] * colour).sum(0) / total
    variance = (weight * (colour - mean).square().mean(1)).sum(0) / total
    return Blend(mean.view(3, *depth.shape), weight.view(-1, *depth.shape), variance.sqrt().view(depth.shape))


def _sample(
    points: Float[Tensor, "point 3"],
    directions: Float[Tensor, "point 2 3"],
    sources: ContextViews,
    bias_m: float,
    config: BlendConfig,
) -> tuple[Float[Tensor, "view point"], Float[Tensor, "view 3 point"]]:
    """Weight and colour of each camera at each surface point; `directions` are the normal and that to the viewer."""
    frame = sources.frame
    rig = frame.cameras
    uv, z = project(points, rig)
    to_camera = normalize(rig.centers[:, None] - points, dim=-1)
    facing, agreeing = (directions @ to_camera.movedim(0, 2)).clamp(0, 1).movedim(0, 2).unbind(0)

    # Change of depth of a surface at this angle from one pixel of the camera to the next.
    focal = rig.K[:, 0, 0, None]
    per_pixel = z / focal * (1 - facing.square()).sqrt() / facing.clamp(min=GRAZING)
    farthest = bias_m + config.slope_px * per_pixel

    # of the four pixels around each sample, only visible foreground counts
    taps = bilinear_taps(uv, rig)
    view = torch.arange(len(rig), device=z.device)[:, None]
    depth = sources.depth[view, taps.row, taps.column]
    share = taps.weight * ((depth == 0) | (z - depth <= farthest))
    if frame.mask is not None:
        share = share * (frame.mask[view, taps.row, taps.column] / 255)
    rgb = frame.rgb.movedim(1, -1)[view, taps.row, taps.column]
    colour = (share[..., None] * rgb).sum(0)
    usable = share.sum(0)
    weight = in_view(uv, z, rig) * usable * facing**config.normal_power * agreeing**config.view_power
    return weight, (colour / (255 * usable).clamp(min=1e-6)[..., None]).movedim(-1, 1)
