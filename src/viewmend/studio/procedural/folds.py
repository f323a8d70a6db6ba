"""Soft creases of cloth, as displaced geometry and as painted shading."""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from viewmend.studio.procedural.fabric import PX_PER_M, Canvas, Image, Plane

Painter = Callable[[Canvas], Image]
"""Paints an image of the size of a canvas."""


@dataclass(frozen=True)
class Folds:
    """Soft creases: displaced geometry, and shading that is painted onto the cloth."""

    depth_m: float
    along_m: float
    """Grain along the axis."""
    around_m: float
    seed: int
    px_per_m: float = PX_PER_M
    """Texels of the sheet's chart."""

    def height(self, canvas: Canvas) -> Plane:
        """Displacement on the canvas, metres, periodic from the right edge to the left one."""
        rng = np.random.default_rng(self.seed)
        field = canvas.noise(rng, self.around_m, self.along_m)
        field = field + 0.4 * canvas.noise(rng, self.around_m / 2, self.along_m / 2)
        share = np.clip((np.linspace(0, 1, field.shape[1]) - 0.85) / 0.15, 0, 1)
        return self.depth_m * (field + share * (field[:, :1] - field))

    def crease(
        self, canvas: Canvas, uv: Float[np.ndarray, "row column 2"]
    ) -> Float[np.ndarray, "row column"]:
        """Compute the displacement at positions on the canvas, metres."""
        height = self.height(canvas).astype(np.float32)
        rows, columns = height.shape
        x = uv[..., 0] * (columns - 1)
        y = (1 - uv[..., 1]) * (rows - 1)
        return cv2.remap(height, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR).astype(
            np.float64
        )

    def paint(self, canvas: Canvas, painter: Painter) -> Image:
        """Paint cloth with creases: slopes that face down are darker."""
        slope = np.gradient(self.height(canvas), axis=0) * canvas.px_per_m
        return np.clip(painter(canvas) * np.clip(1 + 0.8 * slope, 0.65, 1.2)[..., None], 0, 1)
