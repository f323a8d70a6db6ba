"""The frame and the scale of a rig: what neither a board nor silhouettes tell."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from viewmend.geometry.cameras import Cameras
from viewmend.geometry.rigid import invert_rigid, rigid


def brought_to(rig: Cameras, reference: Cameras, points_world: Float[Tensor, "point 3"]) -> Cameras:
    """The rig turned, moved and scaled as a whole, until its cameras see what lies where `reference` sees the points.

    The rotation, translation and scale are Umeyama's, of the points in each camera's own frame (PAMI 1991).

    Args:
        rig: cameras in a frame of their own.
        reference: the same cameras, in the frame that is wanted.
        points_world: some points there, where the subject may be.
    """
    ones = torch.ones_like(points_world[:, :1])
    there = torch.cat([points_world, ones], 1).double()
    in_cameras = there @ reference.camera_from_world.double().mT
    here = in_cameras @ invert_rigid(rig.camera_from_world.double()).mT
    source = here[..., :3].reshape(-1, 3).cpu().numpy()
    target = points_world.double().repeat(len(rig), 1).cpu().numpy()
    R, t, scale = _similarity(source, target)
    pose = rig.camera_from_world.double()
    turned = pose[:, :3, :3] @ torch.from_numpy(R.T).to(pose)
    moved = scale * pose[:, :3, 3] - turned @ torch.from_numpy(t).to(pose)
    return replace(rig, camera_from_world=rigid(turned, moved).to(rig.camera_from_world))


def _similarity(
    source: Float64[np.ndarray, "point 3"], target: Float64[np.ndarray, "point 3"]
) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, "3"], float]:
    """R, t and s for which s R x + t is nearest to the targets."""
    a, b = source - source.mean(0), target - target.mean(0)
    u, s, vt = np.linalg.svd(b.T @ a)
    sign = np.array([1.0, 1.0, np.linalg.det(u) * np.linalg.det(vt)])
    R = (u * sign) @ vt
    scale = float((s * sign).sum() / (a**2).sum())
    return R, target.mean(0) - scale * R @ source.mean(0), scale
