"""The live server's application where another program holds the connections."""

from collections.abc import Awaitable, Callable

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from viewmend.live.door import Visitor


class ProxiedVisitor(Visitor):
    """Somebody who came by a proxy: the bounds of connections are the proxy's, and so is what is known of them."""

    def admit(self, message_bytes: int = 0) -> None:
        """Nothing: the proxy has read the message already."""
        self.admitted = True

    @property
    def gone(self) -> bool:
        """False: the proxy tells it by a message, as soon as the application receives one."""
        return False


class BehindProxy:
    """An application that is told of proxied visitors, and says that it has started once it is ready."""

    def __init__(self, app: ASGIApp, ready: Callable[[], Awaitable[None]]) -> None:
        """Wrap an application; `ready` returns when viewers may come."""
        self._app, self._ready = app, ready

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """As ASGI says."""

        async def send_when_ready(message: Message) -> None:
            if message["type"] == "lifespan.startup.complete":
                await self._ready()
            await send(message)

        if scope["type"] == "lifespan":
            await self._app(scope, receive, send_when_ready)
        else:
            state = {**scope.get("state", {}), "visitor": ProxiedVisitor()}
            await self._app({**scope, "state": state}, receive, send)
