"""M_t of a novel view whose mask is not known: the alpha that the model `views` predicts."""

from collections.abc import Sequence
from dataclasses import replace

from jaxtyping import Float
from torch import Tensor

from viewmend.frame_cache import CachedFrame
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras
from viewmend.models.base import Inpainter
from viewmend.stream import Stream, StreamConfig


class MaskPredictor:
    """Predicts the subject's mask in novel views of frames whose geometry another stream has computed."""

    def __init__(self, model: Inpainter, config: StreamConfig, bounds: Bounds | None = None) -> None:
        """Create a predictor with its own stream.

        Args:
            model: an inpainter that predicts alpha, the shipped `views` (`registry.mask_model`).
            config: hull and renderer of the views, as of the stream that shows them.
            bounds: the volume that may contain the subject.
        """
        render = replace(config.render, error_rule="all")
        self._stream = Stream(model, replace(config, render=render, memory_mb=None), bounds)

    def predict(
        self, cached: CachedFrame, target: Cameras, exclude: Sequence[str] = ()
    ) -> Float[Tensor, "height width"]:
        """M_t in [0, 1] of the view of one camera; images of the cameras in `exclude` are not used."""
        self._stream.adopt(cached)
        made = self._stream.view(target, time=cached.frame.time, exclude=exclude)
        return made.completed.opacity.clamp(0, 1)
