"""The views of one viewer, completed frame by frame: the stream of `mend`, `demo` and `evaluate`."""

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor

from viewmend.frame_cache import CachedFrame
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras
from viewmend.models.base import Inpainter, RenderQuality, State
from viewmend.models.compositing import Background
from viewmend.stream import Stream, StreamConfig, StreamView
from viewmend.types import IncompleteView, MultiViewFrame, Silhouettes
from viewmend.utils.timing import exact_times

SLOW_MS = 10_000.0
"""A first step that takes longer is not repeated for its timing: compilation is a small part of it."""


class ViewSequence:
    """Completes the views of one viewer, frame by frame.

    The first view is computed twice (`first_twice`), and the second is timed.
    """

    def __init__(
        self,
        inpainter: Inpainter,
        config: StreamConfig | None = None,
        bounds: Bounds | None = None,
        exclude: Sequence[str] = (),
        quality: RenderQuality | None = None,
        error_model: Inpainter | None = None,
    ) -> None:
        """Create a viewer of an empty stream.

        Args:
            inpainter: completes the views.
            config: parameters of geometry, rendering and memory; by default frames are kept as long
                as windows reach.
            bounds: the volume that may contain the subject; None to find it from the masks.
            exclude: names of cameras whose images must not be used.
            quality: how much work a view may cost.
            error_model: predicts errors in place of `inpainter` (`registry.error_model_for`).
        """
        self.stream = Stream(inpainter, config or StreamConfig(memory_mb=None), bounds, error_model)
        self.background: Background = inpainter.background or self.stream.config.background
        """Background of the output, on which it is shown and scored."""
        self.state: State | None = None
        """The viewer's state; None before the first view."""
        self.first_twice = True
        """Whether the first view is computed twice, so that its time has no compilation in it."""
        self._exclude = exclude
        self._quality = quality
        self._warm_up: Stream | None = None

    @exact_times()
    def add_frame(
        self, frame: MultiViewFrame | CachedFrame, carving: Silhouettes | None = None
    ) -> CachedFrame:
        """Add a frame, with its proxy and depths if another stream computed them; `carving` as for `Stream`."""
        given = frame.frame if isinstance(frame, CachedFrame) else frame
        own = self.stream
        if self.first_twice and not own.times:
            self._warm_up = Stream(own.inpainter, own.config, own.bounds, own.error_model)
        for stream in (own,) if self._warm_up is None else (self._warm_up, own):
            if isinstance(frame, CachedFrame):
                stream.adopt(frame)
            else:
                stream.add_frame(given, carving=carving)
        return own.cached_frame(given.time)

    @exact_times()
    def view(
        self,
        target: Cameras,
        time: int,
        history_of: IncompleteView | None = None,
        target_mask: Float[Tensor, "height width"] | None = None,
    ) -> StreamView:
        """Complete a view of a frame that was added.

        Args:
            target: the novel view's camera (one view).
            time: index of the frame.
            history_of: the rendered view. Its context in frames that were added without a view is
                encoded first, outside of the measured time.
            target_mask: the subject's mask in the novel view, if it is known.
        """
        for stream in (self._warm_up, self.stream):
            if stream is None:
                continue
            if history_of is not None:
                stream.inpainter.encode_history(history_of, stream.context_provider())
            made = stream.view(target, self.state, time, self._quality, self._exclude, target_mask)
            if stream is self._warm_up and made.times.inpainting >= SLOW_MS:
                self.stream = stream
                break
        self._warm_up = None
        self.state = made.viewer  # pyrefly: ignore[unbound-name]
        return made

    def skip(
        self, target: Cameras, time: int, target_mask: Float[Tensor, "height width"] | None = None
    ) -> None:
        """Advance the state past a frame whose view is not needed."""
        if type(self.stream.viewer()) is State:
            return  # nothing is carried from view to view
        state = self.stream.advance(self.stream.render(target, time, self._exclude, target_mask), self.state)
        if state is None:
            state = self.stream.view(
                target, self.state, time, self._quality, self._exclude, target_mask
            ).viewer
        self.state = state
