"""Quality levels of live views, what they cost, and ladders of them."""

from dataclasses import dataclass

WINDOW_FRAMES = 7
"""Number of frames in the temporal window of the paper's model."""
COARSE_FILL_COST = 0.15
"""Cost of a fill without context, relative to the full level."""
REFINE_FIXED = 0.1
"""Cost of refining that does not depend on resolution, relative to the full level."""
REFINE_COST = 0.3
"""Cost of refining an arbitrarily small part at full resolution, relative to the full level."""
FADE_FIXED = 0.05
"""Cost of fading background that does not depend on resolution, relative to the full level."""
FADE_COST = 0.13
"""Cost of fading background at full resolution, relative to the full level."""


@dataclass(frozen=True)
class QualityLevel:
    """Quality settings of one view."""

    scale: float
    """Factor of width and height."""
    context_times: int | None
    """Number of context frames, the latest first; None for the whole temporal window. With 0 no camera
    image is encoded."""
    top_k: int | None
    """Context tokens that survive pruning; None for the model's own number."""
    refine_fraction: float | None = None
    """Part of the subject that is inpainted; None for all that the error rule selects. 0 fades
    background and fills holes from around them."""

    @property
    def relative_cost(self) -> float:
        """Cost of inpainting, relative to the full level."""
        if self.refine_fraction == 0:
            return FADE_FIXED + self.scale**2 * FADE_COST
        if self.refine_fraction is not None:
            refined = (1 - REFINE_FIXED - REFINE_COST) * self.refine_fraction
            return REFINE_FIXED + self.scale**2 * (REFINE_COST + refined)
        tokens = min(self.top_k or 2048, 2048) / 2048
        if self.context_times == 0:
            return self.scale**2 * COARSE_FILL_COST
        times = WINDOW_FRAMES if self.context_times is None else self.context_times
        return self.scale**2 * (0.4 + 0.4 * times / WINDOW_FRAMES + 0.2 * tokens)


@dataclass(frozen=True)
class Ladder:
    """The quality levels for one kind of model."""

    levels: tuple[QualityLevel, ...]
    """All levels, from the cheapest to `FULL`."""
    moving: QualityLevel
    """The level of a moving view if there is no budget."""
    still: QualityLevel
    """The level of a view that has just come to rest: sharp and quickly rendered."""
