"""`viewmend serve`: walk around the subject in a browser, while it happens."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from viewmend.leave_one_out.splits import PROCEDURAL_SEEDS

if TYPE_CHECKING:
    from viewmend.capture.source import CaptureSource
    from viewmend.inpainting.protocol import ViewInpainter
    from viewmend.live.frames import FrameSupply
    from viewmend.live.server import ServerConfig
    from viewmend.stream import StreamConfig

TOKEN_VARIABLE = "VIEWMEND_TOKEN"


@dataclass(frozen=True, kw_only=True)
class Options:
    """Open a page where a person walks around the subject: rendered, its holes, and mended, live.

    The page is at the address that is printed; nothing else is needed, and it asks nothing of anywhere else. Only this
    machine can open it, unless --host and --token say otherwise. The page itself shows the keys (press ?);
    docs/live.md has the rest: the clock, the budget, single pictures over HTTP, how to push a live rig;
    docs/guide/live-rig.md the rig's file.
    """

    source: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="CAPTURE|rig.toml|studio|live")] = "studio"
    """A capture of any format that is read, with masks; a rig's TOML file, which names its cameras (webcams, network
    streams, videos as if they were live); 'studio' for a synthetic scene made on the spot; or 'live' for a rig that
    pushes its frames."""
    kind: str | None = None
    """The capture's format, as docs/formats.md names it; by default it is recognised."""
    port: int = 8008
    """Port; 0 takes a free one."""
    host: str = "127.0.0.1"
    """Address to bind to; another than this machine's own needs --token."""
    token: str | None = None
    """What viewers must know, 16 signs or more. Who lists this machine's processes sees it here, not in --token-file or
    in the variable VIEWMEND_TOKEN."""
    token_file: Path | None = None
    """A file whose first line is the token."""
    model: str | None = None
    """A shipped model's name or a model's folder; 'telea' and 'nearest' are the classical fills. By default 'views',
    as `viewmend mend` has: of a view whose time does not suffice for all of it, the most useful part is mended."""
    fps: float | None = None
    """Frames a second, instead of the capture's."""
    budget_ms: float = 100.0
    """Milliseconds that a view may take: what it is made with is chosen by that, frame by frame. 0: always all."""
    width: int = 1024
    """The longest side of the cameras' images: larger ones are made smaller when they are read."""
    align: bool = True
    """Take a capture's calibration as it is. By default it is aligned as `viewmend mend` does."""
    match_colours: bool = True
    """Leave the cameras' colours as they are. By default they are matched as `viewmend mend` does."""
    context: int = 3
    """How many cameras colour a view and are the inpainter's context."""
    error_rule: str | None = None
    """What is mended, as `viewmend mend` takes it; by default what the model is made for."""
    wrong_fraction: float = 0.15
    """Error rule 'wrong': at most this part of the subject is mended, beside what no camera colours."""
    viewers: int = 8
    """How many may watch at once; with --ray, at each replica."""
    riftcast_port: int | None = None
    """A port of this machine at which RIFTCast's own clients get their views, too (needs viewmend[riftcast])."""
    broadcast: str | None = None
    """WIDTHxHEIGHT of a film for any number who watch at /watch; on the page a viewer goes on air (needs
    viewmend[video])."""
    ray: str | None = None
    """Address of a Ray cluster whose machines render: HOST:PORT, auto, or local (needs viewmend[ray])."""
    replicas: int = 2
    """With --ray: how many processes render, at least."""
    most_replicas: int | None = None
    """With --ray: how many render when there are many viewers; by default as many as always."""
    cameras: int = 8
    """Cameras of the studio's ring."""
    frames: int = 60
    """Length of the studio's scene."""
    size: int = 320
    """Width and height of the studio's images."""
    seed: int = PROCEDURAL_SEEDS["test"][1]
    """Seed of the studio's scene."""
    device: str = "cpu"
    """Where to compute: cpu, or cuda."""
    memory_mb: float = 3000.0
    """Memory for frames at hand and what was computed of them; with --ray, half of it is what processes share."""


def run(options: Options) -> int:
    """Serve until interrupted."""
    _check(options)
    try:
        import starlette  # noqa: F401
        import uvicorn  # noqa: F401
    except ImportError:
        raise ValueError("viewmend serve needs its extra 'live'; from the clone: pip install -e '.[live]'") from None
    import os

    # Before torch is loaded. Its threads would spin between two pieces of work, on cores that a browser may need.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(2**26))  # what a pushed image may claim to be
    if options.ray is not None:
        from viewmend.cli.serving_many import serve_many

        serve_many(options)
    from viewmend.cli.console import say
    from viewmend.live.listener import Server
    from viewmend.live.memory import loaded, set_up
    from viewmend.live.protocol import token_query
    from viewmend.live.renderer import Renderer
    from viewmend.live.riftcast_service import RiftcastService, listen
    from viewmend.live.server import LiveServer
    from viewmend.live.service import RenderService

    set_up()
    config = server_config(options)
    supply = open_supply(options)
    renderer = Renderer(supply, load_inpainter(options), stream_config(options), options.device)
    service = RenderService(renderer, supply)
    listener = None if options.riftcast_port is None else listen(options.riftcast_port)
    riftcast = None if listener is None else RiftcastService(service, config.limits, listener)
    server = Server(LiveServer(service, config, riftcast), config)
    with server.bound() as address:
        loaded()
        say(f"open {address}/{token_query(config.token)}   (Ctrl-C stops it)")
        if config.broadcast_px is not None:
            say(f"watch {address}/watch{token_query(config.token)}   (what the viewer who goes on air sees)")
        if listener is not None:
            say(f"RIFTCast's clients: 127.0.0.1, port {listener.getsockname()[1]}")
        server.run_bound()
    return 0


def server_config(options: Options) -> "ServerConfig":
    """Where and for whom is served."""
    from viewmend.live.protocol import Limits
    from viewmend.live.server import ServerConfig
    from viewmend.methods import default_method

    return ServerConfig(
        host=options.host,
        port=options.port,
        token=_token(options),
        budget_ms=options.budget_ms or None,
        model=options.model or default_method(),
        limits=Limits(viewers=options.viewers),
        broadcast_px=None if options.broadcast is None else film_size(options.broadcast),
    )


def film_size(text: str) -> tuple[int, int]:
    """Width and height of a film, from `WIDTHxHEIGHT`.

    Raises:
        ValueError: it is none that can be encoded here.
    """
    import re

    from viewmend.live.protocol import Limits
    from viewmend.live.video import video_codecs

    found = re.fullmatch(r"(\d{2,5})x(\d{2,5})", text, re.ASCII)
    size_px = (int(found[1]), int(found[2])) if found else (0, 0)
    if min(size_px) < 16 or any(side % 2 for side in size_px):
        raise ValueError(f"expected --broadcast WIDTHxHEIGHT, even, from 16, e.g. 1280x720; got '{text[:40]}'")
    try:
        Limits().check_size(*size_px)
    except ValueError as error:
        raise ValueError(f"--broadcast: {error}") from None
    if "h264" not in video_codecs():
        raise ValueError("--broadcast needs PyAV with x264; install viewmend's extra 'video'")
    return size_px


def stream_config(options: Options) -> "StreamConfig":
    """How frames become views."""
    from viewmend.rendering.view import RenderConfig
    from viewmend.stream import StreamConfig

    render = RenderConfig(cameras=options.context, error_rule=options.error_rule, wrong_fraction=options.wrong_fraction)
    return StreamConfig(render=render, memory_mb=options.memory_mb / 2)


def load_inpainter(options: Options) -> "ViewInpainter":
    """The model, where it renders."""
    from viewmend.cli.checks import load_named

    return load_named(options.model, options.device)


def _token(options: Options) -> str | None:
    """The token from the option, the file or the environment; None where none is given."""
    import os

    given = options.token or os.environ.get(TOKEN_VARIABLE)
    if options.token_file is not None:
        if options.token is not None:
            raise ValueError("expected --token or --token-file, got both; give one of them")
        with options.token_file.open(encoding="utf-8") as file:
            given = file.readline(4096).strip()
        if not given:
            raise ValueError(f"{options.token_file}: expected the token in its first line, got nothing")
    return given or None


def _check(options: Options) -> None:
    """What can be said before anything heavy is imported."""
    positive = ("width", "context", "viewers", "cameras", "frames", "size", "memory_mb", "replicas")
    wrong = [name for name in positive if not getattr(options, name) > 0]
    wrong += ["budget_ms"] if not options.budget_ms >= 0 else []
    wrong += ["cameras"] if options.source == "studio" and options.cameras < 4 else []
    wrong += ["most_replicas"] if (options.most_replicas or options.replicas) < options.replicas else []
    if options.fps is not None and not 0 < options.fps <= 240:
        wrong.append("fps")
    wrong += [name for name in ("port", "riftcast_port") if not 0 <= (getattr(options, name) or 0) <= 65535]
    if options.riftcast_port is not None and options.ray is not None:
        raise ValueError("expected --riftcast-port or --ray, got both; RIFTCast's clients are served by one process")
    if options.broadcast is not None and options.ray is not None:
        raise ValueError("expected --broadcast or --ray, got both; the film is made by one process")
    if wrong:
        name = wrong[0]
        raise ValueError(f"expected a sensible --{name.replace('_', '-')}, got {getattr(options, name)}; see --help")


def open_supply(options: Options) -> "FrameSupply":
    """Where frames come from; ValueError or OSError for a source that cannot be read."""
    from viewmend.live.frames import ReadAhead
    from viewmend.live.pushed import PushedFrames

    memory_mb = options.memory_mb / 2
    if options.source == "live":
        return PushedFrames(options.fps, memory_mb)
    if options.source.endswith(".toml"):
        from viewmend.live.rig_frames import RigFrames

        return RigFrames(
            Path(options.source), options.fps, memory_mb, options.width, options.align, options.match_colours
        )
    made = options.source == "studio"
    return ReadAhead(_studio(options) if made else _capture(options), options.fps, generated=made, memory_mb=memory_mb)


def _studio(options: Options) -> "Callable[[], CaptureSource]":
    """Opens the studio; called on the thread that makes its frames, so that the page is there at once."""

    def open_studio() -> "CaptureSource":
        from viewmend.capture.prepare import prepare
        from viewmend.studio.stage import Studio, StudioConfig

        config = StudioConfig(
            seed=options.seed, cameras=options.cameras, frames=options.frames, size_px=options.size, fps=15.0
        )
        return prepare(Studio(config), longest_px=options.width, align=False, match_colours=False)

    return open_studio


def _capture(options: Options) -> "Callable[[], CaptureSource]":
    """Prepares the capture, so that one that cannot be rendered is refused before anybody is told an address."""
    from viewmend.capture.prepare import open_masked, prepare
    from viewmend.cli.prepared import say_prepared

    prepared = prepare(
        open_masked(options.source, kind=options.kind),
        longest_px=options.width,
        align=options.align,
        match_colours=options.match_colours,
    )
    say_prepared(prepared)
    return lambda: prepared
