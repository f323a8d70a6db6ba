"""The viewers of a server: their sessions, and the task that lets their connections send what is due."""

import asyncio
import contextlib
import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

from viewmend.live.extension import Extension
from viewmend.live.protocol import Limits
from viewmend.live.service import RenderService
from viewmend.live.sessions import ViewerSession

TICK_S = 0.25
"""The registry checks every this many seconds what its connections have to send."""
LIVE_TICK_S = 0.1
"""The interval of these checks while a rig pushes frames, in seconds; a frame that arrives causes
one at once."""


@dataclass(frozen=True)
class SharedState:
    """What is the same for all viewers at one moment."""

    source: dict[str, Any]
    """The shared fields of the message `state`."""
    show: dict[str, Any] | None
    """The message `show`: a view that the serving program wants all pages to show; None if there was none."""
    rig: dict[str, Any] | None
    """The message `rig`; None before the first frame."""
    viewers: int
    """The number of connected viewers."""
    made_ahead: int
    """The number of meshes and completed views that were made ahead so far."""


@runtime_checkable
class Connection(Protocol):
    """A connection, as the registry sees it."""

    def send_due(self, shared: SharedState) -> float:
        """Send what is due; returns the time of the next call, which comes earlier if the shared state changes."""
        ...

    def fail(self, error: Exception) -> None:
        """End the connection."""
        ...


@dataclass
class SessionRegistry:
    """The sessions of all viewers, and what their connections share."""

    service: RenderService
    limits: Limits
    budget_ms: float | None
    about: dict[str, Any]
    """Fields of the message `welcome` that are the same for all viewers."""
    extensions: Sequence[Extension] = ()
    sessions: list[ViewerSession] = field(default_factory=list)
    connections: dict[Connection, float] = field(default_factory=dict)
    """Each connection after its `hello`, with the time of its next check; a change is sent earlier."""
    numbers: "itertools.count[int]" = field(default_factory=itertools.count)
    shown: dict[str, Any] | None = None
    """The message `show` that moves all pages, also those that are opened later; set on any thread."""

    _sender: "asyncio.Task[None] | None" = None
    """Runs `_send_to_all` while there are connections."""

    def join(self, connection: Connection) -> None:
        """Let a connection send what is due, now and from now on."""
        shared = self.shared_state()
        self.connections[connection] = connection.send_due(shared)
        if self._sender is None or self._sender.done():
            self._sender = asyncio.create_task(self._send_to_all(shared))

    def leave(self, connection: Connection) -> None:
        """Forget a connection that has ended. Its `join` may have failed."""
        self.connections.pop(connection, None)

    async def _send_to_all(self, shared: SharedState) -> None:
        """Let all connections send what is due, while there are any; they already know the state `shared`."""
        news = asyncio.Event()
        loop = asyncio.get_running_loop()

        def note_change() -> None:
            with contextlib.suppress(RuntimeError):  # the event loop has ended
                loop.call_soon_threadsafe(news.set)

        self.service.changed = note_change
        while self.connections:
            news.clear()
            newest = self.shared_state()
            has_changed = newest != shared
            if has_changed:  # otherwise connections get the same object as before
                shared = newest
            now = self.service.now()
            for connection, due_s in list(self.connections.items()):
                if has_changed or due_s <= now:
                    self._send_due(connection, shared)
            if self.service.source.span.live:
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(news.wait(), LIVE_TICK_S)
            else:
                await asyncio.sleep(TICK_S)

    def _send_due(self, connection: Connection, shared: SharedState) -> None:
        """Let one connection send what is due; an error ends this connection only."""
        try:
            self.connections[connection] = connection.send_due(shared)
        except Exception as error:
            connection.fail(error)

    def check_soon(self, connection: Connection) -> None:
        """Let this connection send what is due at the next check."""
        self.connections[connection] = 0.0

    def shared_state(self) -> SharedState:
        """What is the same for all viewers now."""
        service = self.service
        return SharedState(
            self.source_json(),
            self.shown,
            service.renderer.rig_json,
            len(self.sessions),
            service.ahead.num_made,
        )

    def source_json(self) -> dict[str, Any]:
        """The shared fields of the message `state`."""
        service = self.service
        span = service.source.span
        status = service.source.status
        is_loading = status.state == "ready" and not service.is_ready
        return {
            "source": "loading" if is_loading else status.state,
            "error": status.error or service.error,
            "model_error": service.renderer.model_error,
            "first": span.first,
            "end": span.end,
            "total": span.total,
            "loops": not span.live,
            "kind": "live" if span.live else "recording",
        }
