"""Image-based blending of a few cameras on the surface of a novel view (RIFTCast, section 3.3)."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from viewmend.geometry.cameras import Cameras
from viewmend.geometry.threads import parallel_for
from viewmend.types import ContextViews
from viewmend.utils.tensors import OnDevice

GRAZING = 0.1
"""Cosine below which the slope term of the depth test stays constant."""
ROWS = 16
"""Rows of the novel view per thread task on the CPU; few, because the subject fills only some of them."""


@dataclass(frozen=True, kw_only=True)
class BlendConfig:
    """Weight of a camera's colour at a surface point.

    weight = usable * (n . v)^normal_power * (cosine between camera and viewer)^view_power

    where `usable` is the bilinear weight of those of the four pixels around the sample that are foreground and visible.
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
class Blend(OnDevice):
    """Blended colour, weights and disagreement of the source cameras in each pixel of a novel view."""

    rgb: Float[Tensor, "3 height width"]
    """Weighted mean of the samples, in [0, 1]; black where no camera has weight."""
    weights: Float[Tensor, "source height width"]
    """Raw weights, not normalised."""
    disagreement: Float[Tensor, "height width"]
    """Weighted standard deviation of the samples, mean of the channels; 0 for a single camera."""


def blend(
    camera: Cameras,
    depth: Float[Tensor, "height width"],
    normals: Float[Tensor, "height width 3"],
    sources: ContextViews,
    bias_m: float,
    config: BlendConfig,
) -> Blend:
    """Colour the surface visible in `camera` from the images of `sources`.

    Samples are bilinear. Of the four pixels only those count that are foreground (by the soft mask) and from which the
    point is visible, so that neither background nor an occluder's rim bleeds in. A camera does not contribute to points
    behind it, outside its image, or facing away from it.

    Args:
        camera: the novel view (one).
        depth: z-depth of its surface, metres, 0 where there is none.
        normals: outward, of any length, world axes.
        sources: the source cameras, with the proxy's depth in each. Blended on the CPU, on whatever device they are.
        bias_m: tolerance of the depth test, metres.
        config: exponents and tolerances.
    """
    from viewmend.rendering._blend_numba import blend_rows

    device, camera, depth, normals = depth.device, camera.to("cpu"), depth.cpu(), normals.cpu()
    sources = sources.to("cpu")
    frame, rig = sources.frame, sources.frame.cameras
    height, width = depth.shape
    rgb = torch.zeros(3, height, width)
    weights = torch.zeros(len(rig), height, width)
    disagreement = torch.zeros(height, width)

    pose = camera.world_from_camera[0].double()
    world_from_pixel = (pose[:3, :3] @ torch.linalg.inv(camera.K[0].double())).numpy()
    P = (rig.K.double() @ rig.camera_from_world[:, :3].double()).numpy()
    mask = frame.mask if frame.mask is not None else torch.zeros(0, 0, 0, dtype=torch.uint8)
    inputs = (
        *(depth.numpy(), normals.numpy(), world_from_pixel, pose[:3, 3].numpy()),
        *(frame.rgb.numpy(), mask.numpy(), sources.depth.numpy()),
        *(P, rig.centers.double().numpy(), rig.K[:, 0, 0].double().numpy(), rig.size_px.numpy()),
        np.array([bias_m, config.slope_px, GRAZING]),
        np.array([config.normal_power, config.view_power]),
    )
    outputs = (rgb.numpy(), weights.numpy(), disagreement.numpy())

    def work(band: int) -> None:
        blend_rows(band * ROWS, min(height, (band + 1) * ROWS), *inputs, *outputs)

    parallel_for(work, -(-height // ROWS))
    return Blend(rgb, weights, disagreement).to(device)
