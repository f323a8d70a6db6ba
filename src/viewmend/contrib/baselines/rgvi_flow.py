"""Optical flow for RGVI without any weights, and images pulled along flow."""

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from viewmend.geometry.cameras import pixel_centers
from viewmend.geometry.sampling import sample_bilinear

Image = Float[Tensor, "3 height width"]
FlowMap = Float[Tensor, "2 height width"]
"""Where each pixel's point is in another image, relative to the pixel: x right, y down, pixels."""


DISAGREEMENT = (0.01, 0.5)
"""Flow and the flow back may differ, squared, by this share of their squares plus this many square pixels."""


def dis_flow(image: Image, other: Image) -> FlowMap:
    """Dense inverse search (Kroeger et al. 2016), OpenCV's, from images in [0, 1]."""
    import cv2

    grey = [
        cv2.cvtColor((x.clamp(0, 1) * 255).round().byte().cpu().movedim(0, -1).contiguous().numpy(), cv2.COLOR_RGB2GRAY)
        for x in (image, other)
    ]
    found = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM).calc(grey[0], grey[1], np.zeros((0, 0)))
    return torch.from_numpy(np.ascontiguousarray(found)).movedim(-1, 0).to(image)


def pull(
    image: Float[Tensor, "channel height width"], flow: FlowMap
) -> tuple[Float[Tensor, "channel height width"], Bool[Tensor, "height width"]]:
    """The other image seen through the flow, bilinearly, and where all that was sampled lies in it."""
    height, width = flow.shape[1:]
    at = pixel_centers(width, height, flow.device) + flow.movedim(0, -1)
    inside = ((at >= 0.5) & (at <= at.new_tensor([width, height]) - 0.5)).all(-1)
    return sample_bilinear(image[None], at.flatten(0, 1)[None], "border")[0].T.unflatten(1, (height, width)), inside


def disagreeing(flow: FlowMap, back: FlowMap) -> Bool[Tensor, "height width"]:
    """Where flow and the flow back from there do not lead home (Sundaram et al. 2010), or there is outside."""
    returned, inside = pull(back, flow)
    share, square_px = DISAGREEMENT
    allowed = share * (flow.square().sum(0) + returned.square().sum(0)) + square_px
    return ~inside | ((flow + returned).square().sum(0) > allowed)
