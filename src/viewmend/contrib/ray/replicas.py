"""Many viewers, on Ray Serve: one actor reads the rig, replicas render for the viewers that its proxy gives them."""

import asyncio
import contextlib
import logging
import math
import socket
import threading
import time
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from viewmend.contrib.ray.cluster import LOCAL, connect, find_ray
from viewmend.contrib.ray.ingest import Ingest, SourceState
from viewmend.contrib.ray.shared_frame import SharedFrame
from viewmend.contrib.ray.shared_source import SharedSource
from viewmend.live.frame_source import FrameSource
from viewmend.live.renderer import Renderer
from viewmend.live.server import LiveServer, ServerConfig
from viewmend.live.service import RenderService
from viewmend.models.base import Inpainter
from viewmend.models.registry import error_model_for
from viewmend.stream import StreamConfig
from viewmend.utils.heap import configure_allocator, freeze_loaded_objects

NAME = "viewmend"
"""Serve's name for the application."""
ANSWER_S = 30.0
"""A call of the ingest may take this many seconds longer than it waits: it may be computing a hull."""
READY_S = 120.0
"""A replica accepts viewers after its first rendered view, or after this many seconds."""
SPARE_REQUESTS = 8
"""A replica takes this many requests in addition to its viewers: images, paths, /health."""
WELL_FILLED = 0.75
"""Replicas are added if more than this fraction of all viewers' places is taken."""
STOPPING_S = 5.0
"""A replica that stops has this many seconds to end its requests."""
INGEST_SHARE = 0.4
"""The ingest's frames take at most this fraction of the store."""
REPLICAS_SHARE = 0.4
"""Older frames that a machine's replicas still use take at most this fraction of the store."""
REPLICAS_PER_MACHINE = 8
"""The store is divided as if a machine had at most this many replicas."""


@dataclass(frozen=True, kw_only=True)
class ManyViewers:
    """What is served, and how many replicas render it."""

    open_source: Callable[[], FrameSource]
    """Called in the process that reads the cameras; raises ValueError or OSError."""
    load_inpainter: Callable[[], Inpainter]
    server: ServerConfig
    stream: StreamConfig
    device: str
    precision: str = "auto"
    """Number format of the error model, and of models that viewers compare, as in `load_inpainter`."""
    replicas: tuple[int, int]
    """Minimum and maximum number."""
    store_mb: float
    """Shared memory per machine."""

    @property
    def replica_mb(self) -> float:
        """Shared memory per replica."""
        return REPLICAS_SHARE * self.store_mb / min(self.replicas[1], REPLICAS_PER_MACHINE)


class IngestActor:
    """The ingest as an actor. The first call opens the source, so that its errors reach the caller."""

    def __init__(self, served: ManyViewers, put: Callable[[SharedFrame], Any]) -> None:
        configure_allocator()
        self._served = served
        self._put = put
        self._opening = threading.Lock()
        self._ingest: Ingest | None = None

    def state(self, known: int, wait_s: float, watched: bool) -> SourceState:
        """See `Ingest.state`."""
        return self._opened().state(known, wait_s, watched)

    def frame(self, index: int, wait_s: float) -> tuple[str, Any] | None:
        """See `Ingest.frame`."""
        return self._opened().frame(index, wait_s)

    def _opened(self) -> Ingest:
        with self._opening:
            if self._ingest is None:
                served = self._served
                source = served.open_source()
                inpainter = served.load_inpainter()
                self._ingest = Ingest(
                    source, inpainter, served.stream.hull, INGEST_SHARE * served.store_mb, self._put
                )
                freeze_loaded_objects()
            return self._ingest


class RayIngest:
    """The connection to the ingest's actor. Frames are read from this machine's object store without copies."""

    def __init__(self, actor: Any) -> None:
        self._actor = actor

    def state(self, known: int, wait_s: float, watched: bool) -> SourceState:
        """See `IngestLink.state`."""
        return self._answer(self._actor.state.remote(known, wait_s, watched), wait_s)

    def frame(self, index: int, wait_s: float) -> tuple[str, SharedFrame] | None:
        """See `IngestLink.frame`."""
        found = self._answer(self._actor.frame.remote(index, wait_s), wait_s)
        return None if found is None else (found[0], self._answer(found[1][0], wait_s))

    def _answer(self, reference: Any, wait_s: float) -> Any:
        import ray
        from ray.exceptions import RayError

        try:
            return ray.get(reference, timeout=wait_s + ANSWER_S)
        except RayError as error:
            raise ConnectionError(" ".join(str(error).split())[:200]) from error


@contextlib.contextmanager
def serving(served: ManyViewers, address: str) -> Iterator[str]:
    """Serve on a cluster within the context; yields the viewers' address once replicas are ready.

    Raises:
        ValueError: Ray is not installed, there is no cluster, Serve runs on it, or the source cannot be read.
        OSError: the port is in use.
    """
    host = served.server.host
    port = _free_port(host, served.server.port)
    ray = find_ray(address)
    logging.getLogger("ray").setLevel(logging.ERROR)
    connect(ray, address, num_cpus=served.replicas[1] + 1, object_store_memory=int(1e6 * served.store_mb))
    from ray import serve

    logging.getLogger("ray.serve").setLevel(logging.ERROR)
    try:
        _demand_no_serve(ray)
        calls = 4 * served.replicas[1] + 8  # two calls per replica, and per replica that is being replaced
        actor = ray.remote(num_cpus=1, max_restarts=-1, max_concurrency=calls)(IngestActor)
        ingest = actor.remote(served, _put)
        opened = ingest.state.remote(-1, 0.0, False)
        quiet = {"enable_access_log": False, "log_level": "ERROR"}
        serve.start(http_options={"host": host, "port": port}, logging_config=quiet)
        try:
            ray.get(opened)
        except ray.exceptions.RayTaskError as error:
            if isinstance(error.cause, ValueError | OSError):  # the source's own
                raise error.cause from None
            raise
        serve.run(_application(serve, served, ingest), name=NAME, route_prefix="/", logging_config=quiet)
        try:
            yield f"http://{f'[{host}]' if ':' in host else host}:{port}"
        finally:
            if address != LOCAL:  # a local cluster ends as a whole
                serve.shutdown()
                ray.kill(ingest)
    finally:
        ray.shutdown()


def _application(serve: Any, served: ManyViewers, ingest: Any) -> Any:
    """Serve's deployment: replicas of the live server's application."""

    def build() -> StartWhenReady:
        return _replica(served, RayIngest(ingest))

    viewers = served.server.limits.viewers
    min_replicas, max_replicas = served.replicas
    target = max(1, math.floor(WELL_FILLED * viewers))
    scaling = {"min_replicas": min_replicas, "initial_replicas": min_replicas, "max_replicas": max_replicas}
    deployment = serve.deployment(
        name="replica",
        ray_actor_options={"num_cpus": 1, "num_gpus": 1 if served.device.startswith("cuda") else 0},
        max_ongoing_requests=viewers + SPARE_REQUESTS,
        autoscaling_config={**scaling, "target_ongoing_requests": target},
        graceful_shutdown_timeout_s=STOPPING_S,
        health_check_period_s=1.0,
    )
    return deployment(serve.ingress(build)(_Replica)).bind()


class StartWhenReady:
    """An ASGI application that reports its start once it is ready, for Serve's proxy, which has limits of its own."""

    def __init__(self, app: ASGIApp, ready: Callable[[], Awaitable[None]]) -> None:
        """Wrap an application; `ready` returns when viewers may connect."""
        self._app = app
        self._ready = ready

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve a connection as an ASGI application."""

        async def send_when_ready(message: Message) -> None:
            if message["type"] == "lifespan.startup.complete":
                await self._ready()
            await send(message)

        await self._app(scope, receive, send_when_ready if scope["type"] == "lifespan" else send)


class _Replica:
    """Holds the application; Serve's ingress adds its methods."""


def _replica(served: ManyViewers, ingest: RayIngest) -> StartWhenReady:
    """The application of one replica: its renderer works on frames of the ingest."""
    configure_allocator()
    source = SharedSource(ingest, served.replica_mb / 2)
    stream = replace(served.stream, memory_mb=min(served.stream.memory_mb or math.inf, served.replica_mb / 2))
    inpainter = served.load_inpainter()
    in_page = served.server.draws_in_page
    error_model = error_model_for(inpainter, served.device, served.precision)
    renderer = Renderer(
        source,
        inpainter,
        stream,
        served.device,
        error_model,
        draws_in_page=in_page,
        precision=served.precision,
    )
    service = RenderService(renderer, source)

    async def ready() -> None:
        end = time.monotonic() + READY_S
        while not service.is_ready and time.monotonic() < end and not (source.status.error or service.error):
            await asyncio.sleep(0.05)
        freeze_loaded_objects()

    return StartWhenReady(LiveServer(service, served.server).app(), ready)


def _put(shared: SharedFrame) -> list[Any]:
    """Store a frame; its reference is in a list so that Ray does not resolve it for the caller."""
    import ray

    return [ray.put(shared)]


def _demand_no_serve(ray: Any) -> None:
    """Raise if Ray Serve already runs on this cluster, since it has a single port."""
    try:
        ray.get_actor("SERVE_CONTROLLER_ACTOR", namespace="serve")
    except ValueError:
        return
    raise ValueError(
        "expected a Ray cluster on which Serve does not run, got one on which it does; end what it serves (serve "
        "shutdown), or use another cluster"
    )


def _free_port(host: str, port: int) -> int:
    """The port, or a free one for 0; checked here because Ray reports a used port late and at length.

    Raises:
        OSError: it is in use.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        with socket.create_server((host, port), family=family) as listener:
            return int(listener.getsockname()[1])
    except OSError as error:
        raise OSError(
            f"port {port} of {host}: {error.strerror or error}; choose another --port or --host"
        ) from None
