"""Skinning weights of points near the body, dense over the joints."""

import numpy as np

from viewmend.studio.procedural.body import Body, Limb, opposite
from viewmend.studio.procedural.skeleton import INDEX, JOINTS, SIDES, SPINE, Points, Skeleton, Values, Weights


def smoothstep(x: Values, low: float, high: float) -> Values:
    """0 below `low`, 1 above `high` (low < high), smooth between."""
    s = np.clip((x - low) / (high - low), 0, 1)
    return s * s * (3 - 2 * s)


def one_joint(shape: tuple[int, ...], name: str) -> Weights:
    """Weights of points that follow this joint alone."""
    weights = np.zeros((*shape, len(JOINTS)))
    weights[..., INDEX[name]] = 1
    return weights


def mix(first: Weights, second: Weights, share: Values) -> Weights:
    """`first` where `share` is 0, `second` where it is 1."""
    return first + share[..., None] * (second - first)


def body_weights(body: Body, skeleton: Skeleton, height_m: float, points: Points, part: int = 0) -> Weights:
    """Weights of points on or near the body: soft membership in a part, then soft steps along the part's chain.

    Points of a limb's sheet (`part`, as in `Body.parts`) never follow the limb of the other side.
    """
    fields = body.fields(points)
    fields[opposite(part)] = 1.0
    soft = 0.010 * height_m
    member = np.exp(np.clip(-(fields - fields.min(0)) / soft, -40, 0))
    member /= member.sum(0)
    weights = member[0][..., None] * _trunk(skeleton, height_m, points)
    for i, side in enumerate(SIDES):
        weights = weights + member[1 + i][..., None] * limb_weights(
            body.arms[i], points, [f"{side}_{j}" for j in ("upperarm", "forearm", "hand")], skeleton, 0.10
        )
        weights = weights + member[3 + i][..., None] * limb_weights(
            body.legs[i], points, [f"{side}_{j}" for j in ("thigh", "shin", "foot")], skeleton, 0.085
        )
    return weights


def limb_weights(limb: Limb, points: Points, names: list[str], skeleton: Skeleton, width: float) -> Weights:
    """Weights along a limb's three joints; `width` is half the bend's extent as a share of the limb."""
    t = limb.along(points)
    middle = float(limb.along(skeleton.at(names[1])[None])[0])
    weights = one_joint(points.shape[:-1], names[0])
    weights = mix(weights, one_joint(points.shape[:-1], names[1]), smoothstep(t, middle - width, middle + width))
    return mix(weights, one_joint(points.shape[:-1], names[2]), smoothstep(t, 0.94, 1.05))


def _trunk(skeleton: Skeleton, height_m: float, points: Points) -> Weights:
    shape = points.shape[:-1]
    weights = one_joint(shape, "pelvis")
    for name, half in zip(SPINE[1:], (0.035, 0.04, 0.04, 0.018, 0.016), strict=True):
        y, soft = float(skeleton.at(name)[1]), half * height_m
        weights = mix(weights, one_joint(shape, name), smoothstep(points[..., 1], y - soft, y + soft))
    for side in SIDES:
        outer = float(skeleton.at(f"{side}_upperarm")[0])
        across = smoothstep(points[..., 0] / outer, 0.35, 0.95)
        high = smoothstep(points[..., 1] / height_m, 0.74, 0.80)
        weights = mix(weights, one_joint(shape, f"{side}_clavicle"), 0.8 * across * high)
    return weights
