"""Change from frame to frame, along the true motion of the surface and in place."""

from jaxtyping import Bool, Float
from torch import Tensor

from viewmend.geometry.sampling import sample_bilinear


def warp_error(
    image: Float[Tensor, "channel height width"],
    before: Float[Tensor, "channel height width"],
    backward_flow_px: Float[Tensor, "height width 2"],
    pixels: Bool[Tensor, "height width"],
    enough_px: int = 1,
) -> float | None:
    """Mean absolute difference of an image and the one before, warped by the true motion, over some pixels.

    Counted are those of `pixels` whose surface point was seen before; None where they are fewer than `enough_px`. The
    image before is sampled bilinearly, so the truth's own error is not 0: compare with it.
    """
    counted = pixels & backward_flow_px.isfinite().all(-1)
    if int(counted.sum()) < enough_px:
        return None
    warped = sample_bilinear(before[None], backward_flow_px[counted][None], "border")[0]
    return float((image[:, counted] - warped.T).abs().mean())


def change(
    image: Float[Tensor, "channel height width"],
    before: Float[Tensor, "channel height width"],
    pixels: Bool[Tensor, "height width"],
    enough_px: int = 1,
) -> float | None:
    """Mean absolute difference of an image and the one before in the same places; None where they are too few."""
    return float((image - before)[:, pixels].abs().mean()) if int(pixels.sum()) >= enough_px else None
