"""F* as an inpainter is to paint it: upon the background that it paints on."""

from jaxtyping import Float
from torch import Tensor

from viewmend.backgrounds import Background, laid_upon
from viewmend.training.samples import Sample


def true_image(sample: Sample, background: Background) -> Float[Tensor, "3 height width"]:
    """F* in [0, 1], upon this background.

    Raises:
        ValueError: upon white, the sample does not tell where its subject is.
    """
    rgb = sample.truth.float() / 255
    if background == "black":
        return rgb
    if sample.alpha is None:
        raise ValueError(
            "expected samples that tell where the subject is, for a model that paints upon white, got some that do "
            "not; make them anew with `viewmend samples`"
        )
    return laid_upon(background, rgb, sample.alpha.float() / 255)
