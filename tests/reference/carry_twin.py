"""Slow, obvious twin of viewmend.geometry.reprojection.carry: one point at a time, matrices written out."""

import numpy as np


def carry_twin(uv_px, z_m, sources, target):
    """Pixel coordinates and z-depth in the target camera."""
    uv, z = np.zeros(uv_px.shape), np.zeros(z_m.shape)
    target_pose = target.camera_from_world[0].double().numpy()
    for view, point in np.ndindex(*z_m.shape):
        K = sources.K[view].double().numpy()
        pose = sources.camera_from_world[view].double().numpy()
        in_source = np.linalg.inv(K) @ [*uv_px[view, point].tolist(), 1] * float(z_m[view, point])
        world = np.linalg.inv(pose[:3, :3]) @ (in_source - pose[:3, 3])
        in_target = target_pose[:3, :3] @ world + target_pose[:3, 3]
        homogeneous = target.K[0].double().numpy() @ in_target
        uv[view, point], z[view, point] = homogeneous[:2] / homogeneous[2], homogeneous[2]
    return uv, z
