"""Rigid motions as 4x4 matrices named target_from_source."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def invert_rigid(target_from_source: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 4 4"]:
    """source_from_target, by the transpose of the rotation."""
    rotation = target_from_source[..., :3, :3].mT
    translation = -rotation @ target_from_source[..., :3, 3:]
    inverse = torch.zeros_like(target_from_source)
    inverse[..., :3, :3] = rotation
    inverse[..., :3, 3:] = translation
    inverse[..., 3, 3] = 1
    return inverse


def is_rotation(R: Float[Tensor, "*batch 3 3"], tolerance: float = 1e-3) -> Bool[Tensor, "*batch"]:
    """Whether R is orthonormal and right-handed, each entry of R R^T to `tolerance`."""
    identity = torch.eye(3, device=R.device, dtype=R.dtype)
    orthonormal = ((R @ R.mT - identity).abs() <= tolerance).all(-1).all(-1)
    return orthonormal & (torch.linalg.det(R) > 0)


def rigid(R: Float[Tensor, "*batch 3 3"], t: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 4 4"]:
    """The motion x -> R x + t."""
    motion = torch.zeros(*R.shape[:-2], 4, 4, device=R.device, dtype=R.dtype)
    motion[..., :3, :3] = R
    motion[..., :3, 3] = t
    motion[..., 3, 3] = 1
    return motion


def look_at(
    eye: Float[Tensor, "3"], target: Float[Tensor, "3"], up: Float[Tensor, "3"]
) -> Float[Tensor, "4 4"]:
    """camera_from_world of a camera at `eye` that looks at `target`, its image's top towards `up` (OpenCV axes).

    Raises:
        ValueError: eye equals target, or up is parallel to the viewing direction.

    Examples:
        >>> import torch
        >>> from viewmend import look_at
        >>> pose = look_at(torch.tensor([0.0, 1.0, 3.0]), torch.tensor([0.0, 1.0, 0.0]), torch.tensor([0.0, 1.0, 0.0]))
        >>> float((pose @ torch.tensor([0.0, 1.0, 0.0, 1.0]))[2])
        3.0
    """
    forward = target - eye
    right = torch.linalg.cross(forward, up)
    if float(forward.norm()) < 1e-9 or float(right.norm()) < 1e-9 * float(forward.norm() * up.norm() + 1e-12):
        raise ValueError(
            f"expected an eye away from the target and an up that is not the viewing direction, "
            f"got eye {eye.tolist()}, target {target.tolist()}, up {up.tolist()}; choose another up"
        )
    z = forward / forward.norm()
    x = right / right.norm()
    R = torch.stack([x, torch.linalg.cross(z, x), z])
    return rigid(R, -R @ eye)


def rotation_from_axis_angle(axis_angle_rad: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation by |v| radians about v (Rodrigues)."""
    x, y, z = axis_angle_rad.unbind(-1)
    zero = torch.zeros_like(x)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))
    return torch.linalg.matrix_exp(skew)
