"""Which cameras colour a novel view: those closest in angle (the paper, section 2)."""

import torch
from jaxtyping import Float
from torch import Tensor

from viewmend.geometry.cameras import Cameras


def angles_to(target: Cameras, cameras: Cameras, subject_center: Float[Tensor, "3"]) -> Float[Tensor, "view"]:
    """Angle at the subject's centre between the target's centre and each camera's, radians in [0, pi]."""
    to_target = torch.nn.functional.normalize(target.centers[0] - subject_center, dim=-1)
    to_cameras = torch.nn.functional.normalize(cameras.centers - subject_center, dim=-1)
    # atan2 of the cross and the dot product: acos would lose the small angles, which decide.
    sine = torch.linalg.cross(to_cameras, to_target.expand_as(to_cameras)).norm(dim=-1)
    return torch.atan2(sine, to_cameras @ to_target)


def select_closest(
    target: Cameras,
    cameras: Cameras,
    subject_center: Float[Tensor, "3"],
    k: int = 3,
) -> tuple[str, ...]:
    """Names of the k cameras closest to the target, nearest first: the paper's selection (section 2).

    Close means a small angle at the subject's centre between the two viewing rays (the paper does not define it); it
    is what decides how similar the two images are, while the distance to the subject only changes the scale. Fewer
    than k names come back when there are fewer cameras.
    """
    angle = angles_to(target, cameras, subject_center).tolist()
    return tuple(cameras.names[view] for view in sorted(range(len(cameras)), key=lambda view: angle[view])[:k])
