"""The interface of optional parts of the live server, such as the broadcast."""

import contextlib
from collections.abc import Awaitable, Callable, Mapping
from typing import Any

from starlette.requests import Request
from starlette.responses import Response

from viewmend.live.protocol import Message
from viewmend.live.sessions import ViewerSession


class Extension:
    """An optional part of the live server; by default, every method does nothing."""

    notice: str | None = None
    """What `viewmend serve` prints after the address; {address} and {query} are replaced."""

    def routes(self) -> Mapping[str, Callable[[Request], Awaitable[Response]]]:
        """Handlers of GET requests by path; the server checks token and origin."""
        return {}

    def running(self) -> contextlib.AbstractAsyncContextManager[None]:
        """A context manager that is entered while the server runs."""
        return contextlib.nullcontext()

    def welcome_json(self) -> dict[str, Any]:
        """Fields of the message `welcome`."""
        return {}

    def state_json(self, session: ViewerSession) -> dict[str, Any]:
        """Fields of a viewer's message `state`."""
        return {}

    def handle(self, session: ViewerSession, message: Message) -> bool:
        """Handle a viewer's message, under the service's lock; returns whether it is for this extension."""
        return False

    def leave(self, session: ViewerSession) -> None:
        """Note that a viewer has left, under the service's lock."""

    def metrics(self) -> list[str]:
        """Lines for /metrics."""
        return []
