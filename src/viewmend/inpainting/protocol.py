"""What every inpainter of views obeys, ours and the baselines: state is passed, not hidden."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

from viewmend.inpainting.context import ContextCache
from viewmend.inpainting.temporal_accumulation import LastView
from viewmend.views import CompletedView, ContextViews, IncompleteView

Source = Callable[[int, tuple[str, ...]], ContextViews | None]
"""source(time, names): these cameras at that time with the proxy's depth; fewer where some have no frame, None where
none has."""


@dataclass(frozen=True)
class State:
    """What a stream carries from one step to the next; a fresh one starts a stream. Never changed in place."""

    cache: ContextCache = field(default_factory=ContextCache)
    last: LastView | None = None
    """The last view, where `steady` looks at it."""


@runtime_checkable
class ViewInpainter(Protocol):
    """Completes one view after another."""

    def initial_state(self) -> State:
        """The state before the first view of a stream."""
        ...

    def step(self, view: IncompleteView, source: Source, state: State) -> tuple[CompletedView, State]:
        """The completed view and the state for the next; only pixels with E > 0 may change.

        `source` is asked for no time later than the view's own.
        """
        ...
