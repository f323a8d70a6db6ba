"""What views and true images are laid upon: black, or white as the paper's (section 13)."""

from typing import Literal

from jaxtyping import Float
from torch import Tensor

Background = Literal["black", "white"]


def laid_upon(
    background: Background, rgb: Float[Tensor, "3 height width"], alpha: Float[Tensor, "height width"]
) -> Float[Tensor, "3 height width"]:
    """An image upon black, of what covers so much of each pixel, upon this background; in [0, 1]."""
    return rgb if background == "black" else (rgb + (1 - alpha)).clamp(0, 1)
