"""The live server's application behind a proxy, which has connection limits of its own."""

from live.live_servers import PIPELINE, in_own_loop

from viewmend.contrib.ray.replicas import StartWhenReady
from viewmend.live.push import PushSource
from viewmend.live.renderer import Renderer
from viewmend.live.server import LiveServer, ServerConfig
from viewmend.live.service import RenderService
from viewmend.models.smooth_fill import SmoothFill

TOKEN = "a token, long enough"


async def ready_at_once():
    return None


def live_app(token=None):
    source = PushSource()
    service = RenderService(Renderer(source, SmoothFill(), PIPELINE), source)
    return LiveServer(service, ServerConfig(token=token)).app()


async def get(app, path, query=b"", headers=()):
    """Status and body."""
    sent = []
    scope = {"type": "http", "method": "GET", "path": path, "query_string": query, "http_version": "1.1"}
    scope |= {"headers": [(b"host", b"127.0.0.1:8008"), *headers], "server": ("127.0.0.1", 8008), "root_path": ""}

    async def send(message):
        sent.append(message)

    async def receive():
        return {"type": "http.request", "body": b"", "more_body": False}

    await app(scope, receive, send)
    return sent[0]["status"], b"".join(message.get("body", b"") for message in sent)


@in_own_loop
async def test_token_and_origin_are_checked_behind_a_proxy():
    status, body = await get(StartWhenReady(live_app(), ready_at_once), "/")
    assert status == 200 and b"viewmend" in body
    app = StartWhenReady(live_app(TOKEN), ready_at_once)
    assert (await get(app, "/health"))[0] == 401
    assert (await get(app, "/health", b"token=a+token%2C+long+enough"))[0] == 200
    assert (await get(app, "/", headers=[(b"origin", b"http://elsewhere.example")]))[0] == 403


@in_own_loop
async def test_the_start_is_reported_when_the_first_view_is_rendered():
    order = []

    async def app(scope, receive, send):
        await send({"type": "lifespan.startup.complete"})

    async def ready():
        order.append("ready")

    async def send(message):
        order.append(message["type"])

    await StartWhenReady(app, ready)({"type": "lifespan"}, None, send)
    assert order == ["ready", "lifespan.startup.complete"]
