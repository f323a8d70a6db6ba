"""Masks by the colour of the background, and its light taken off the subject's edges."""

import numpy as np
from jaxtyping import Float32, UInt8

from viewmend.preprocess.masks.maker import Mask, Rgb, soft_mask

KEYS = {"green": 1, "blue": 2}
"""The channel that a screen of this colour is brightest in."""
SURE, POSSIBLE = 0.5, 0.3
"""How far from the key's colour foreground is, as a share of the key's own excess."""
DARK = 24
"""A key that is darker than this, in levels, is black: what is brighter is foreground."""
EDGE = 1 / 100
"""Spill is taken away up to this share of the image's longer side from the outline."""


class ChromaMasks:
    """Makes masks of what is neither of the key's colour nor, where `dark` is set, dark.

    A pixel's excess is by how much its key channel is above the larger other one, relative to that channel: light and
    shadow on a screen do not change it.
    """

    def __init__(self, key: str = "green", dark: bool = False):
        self._channel = KEYS[key]
        self._dark = dark

    def mask(self, rgb: Rgb) -> Mask:
        """Foreground of an image, 0 to 255."""
        import cv2

        image = np.asarray(cv2.GaussianBlur(rgb, (0, 0), 0.7), np.float32)
        brightest = image.max(-1)
        excess = _excess(image, self._channel) / np.maximum(brightest, 1)
        usual = np.median(excess[excess > 0.15]) if (excess > 0.15).any() else 0.5
        distance = 1 - excess / usual
        if self._dark:
            distance = np.minimum(distance, brightest / DARK - 1)
        return soft_mask(distance.astype(np.float32), SURE, POSSIBLE)


def without_spill(rgb: Rgb, mask: Mask, screen: UInt8[np.ndarray, "height width 3"]) -> Rgb:
    """Remove green or blue light of the `screen` from the outline of the subject.

    Near the outline, where the screen's image has more green (or blue) than any other colour, the subject keeps no more
    of it than of its larger other colour. What lies farther inside keeps its colours.
    """
    import cv2

    reach = max(1, round(EDGE * max(rgb.shape[:2])))
    inside = (mask > 127).astype(np.uint8)
    deep = np.asarray(cv2.distanceTransform(inside, cv2.DIST_L2, 5), np.float32)
    near = np.clip(1 - (deep - reach) / reach, 0, 1)  # whole up to the reach, then fading
    around = np.asarray(cv2.blur(screen, (4 * reach + 1, 4 * reach + 1)), np.float32)
    image = rgb.astype(np.float32)
    for channel in KEYS.values():
        share = np.clip(_excess(around, channel) / 24, 0, 1)
        image[..., channel] -= near * share * np.maximum(_excess(image, channel), 0)
    return image.round().clip(0, 255).astype(np.uint8)


def _excess(image: Float32[np.ndarray, "height width 3"], channel: int) -> Float32[np.ndarray, "height width"]:
    others = [c for c in range(3) if c != channel]
    return image[..., channel] - np.maximum(image[..., others[0]], image[..., others[1]])
