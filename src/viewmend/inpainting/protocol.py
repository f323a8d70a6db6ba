"""What every inpainter of views obeys, ours and the baselines: state is passed, not hidden."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from viewmend.backgrounds import Background
from viewmend.own_pages import to_own_pages
from viewmend.timing import ms_since, now_s
from viewmend.views import CompletedView, ContextViews, IncompleteView

ViewsAt = Callable[[int, tuple[str, ...]], ContextViews | None]
"""views(time, names): these cameras at that time with the proxy's depth; fewer where some have no frame, None where
none has."""
Memory = dict[Any, Any]
"""What was encoded of one time, by camera name, and what else is made of a time, by kind and camera name."""
T = TypeVar("T")
REMEMBERED_TIMES = 34
"""Times that a provider with a memory of its own keeps: the view's own, and k_w n_w + n_c before it."""


@dataclass(frozen=True, kw_only=True)
class RenderQuality:
    """How much work one view may cost; the default is all that the model was trained with.

    Examples:
        >>> from viewmend import RenderQuality
        >>> cheapest = RenderQuality(context_times=0)
    """

    mend: bool = True
    """False leaves the holes as they are rendered."""
    top_k: int | None = None
    """Context tokens that survive pruning; None takes the model's own."""
    context_times: int | None = None
    """How many times of the window are context, the latest first (1: the view's own alone); None takes all. With 0
    no camera image is encoded: a model with a coarse fill shows that alone, others have but the view's own patches."""
    read_fraction: float | None = None
    """At most this part of the proxy's pixels is mended, where most is to be gained, beside what no camera colours;
    None is for all that E asks. Rules that ask for no more than that are not changed by it. With 0 a reader of whole
    views reads nothing: it fills what no camera colours from around it, and fades what seems to be background."""


class ContextProvider:
    """What the cameras saw, for an inpainter to ask for; and what was encoded of it, for later views to find.

    `provider(time, names)` gives these cameras at that time, or None. Whoever runs one stream by `step` alone makes one
    provider for all of its views; `viewmend.Stream` makes one for each view, upon a memory that all viewers share.

    Examples:
        >>> from viewmend import ContextProvider, Stream, make_method
        >>> from viewmend.studio.stage import Studio, StudioConfig
        >>> frame = Studio(StudioConfig(cameras=4, frames=1, size_px=64)).read(0)
        >>> now = Stream(make_method("telea")).push(frame)
        >>> context = ContextProvider(lambda time, names: now.context(names) if time == 0 else None)
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
        """Provide views.

        Args:
            views: what the cameras saw, by time and names.
            quality: what the view may cost.
            exclude: names of cameras that nobody may look at.
            memory: what was encoded of a time; by default the provider remembers the times about the last one itself.
        """
        self.quality = quality or RenderQuality()
        self.encoding_ms = 0.0
        """What `encoded` took so far."""
        self._views = views
        self._exclude = frozenset(exclude)
        self._own: dict[int, Memory] = {}
        self._memory = memory or self._remembered

    def __call__(self, time: int, names: Sequence[str]) -> ContextViews | None:
        """These cameras at this time; fewer where some have no frame or are excluded, None where none is left."""
        names = tuple(name for name in names if name not in self._exclude)
        return self._views(time, names) if names else None

    def encoded(
        self,
        times: Sequence[int],
        names: Sequence[str],
        encode: Callable[[list[ContextViews]], Sequence[Sequence[Any]]],
    ) -> list[Any]:
        """What `encode` made of each of these cameras at each of these times, as far as they have frames.

        `encode` is called once, with all that no view needed before; it gives one result per camera of each element.
        """
        names = [name for name in names if name not in self._exclude]
        memories = {time: self._memory(time) for time in times}
        absent = [self(time, [n for n in names if n not in memory]) for time, memory in memories.items()]
        fresh = [views for views in absent if views is not None and len(views.frame.cameras)]
        if fresh:
            device = fresh[0].depth.device
            start = now_s(device)
            for views, results in zip(fresh, encode(fresh), strict=True):
                pairs = zip(views.frame.cameras.names, results, strict=True)
                memories[views.frame.time].update({name: to_own_pages(result) for name, result in pairs})
            self.encoding_ms += ms_since(start, device)
        return [memory[name] for memory in memories.values() for name in names if name in memory]

    def remembered(
        self, time: int, kind: str, names: Sequence[str], make: Callable[[Sequence[str]], Sequence[T]]
    ) -> list[T]:
        """What was made of each of these cameras at this time, for this view or an earlier one.

        Args:
            time: which one.
            kind: tells it from what others make of the cameras.
            names: the cameras.
            make: is called with the names that no view needed before, and gives one result for each.
        """
        memory = self._memory(time)
        absent = [name for name in names if (kind, name) not in memory]
        if absent:
            pairs = zip(absent, make(absent), strict=True)
            memory.update({(kind, name): to_own_pages(made) for name, made in pairs})
        return [memory[kind, name] for name in names]

    def _remembered(self, time: int) -> Memory:
        memory = self._own.setdefault(time, {})
        if len(self._own) > REMEMBERED_TIMES:
            del self._own[max(self._own, key=lambda other: abs(other - time))]
        return memory


@dataclass(frozen=True)
class State:
    """What an inpainter carries from one view of a stream to the next: of its own kind, never changed in place.

    Examples:
        >>> from viewmend import State, make_method
        >>> isinstance(make_method("telea").initial_state(), State)
        True
    """


@runtime_checkable
class ViewInpainter(Protocol):
    """Completes one view after another.

    Examples:
        >>> from viewmend import CompletedView, State, ViewInpainter
        >>> class Grey:
        ...     def initial_state(self):
        ...         return State()
        ...     def step(self, view, context, state):
        ...         return CompletedView(view, view.error * 0.5 + (1 - view.error) * view.rgb), state
        >>> isinstance(Grey(), ViewInpainter)
        True
    """

    def initial_state(self) -> State:
        """The state before the first view of a stream."""
        ...

    def step(self, view: IncompleteView, context: ContextProvider, state: Any, /) -> tuple[CompletedView, State]:
        """The completed view and the state for the next; only pixels with E > 0 may change.

        `context` is asked for no time later than the view's own. `state` is what this inpainter gave before.
        """
        ...


@dataclass(frozen=True)
class HeldOut:
    """A view of a camera of the rig that was left out, and what the camera saw: what `fitted_to_rig` learns from."""

    view: IncompleteView
    context: ContextProvider
    truth: Float[Tensor, "3 height width"]
    """Upon black, in [0, 1]."""


@runtime_checkable
class FitsRig(Protocol):
    """An inpainter that learns a few numbers of a rig before its first view."""

    def fitted_to_rig(self, held: Sequence[HeldOut]) -> ViewInpainter:
        """The same inpainter for this rig; the one that is asked stays as it is."""
        ...


def own_error_rule(inpainter: ViewInpainter) -> str:
    """The error rule that an inpainter is made for; the paper's `unseen` where it has no attribute `error_rule`."""
    return getattr(inpainter, "error_rule", "unseen")


def own_background(inpainter: object) -> Background | None:
    """What an inpainter was trained to paint upon, black or white; None for whatever it is shown (classical fills)."""
    return getattr(inpainter, "background", None)


def shown_upon(inpainter: object) -> Background:
    """What views that this mended are to be laid upon, since what it takes for background it paints so."""
    return own_background(inpainter) or "black"


def encode_past(inpainter: ViewInpainter, view: IncompleteView, context: ContextProvider) -> None:
    """Encodes what a view needs of earlier times, as if these had been looked at when they were now.

    An inpainter tells how by a method of this name; one without has nothing to encode.
    """
    own = getattr(inpainter, "encode_past", None)
    if own is not None:
        own(view, context)


def state_after(inpainter: ViewInpainter, view: IncompleteView, state: State) -> State | None:
    """The state after a view that nobody wants filled; None where only filling it tells.

    An inpainter tells by a method of this name, of the view and the state before; one without fills every view.
    """
    own = getattr(inpainter, "state_after", None)
    return None if own is None else own(view, state)


def encode_cameras(inpainter: ViewInpainter, views: ContextViews, context: ContextProvider) -> None:
    """All that an inpainter encodes of these cameras at their time, whatever the view, for `context` to remember.

    Nothing for an inpainter that has no `encode_cameras`: it encodes nothing of cameras, or for each view anew.
    """
    own = getattr(inpainter, "encode_cameras", None)
    if own is not None:
        own(views, context)


def crop_margin_px(inpainter: ViewInpainter, quality: RenderQuality) -> int | None:
    """How far around the subject a view matters to what fills it, pixels; None where the whole view does.

    An inpainter tells by a method of this name; one without is given whole views.
    """
    own = getattr(inpainter, "crop_margin_px", None)
    return None if own is None else own(quality)
