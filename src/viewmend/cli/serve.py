"""`viewmend serve`: a web page for moving around the subject, live."""

import os
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NoReturn

import tyro

from viewmend.cli.checks import Precision, PreparationOptions, ViewOptions, check_least, make_studio
from viewmend.utils.options import FLAT
from viewmend.utils.plugins import import_object

if TYPE_CHECKING:
    from viewmend.live.frame_source import FrameSource
    from viewmend.live.server import ServerConfig
    from viewmend.models.base import Inpainter
    from viewmend.stream import StreamConfig

TOKEN_VARIABLE = "VIEWMEND_TOKEN"
RIG_SOURCE = "viewmend.contrib.live_rig.rig_source:RigFileSource"
"""The source of frames of live rigs, as MODULE:NAME."""
RAY_SETTINGS = "viewmend.contrib.ray.replicas:ManyViewers"
"""The settings of a server for many viewers, as MODULE:NAME."""
SERVE_ON_RAY = "viewmend.contrib.ray.replicas:serving"
"""The server for many viewers, as MODULE:NAME."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """Serve a web page for moving around the subject, live: as rendered, with holes, or completed.

    The command prints the page's address. Only this machine can open it unless --host and
    --token are given. See docs/live.md for the page, the time budget, single images over
    HTTP and live rigs.
    """

    source: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="CAPTURE|rig.toml|studio|live")] = (
        "studio"
    )
    """A capture with masks; a TOML file that lists the cameras of a live rig
    (docs/guide/live-rig.md); 'studio' for a synthetic scene; or 'live' for a rig that
    pushes its frames."""
    format: str | None = None
    """Format of the capture (docs/formats.md); recognised by default."""
    port: int = 8008
    """Port; 0 takes a free one."""
    host: str = "127.0.0.1"
    """Address to bind to; an address that other machines can reach needs --token."""
    token: str | None = None
    """Access token, at least 16 characters. It is visible in the process list; prefer --token-file
    or the environment variable VIEWMEND_TOKEN."""
    token_file: Path | None = None
    """File whose first line is the token."""
    public_url: str | None = None
    """Address at which a reverse proxy serves the page, such as https://example.org/rig; needs --token."""
    model: str | None = None
    """A shipped model's name or a model's folder; 'telea' and 'nearest' are classical fills. By
    default 'views'."""
    render: Literal["page", "server"] = "page"
    """Where moving views are drawn: in the page, from the frame's mesh and images, or on the
    server. Views at rest are completed on the server either way."""
    fps: float | None = None
    """Frames per second; by default those of the capture."""
    budget_ms: float = 100.0
    """Milliseconds that a view may take; quality is reduced to stay within them. 0: no limit; moving views
    are simplified either way."""
    max_image_size: int = 1024
    """Longest side of the cameras' images, in pixels; larger images are reduced when they are read."""
    preparation: Annotated[PreparationOptions, FLAT] = field(default_factory=PreparationOptions)
    view: Annotated[ViewOptions, FLAT] = field(default_factory=ViewOptions)
    viewers: int = 8
    """Maximum number of viewers; with --ray, per replica."""
    broadcast: str | None = None
    """Also broadcast one viewer's view to everyone at /watch, as a video of this size: WIDTHxHEIGHT."""
    ray: str | None = None
    """Address of a Ray cluster that renders: HOST:PORT, auto, or local (needs viewmend[ray])."""
    replicas: int = 2
    """Minimum number of rendering processes (with --ray)."""
    max_replicas: int | None = None
    """Maximum number of rendering processes (with --ray); by default --replicas."""
    cameras: int = 8
    """Number of cameras of 'studio'."""
    frames: int = 60
    """Number of frames of 'studio'."""
    size: int = 320
    """Width and height of the images of 'studio', in pixels."""
    seed: int | None = None
    """Seed of the scene of 'studio'; by default one that no model was trained with."""
    device: str = "cpu"
    """Device to compute on: cpu or cuda."""
    precision: Precision = "auto"
    """Number format of viewmend's own networks. 'auto' is bfloat16 if the model was
    trained in it and the device computes in it natively, otherwise float32."""
    memory_mb: float = 3000.0
    """Memory for frames and what is computed from them; with --ray, half of it is the processes'
    shared memory."""


def run(options: Options) -> int:
    """Serve until interrupted."""
    _check(options)
    os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(2**26))  # of a pushed image
    if options.ray is not None:
        _serve_on_ray(options, options.ray)
    from viewmend.cli.console import say
    from viewmend.completed_cameras import MAX_COMPLETED
    from viewmend.live.listener import Server
    from viewmend.live.protocol import token_query
    from viewmend.live.renderer import Renderer
    from viewmend.live.server import LiveServer
    from viewmend.live.service import RenderService
    from viewmend.models.registry import error_model_for
    from viewmend.utils.heap import configure_allocator, freeze_loaded_objects

    configure_allocator()
    config = server_config(options)
    source = open_source(options)
    inpainter = load_inpainter(options)
    renderer = Renderer(
        source,
        inpainter,
        stream_config(options),
        options.device,
        error_model_for(inpainter, options.device, options.precision),
        draws_in_page=config.draws_in_page,
        precision=options.precision,
        completed_cameras=MAX_COMPLETED,
    )
    live = LiveServer(RenderService(renderer, source), config)
    server = Server(live, config)
    with server.bind() as local_address:
        freeze_loaded_objects()
        query = token_query(config.token)
        address = (config.public_url or local_address).rstrip("/")
        say(f"open {address}/{query}   (Ctrl-C stops it)")
        for extension in live.extensions:
            if extension.notice:
                say(extension.notice.format(address=address, query=query))
        server.run()
    return 0


def _check(options: Options) -> None:
    """Raise a ValueError for an option that is out of range, before anything heavy is imported."""
    at_least_1 = ("max_image_size", "viewers", "frames", "size", "memory_mb", "replicas")
    check_least(
        options, **dict.fromkeys(at_least_1, 1), cameras=4, budget_ms=0, max_replicas=options.replicas
    )
    checks = [
        ("fps", options.fps is None or 0 < options.fps <= 240, "above 0 and at most 240"),
        ("port", 0 <= options.port <= 65535, "from 0 to 65535"),
    ]
    for name, is_valid, limit in checks:
        if not is_valid:
            raise ValueError(f"--{name.replace('_', '-')} must be {limit}, got {getattr(options, name)}")
    if options.broadcast is not None and options.ray is not None:
        raise ValueError("expected --broadcast or --ray, got both; --broadcast needs a server of one process")
    as_read = (Options.max_image_size, PreparationOptions())
    if options.source == "live" and (options.max_image_size, options.preparation) != as_read:
        raise ValueError(
            "expected neither --max-image-size nor --no-align, --no-match-colours or --no-tighten-masks "
            "with live, whose frames are used as they are pushed; leave it out"
        )
    if options.ray is not None and options.source == "live":
        raise ValueError(
            "expected a capture, rig.toml or studio with --ray, got live: a rig would push to one process only; "
            "leave out --ray, or list the rig's cameras in a file (docs/guide/live-rig.md)"
        )


def server_config(options: Options) -> "ServerConfig":
    """Address, limits and optional parts of the server; ValueError or OSError if an option cannot be used."""
    from viewmend.live.auth import AccessControl
    from viewmend.live.protocol import Limits
    from viewmend.live.server import EXTENSIONS, ServerConfig, load_extension
    from viewmend.models.registry import default_method

    token = _token(options)
    AccessControl(options.host, token, options.public_url)
    values = {"broadcast": options.broadcast}
    return ServerConfig(
        host=options.host,
        port=options.port,
        token=token,
        public_url=options.public_url,
        budget_ms=options.budget_ms or None,
        model=options.model or default_method(),
        draws_in_page=options.render == "page",
        limits=Limits(viewers=options.viewers),
        extensions=tuple(
            load_extension(name, values[name]) for name in EXTENSIONS if values[name] is not None
        ),
    )


def stream_config(options: Options) -> "StreamConfig":
    """Parameters of geometry, rendering and memory."""
    from viewmend.stream import StreamConfig

    return StreamConfig(render=options.view.config(), memory_mb=options.memory_mb / 2)


def load_inpainter(options: Options) -> "Inpainter":
    """Load the model; with --ray, in each process that renders."""
    from viewmend.cli.checks import load_named

    return load_named(options.model, options.device, options.precision)


def _token(options: Options) -> str | None:
    """The token from the option, the file or the environment; None if there is none."""
    token = options.token or os.environ.get(TOKEN_VARIABLE)
    if options.token_file is not None:
        if options.token is not None:
            raise ValueError("expected --token or --token-file, got both; give one of them")
        with options.token_file.open(encoding="utf-8") as file:
            token = file.readline(4096).strip()
        if not token:
            raise ValueError(f"{options.token_file}: expected the token in its first line, got an empty line")
    return token or None


def open_source(options: Options) -> "FrameSource":
    """The source of frames; ValueError or OSError if it cannot be used."""
    from viewmend.live.frame_source import RecordedSource
    from viewmend.live.push import PushSource

    memory_mb = options.memory_mb / 2
    size_px = options.max_image_size
    prepared = asdict(options.preparation)
    if options.source == "live":
        return PushSource(options.fps, memory_mb)
    if options.source.endswith(".toml"):
        rig_source: Callable[..., FrameSource] = import_object(RIG_SOURCE)
        return rig_source(Path(options.source), options.fps, memory_mb, size_px, **prepared)
    if options.source == "studio":
        return RecordedSource(
            # made on the thread that reads its frames, so that the page is available at once
            partial(
                make_studio,
                options.seed,
                options.cameras,
                options.frames,
                options.size,
                options.max_image_size,
            ),
            options.fps,
            generated=True,
            memory_mb=memory_mb,
        )
    from viewmend.cli.checks import log_preparation
    from viewmend.data.prepare import open_masked, prepare

    # Prepared before the address is printed, so that an unusable capture is an error of the command.
    source = prepare(open_masked(options.source, format=options.format), max_image_size=size_px, **prepared)
    log_preparation(source)
    return RecordedSource(lambda: source, options.fps, memory_mb=memory_mb)


def _serve_on_ray(options: Options, address: str) -> NoReturn:
    """Serve on a Ray cluster until interrupted: one process reads the rig, several render."""
    from viewmend.cli.console import exit_on_sigterm, say
    from viewmend.live.auth import is_loopback
    from viewmend.live.protocol import token_query
    from viewmend.models.registry import METHODS, shipped_models

    config = server_config(options)
    if not is_loopback(config.host):
        say(
            "Ray's proxy does not limit unauthenticated connections; use another proxy that does (docs/live.md)"
        )

    # Ray's processes have other working directories. The name of a method is never taken for a folder.
    absolute: dict[str, Any] = {"source": _absolute(options.source)}
    absolute["view"] = replace(options.view, error_rule=_absolute(options.view.error_rule))
    if options.model not in (*shipped_models(), *METHODS):
        absolute["model"] = _absolute(options.model)
    remote = replace(options, **absolute)
    settings = import_object(RAY_SETTINGS)(
        open_source=partial(open_source, remote),
        load_inpainter=partial(load_inpainter, remote),
        server=config,
        stream=stream_config(remote),
        device=options.device,
        precision=options.precision,
        replicas=(options.replicas, options.max_replicas or options.replicas),
        store_mb=options.memory_mb / 2,
    )
    # Ray has a signal handler of its own.
    with import_object(SERVE_ON_RAY)(settings, address) as url, exit_on_sigterm():
        say(f"open {(config.public_url or url).rstrip('/')}/{token_query(config.token)}   (Ctrl-C stops it)")
        while True:  # Python handles signals in this thread, between two sleeps
            time.sleep(0.5)


def _absolute(name: str | None) -> str | None:
    """The absolute path of a file or folder, for other processes; any other name as it is."""
    if name is None:
        return None
    path, colon, attribute = name.rpartition(":")
    if colon and Path(path).is_file():
        return f"{Path(path).resolve()}:{attribute}"
    return str(Path(name).resolve()) if Path(name).exists() else name
