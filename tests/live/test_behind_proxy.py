"""The application behind another program's connections."""

import asyncio
from concurrent.futures import ThreadPoolExecutor

import pytest
from live_servers import PIPELINE
from starlette.responses import PlainTextResponse
from starlette.routing import Route

from viewmend.inpainting.coarse_fill import SmoothFill
from viewmend.live.behind_proxy import BehindProxy
from viewmend.live.door import admit, visitor_of
from viewmend.live.pushed import PushedFrames
from viewmend.live.renderer import Renderer
from viewmend.live.server import LiveServer, ServerConfig
from viewmend.live.service import RenderService

TOKEN = "a token, long enough"


def ran(work):
    """What a coroutine gives; a browser's tests leave a loop running in this thread."""
    with ThreadPoolExecutor(1) as own:
        return own.submit(asyncio.run, work).result()


async def nothing():
    return None


def live_app(token=None):
    supply = PushedFrames()
    server = LiveServer(RenderService(Renderer(supply, SmoothFill(), PIPELINE), supply), ServerConfig(token=token))
    return server.app()


def asked(app, path, query=b"", headers=()):
    """Status and body of a GET."""
    sent = []
    scope = {"type": "http", "method": "GET", "path": path, "query_string": query, "http_version": "1.1"}
    scope |= {"headers": [(b"host", b"127.0.0.1:8008"), *headers], "server": ("127.0.0.1", 8008), "root_path": ""}

    async def send(message):
        sent.append(message)

    async def receive():
        return {"type": "http.request", "body": b"", "more_body": False}

    ran(app(scope, receive, send))
    return sent[0]["status"], b"".join(message.get("body", b"") for message in sent)


def test_who_comes_by_a_proxy_is_served():
    app = BehindProxy(live_app(), nothing)
    status, body = asked(app, "/")
    assert status == 200 and b"viewmend" in body
    with pytest.raises(KeyError, match="state"):
        asked(live_app(), "/")


def test_token_and_origin_hold_as_without_a_proxy():
    app = BehindProxy(live_app(TOKEN), nothing)
    assert asked(app, "/health")[0] == 401
    assert asked(app, "/health", b"token=a+token%2C+long+enough")[0] == 200
    assert asked(app, "/", headers=[(b"origin", b"http://elsewhere.example")])[0] == 403


def test_every_connection_is_a_visitor_of_its_own():
    seen = []

    def answer(request):
        visitor = visitor_of(request)
        seen.append((visitor, visitor.admitted, visitor.gone))
        admit(request)
        return PlainTextResponse("here")

    from starlette.applications import Starlette

    app = BehindProxy(Starlette(routes=[Route("/", answer)]), nothing)
    assert asked(app, "/")[0] == asked(app, "/")[0] == 200
    assert [found[1:] for found in seen] == [(False, False)] * 2 and seen[0][0] is not seen[1][0]
    assert seen[0][0].admitted


def test_it_has_started_when_it_is_ready_and_not_before():
    order = []

    async def ready():
        order.append("ready")

    async def app(scope, receive, send):
        order.append("begun")
        await send({"type": "lifespan.startup.complete"})
        await send({"type": "lifespan.shutdown.complete"})

    async def send(message):
        order.append(message["type"])

    ran(BehindProxy(app, ready)({"type": "lifespan"}, nothing, send))
    assert order == ["begun", "ready", "lifespan.startup.complete", "lifespan.shutdown.complete"]
