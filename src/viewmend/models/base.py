"""The base class of all inpainters, and what `step` receives: the view, its context and the viewer's state.

An inpainter completes one view at a time: `step(view, context, state) -> (completed, state)`. It
keeps nothing between calls. What one viewer's view leaves for the next is the state; what is
computed once per frame and shared by all viewers is kept by the `ContextProvider`.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from viewmend.geometry.cameras import check_names
from viewmend.models.compositing import Background, cut, from_background, to_background
from viewmend.types import OVERSHOOT, CompletedView, ContextViews, IncompleteView
from viewmend.utils.tensors import extremes, to_mmap
from viewmend.utils.timing import ms_since, now_s

ViewsAt = Callable[[int, tuple[str, ...]], ContextViews | None]
"""views(time, names): the cameras of these names in the frame `time`, with the proxy's depth.
Cameras without an image in that frame are left out; None if all are."""
Memory = dict[tuple[str, str], Any]
"""What was computed from one frame, by (kind, camera name)."""
T = TypeVar("T")
REMEMBERED_FRAMES = 34
"""Frames that a provider with a memory of its own keeps: the view's own, and k_w n_w + n_c before it."""


@dataclass(frozen=True, kw_only=True)
class RenderQuality:
    """How much work one view may cost. The default is everything that the model was trained with.

    Examples:
        >>> from viewmend import RenderQuality
        >>> cheapest = RenderQuality(context_times=0)
    """

    mend: bool = True
    """False skips inpainting: the view is returned as rendered, cut by its `target_mask` if there is one."""
    top_k: int | None = None
    """Context tokens that survive pruning; None for the model's own number."""
    context_times: int | None = None
    """How many frames of the temporal window are context, the latest first (1: only the view's
    own); None for all. With 0 no camera image is encoded: the paper's model then completes patches
    from the view's own patches."""
    refine_fraction: float | None = None
    """Re-synthesise at most this fraction of the proxy's pixels, those with the highest predicted
    gain; holes are always filled. None: all pixels of the error mask. With 0, holes are filled from
    their surroundings, and pixels that are predicted to be background are attenuated."""

    def __post_init__(self) -> None:
        if self.refine_fraction is not None and not 0 <= self.refine_fraction <= 1:
            raise ValueError(f"expected a refine_fraction from 0 to 1 or None, got {self.refine_fraction}")


class ContextProvider:
    """The camera images that an inpainter may use, and a memory of what it computed from them.

    `provider(time, names)` returns these cameras in the frame `time`, or None. Code that calls
    `step` directly makes one provider for all views of its stream. `viewmend.Stream` makes one per
    view, with a memory that all viewers share.

    Examples:
        >>> from viewmend import ContextProvider, Stream, make_method
        >>> from viewmend.studio.stage import Studio, StudioConfig
        >>> frame = Studio(StudioConfig(cameras=4, frames=1, size_px=64)).read(0)
        >>> cached = Stream(make_method("telea")).add_frame(frame)
        >>> context = ContextProvider(lambda time, names: cached.context(names) if time == 0 else None)
        >>> context(0, frame.cameras.names[:2]).frame.rgb.shape
        torch.Size([2, 3, 64, 64])
        >>> context(-1, frame.cameras.names) is None
        True
    """

    def __init__(
        self,
        views: ViewsAt,
        quality: RenderQuality | None = None,
        exclude: Sequence[str] = (),
        memory: Callable[[int], Memory] | None = None,
    ) -> None:
        """Create a provider.

        Args:
            views: returns cameras by frame and name.
            quality: how much the view may cost.
            exclude: names of cameras that must not be used.
            memory: returns the memory of a frame; by default the provider keeps one for
                each of the last frames.

        Raises:
            ValueError: `exclude` is a string.
        """
        check_names("exclude", exclude)
        self.quality = quality or RenderQuality()
        self.encoding_ms = 0.0
        """Milliseconds spent on encoding camera images so far."""
        self._views = views
        self._exclude = frozenset(exclude)
        self._own: dict[int, Memory] = {}
        self._memory = memory or self._own_memory

    def __call__(self, time: int, names: Sequence[str]) -> ContextViews | None:
        """The named cameras that have an image in this frame and are not excluded; None if there is none."""
        names = tuple(name for name in names if name not in self._exclude)
        return self._views(time, names) if names else None

    def encoded(
        self,
        times: Sequence[int],
        names: Sequence[str],
        encode: Callable[[list[ContextViews]], Sequence[Sequence]],
        kind: str = "encoded",
    ) -> list[Any]:
        """The encodings of these cameras in these frames, in the order of frames and then of names.

        Cameras without an image are left out. `encode` is called once, with every frame that has
        cameras which are not in the memory yet; it returns one result per camera for each element
        of its argument.

        Args:
            times: indices of the frames.
            names: the cameras.
            encode: computes the encodings.
            kind: distinguishes the encodings from those of other models in the same memory
                (`Network.encoding_kind`).
        """
        usable = [name for name in names if name not in self._exclude]
        memories = {time: self._memory(time) for time in times}

        # encode the cameras that are missing, of all frames in one call
        new = []
        for time, memory in memories.items():
            views = self(time, [name for name in usable if (kind, name) not in memory])
            if views is not None and len(views.frame.cameras):
                new.append(views)
        if new:
            with self._timed(new[0].frame.cameras.K.device):
                for views, results in zip(new, encode(new), strict=True):
                    memory = memories[views.frame.time]
                    for name, result in zip(views.frame.cameras.names, results, strict=True):
                        memory[kind, name] = to_mmap(result)

        return [
            memory[kind, name] for memory in memories.values() for name in usable if (kind, name) in memory
        ]

    def remembered(
        self,
        time: int,
        kind: str,
        names: Sequence[str],
        make: Callable[[Sequence[str]], Sequence[T]],
        device: torch.device,
    ) -> list[T]:
        """One result per camera of one frame, computed now or for an earlier view.

        Args:
            time: index of the frame.
            kind: distinguishes these results from others of the same cameras.
            names: the cameras.
            make: computes one result for each of the names that it is given; called with
                those that are missing.
            device: where `make` computes; its time is counted as encoding.
        """
        memory = self._memory(time)
        absent = [name for name in names if (kind, name) not in memory]
        if absent:
            with self._timed(device):
                for name, made in zip(absent, make(absent), strict=True):
                    memory[kind, name] = to_mmap(made)
        return [memory[kind, name] for name in names]

    @contextmanager
    def _timed(self, device: torch.device) -> Iterator[None]:
        """Add the time of the `with` block to `encoding_ms`; that of blocks within it is not added twice."""
        before = self.encoding_ms
        start = now_s(device)
        yield
        self.encoding_ms = before + ms_since(start, device)

    def _own_memory(self, time: int) -> Memory:
        memory = self._own.setdefault(time, {})
        if len(self._own) > REMEMBERED_FRAMES:
            del self._own[max(self._own, key=lambda other: abs(other - time))]
        return memory


@dataclass(frozen=True)
class State:
    """What an inpainter carries from one view of a viewer to the next. Subclass it to add fields; never mutate it.

    Examples:
        >>> from viewmend import State, make_method
        >>> isinstance(make_method("telea").initial_state(), State)
        True
    """


class ErrorMap(NamedTuple):
    """A model's prediction of what is wrong with each pixel of a rendered view; 0 far from the proxy."""

    wrong: Float[Tensor, "height width"]
    """Probability that a channel of the rendered colour is off by more than a tenth."""
    gain: Float[Tensor, "height width"]
    """Expected squared change of the colour when the pixel is re-synthesised, mean of the channels."""
    alpha: Float[Tensor, "height width"]
    """Expected coverage of the pixel by the subject."""
    rest: Float[Tensor, "height width"]
    """The gain that is left once the rendered colour is attenuated by `alpha`."""


class DepthMap(NamedTuple):
    """A model's prediction of the surface that a view shows."""

    depth: Float[Tensor, "height width"]
    """z-depth of the surface, metres; 0 far from the proxy."""
    confidence: Float[Tensor, "height width"]
    """How certain the depth is, in [0, 1]."""


class Inpainter:
    """Base class of everything that completes views. Override `step`; everything else has a default.

    Examples:
        >>> from viewmend import CompletedView, Inpainter, Stream
        >>> class Grey(Inpainter):
        ...     def step(self, view, context, state):
        ...         return CompletedView(view, view.error * 0.5 + (1 - view.error) * view.rgb), state
        >>> stream = Stream(Grey())
        >>> stream.error_rule
        'holes'
    """

    error_rule: str = "holes"
    """The error rule that this inpainter is made for (`rendering.error_mask`)."""
    background: Background | None = None
    """The background that its output is painted on. None: the background of its input, as for
    classical fills."""
    predicts_errors: bool = False
    """Whether `predict_errors` is implemented."""
    predicts_depth: bool = False
    """Whether `predict_depth` is implemented."""
    needs_mask: bool = False
    """Whether it is made for views whose mask M_t is known. A stream predicts M_t where it is not, if
    it has a model that can."""
    window_frames: int = 0
    """How many frames back `step` asks its context for. A stream keeps these frames, if its memory
    holds them."""

    def initial_state(self) -> State:
        """The state before the first view of a viewer."""
        return State()

    def step(self, view: IncompleteView, context: ContextProvider, state: Any) -> tuple[CompletedView, State]:
        """Complete one view.

        Args:
            view: the view to complete. Only pixels with `view.error` > 0 may change.
            context: the cameras; must not be called for frames later than `view.time`.
            state: what `initial_state` or the last `step` returned.

        Returns:
            The completed view, and the state for the viewer's next view.

        Raises:
            NotImplementedError: the subclass does not override it.
        """
        raise NotImplementedError(f"{type(self).__name__}: override `step`")

    def step_on(
        self, background: Background, view: IncompleteView, context: ContextProvider, state: Any
    ) -> tuple[CompletedView, State]:
        """Run `step` on a view on black; the inpainter gets it on this background, and its result is on black.

        The completed view is cut by `view.target_mask`, if there is one, and its images are cast to float32.
        It is of `view` itself, even if `step` returns one of a changed copy.

        Args:
            background: ignored if the inpainter has its own, which it then applies itself.
            view: as for `step`.
            context: as for `step`.
            state: as for `step`.

        Raises:
            ValueError: `step` returns no completed view of this view with a state.
        """
        given = "black" if self.background is not None else background
        made = self.step(to_background(given, view), context, state)
        fault = _fault(made, view)
        if fault:
            raise ValueError(
                f"{type(self).__name__}: expected `step` to return (CompletedView, State), with images of floats in "
                f"[0, 1], of the view's height and width {tuple(view.mask.shape)}, got {fault}; correct `step`, or use "
                "another model"
            )
        completed, state = made
        images: dict[str, Any] = {name: image.float() for name, image in completed.images.items()}
        completed = from_background(given, replace(completed, **images), view)
        return cut(replace(completed, view=view)), state

    def crop_margin_px(self, quality: RenderQuality) -> int | None:
        """Pixels of margin around the subject with which a crop gives the same result as the whole view.

        None: `step` needs the whole view.
        """
        return None

    def source_names(self, view: IncompleteView) -> tuple[str, ...]:
        """Names of the cameras whose images complete a view; by default those that coloured it."""
        return view.source_views

    def encode_history(self, view: IncompleteView, context: ContextProvider) -> None:
        """Encode what `step` would need of the frames before `view`, as if they had been streamed."""

    def encode_cameras(self, views: ContextViews, context: ContextProvider) -> None:
        """Encode everything about these cameras that does not depend on the view, into the memory of `context`."""

    def advance_state(self, view: IncompleteView, state: Any) -> State | None:
        """The state after a view whose completion is not needed; None if only `step` can compute it."""
        return None

    def reveal_truth(self, state: Any, truth: Float[Tensor, "3 height width"]) -> State:
        """The state once the true image of the last view is known; for upper bounds such as the offline method rgvi.

        Only the evaluation calls this. Methods that ignore the truth, as all others must, return `state`.
        """
        return state

    def predict_errors(self, view: IncompleteView, context: ContextProvider) -> ErrorMap | None:
        """Predict which pixels of a rendered view are wrong; None if no camera is available."""
        return None

    def predict_depth(self, view: IncompleteView, context: ContextProvider) -> DepthMap | None:
        """Predict the surface that a rendered view shows; None if no camera is available."""
        return None


def _fault(made: object, view: IncompleteView) -> str | None:
    """What is wrong with the result of a `step`; None if nothing is."""
    if not isinstance(made, tuple):
        return f"a {type(made).__name__} alone"
    if len(made) != 2 or not isinstance(made[0], CompletedView):
        return f"({', '.join(type(part).__name__ for part in made)})"
    images: dict[str, Tensor] = {}
    for name in ("rgb", "alpha", "confidence", "depth"):
        image = getattr(made[0], name)
        if image is None and name != "rgb":
            continue
        if not isinstance(image, Tensor):
            return f"{name} as {type(image).__name__}"
        wanted = (view.rgb if name == "rgb" else view.mask).shape
        if image.shape != wanted or not image.is_floating_point():
            return f"{name} as {image.dtype} of shape {tuple(image.shape)}"
        images[name] = image
    for name, (low, high) in zip(images, extremes(images.values()), strict=True):
        if not math.isfinite(low + high):
            return f"numbers in {name} that are not finite"
        if low < -OVERSHOOT or (name != "depth" and high > 1 + OVERSHOOT):
            return f"{name} from {low:.3g} to {high:.3g}"
    return None
