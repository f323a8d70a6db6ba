"""A stream of a method's own, upon what was carved once for all."""

from viewmend.inpainting.protocol import ContextProvider
from viewmend.observation import Observation
from viewmend.stream import Stream
from viewmend.views import ContextViews


def push_again(stream: Stream, observation: Observation) -> None:
    """The same frame and proxy, with what is known of its depths, and nothing that others encoded."""
    stream.push(observation.frame, observation.proxy).depths.update(observation.depths)


def all_of(stream: Stream) -> ContextProvider:
    """All that a stream saw, and what was encoded of it."""

    def seen(time: int, names: tuple[str, ...]) -> ContextViews | None:
        return stream.observation(time).context(names) if time in stream.times else None

    return ContextProvider(seen, memory=lambda time: stream.observation(time).encoded if time in stream.times else {})
