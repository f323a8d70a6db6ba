"""Which cameras colour a novel view: the closest ones (the paper), or those that see most of it (RIFTCast)."""

from collections.abc import Sequence

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
    exclude: Sequence[str] = (),
) -> tuple[str, ...]:
    """Names of the k cameras closest to the target, nearest first: the paper's selection (section 2).

    Close means a small angle at the subject's centre between the two viewing rays (the paper does not define it); it
    is what decides how similar the two images are, while the distance to the subject only changes the scale. Fewer
    than k names come back when there are fewer cameras; none of `exclude` ever does.
    """
    angle = angles_to(target, cameras, subject_center).tolist()
    allowed = [v for v, name in enumerate(cameras.names) if name not in exclude]
    return tuple(cameras.names[v] for v in sorted(allowed, key=lambda v: angle[v])[:k])


def select_covering(
    evidence: Float[Tensor, "view point"],
    names: Sequence[str],
    closest: Sequence[str],
    k: int = 3,
    previous: Sequence[str] = (),
    keep_share: float = 0.85,
) -> tuple[str, ...]:
    """Names of k cameras that together see as much of the target's pixels as possible (RIFTCast, greedy cover).

    Deviations from RIFTCast: points are surface samples at target pixels, so that a face counts by its area in the
    target; a point counts by how well the best chosen camera sees it, not only whether one does; and when nothing more
    can be gained the next closest cameras fill the places.

    Args:
        evidence: how well each camera sees each point, 0 for not at all to 1 for as well as can be.
        names: names of the rows of `evidence`.
        closest: the cameras that may be chosen, nearest first; one that is not here is never chosen, nor kept.
        k: how many to choose.
        previous: the last choice; it stays while the points it sees are more than `keep_share` of all that the
            allowed cameras can see, which keeps the texture from flickering.
        keep_share: see `previous`.
    """
    row = {name: v for v, name in enumerate(names)}
    allowed = [name for name in closest if name in row]
    if not allowed:
        return ()
    kept = [name for name in dict.fromkeys(previous) if name in allowed]
    if len(kept) == min(k, len(allowed)) and evidence.shape[1]:
        seen = (evidence[[row[n] for n in kept]] > 0).any(0).sum()
        seeable = (evidence[[row[n] for n in allowed]] > 0).any(0).sum()
        if float(seen) > keep_share * float(seeable):
            return tuple(kept)
    chosen: list[str] = []
    best = torch.zeros_like(evidence[0])
    while len(chosen) < min(k, len(allowed)):
        rest = [name for name in allowed if name not in chosen]
        gain = (evidence[[row[n] for n in rest]] - best).clamp(min=0).sum(1)
        chosen.append(rest[int(gain.argmax())])  # ties, and no gain at all: the first, which is the closest
        best = torch.maximum(best, evidence[row[chosen[-1]]])
    return tuple(chosen)
