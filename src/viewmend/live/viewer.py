"""The live server from Python: a script or a notebook starts it, and controls what its pages show."""

import threading
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from viewmend.completed_cameras import MAX_COMPLETED
from viewmend.data.prepare import open_masked, prepare
from viewmend.data.source import CaptureSource
from viewmend.geometry.cameras import Cameras
from viewmend.live.frame_source import RecordedSource
from viewmend.live.poses import cameras_json
from viewmend.live.protocol import ShowView, read_message, token_query
from viewmend.live.renderer import Renderer
from viewmend.models.base import Inpainter
from viewmend.models.registry import default_method, error_model_for, make_method
from viewmend.stream import StreamConfig

STOP_S = 10.0
"""`close` waits at most this many seconds for the server's thread."""


class Viewer:
    """A running server. `close` it, or use it as a context manager.

    Examples:
        >>> from viewmend import make_method, serve
        >>> from viewmend.studio.stage import Studio, StudioConfig
        >>> with serve(Studio(StudioConfig(cameras=4, frames=1, size_px=64)), make_method("telea")) as viewer:
        ...     type(viewer).__name__
        'Viewer'
    """

    def __init__(self, renderer: Renderer, source: RecordedSource, **address: Any) -> None:
        """Start a server on a thread, as `serve` does; `address` are fields of `ServerConfig`.

        Raises:
            ValueError: the port or budget_ms is out of range.
            OSError: the port is in use.
        """
        from viewmend.live.listener import Server
        from viewmend.live.server import LiveServer, ServerConfig
        from viewmend.live.service import RenderService

        config = ServerConfig(**address)
        port = ExitStack()
        self._live = LiveServer(RenderService(renderer, source), config)
        self._server = Server(self._live, config)
        self.address = f"{port.enter_context(self._server.bind())}/{token_query(config.token)}"
        """What a browser opens, with the token if there is one."""

        def run() -> None:
            with port:
                self._server.run()

        self._thread = threading.Thread(target=run, name="server", daemon=True)
        self._thread.start()

    def show(
        self,
        *,
        azimuth: float | None = None,
        elevation: float | None = None,
        distance: float | None = None,
        target: tuple[float, float, float] | None = None,
        camera: Cameras | None = None,
        time: int | None = None,
        mode: str | None = None,
    ) -> None:
        """Move all open pages; what is not given stays as it is. Pages opened later get the last call only.

        Args:
            azimuth: degrees around the subject (docs/live-protocol.md).
            elevation: degrees above the horizon.
            distance: metres from the target.
            target: the point to turn around, metres.
            camera: a pose in place of these four; of several cameras, the first.
            time: index of a frame, at which the page pauses.
            mode: what is shown: "completed", "rendered", "holes", "depth", "coverage",
                "confidence", "hull" or "points".

        Raises:
            ValueError: a value is out of range, the mode is unknown, or a camera is given with one
                of these four.
        """
        angles = {"azimuth": azimuth, "elevation": elevation, "distance": distance, "target": target}
        given = {name: value for name, value in angles.items() if value is not None}
        if camera is not None and given:
            raise ValueError(f"expected a camera or {', '.join(given)}, got both; give one of them")
        if camera is not None:
            given = {name: cameras_json(camera)[0][name] for name in ("R", "T")}
        values = {"pose": given or None, "time": time, "mode": mode}
        shown = {key: value for key, value in values.items() if value is not None}
        read_message(shown, ShowView)
        self._live.registry.shown = {"type": "show"} | shown

    def wait(self) -> None:
        """Return once the server has stopped: by `close`, on another thread."""
        while self._thread.is_alive():
            self._thread.join(0.5)

    def close(self) -> None:
        """Stop the server."""
        self._server.stop()
        self._thread.join(STOP_S)

    def __enter__(self) -> "Viewer":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"Viewer({self.address!r})"


def serve(
    capture: CaptureSource | Path | str,
    model: Inpainter | str | None = None,
    *,
    host: str = "127.0.0.1",
    port: int = 0,
    token: str | None = None,
    budget_ms: float | None = 100.0,
    config: StreamConfig | None = None,
    device: str = "cpu",
) -> Viewer:
    """Show a capture in the browser, as `viewmend serve` does, from a script or a notebook.

    Args:
        capture: a path, which is opened and prepared at full image size; or a source, used as it is.
        model: a method's name or an inpainter; by default the shipped model.
        host: address to bind to; one that other machines can reach needs a token.
        port: 0 takes a free one.
        token: at least 16 characters, if there is one.
        budget_ms: time that a view may take; None: no limit. Moving views are simplified either way.
        config: parameters of geometry, rendering and memory.
        device: cpu or cuda.

    Raises:
        ValueError: the capture, the model or the token cannot be used, or port or budget_ms is out of range.
        OSError: the port is in use.

    Examples:
        >>> from viewmend import make_method, serve
        >>> from viewmend.studio.stage import Studio, StudioConfig
        >>> studio = Studio(StudioConfig(cameras=4, frames=1, size_px=64))
        >>> with serve(studio, make_method("telea")) as viewer:
        ...     viewer.show(azimuth=30.0, mode="rendered")
        ...     viewer.address.startswith("http://127.0.0.1:")
        True
    """
    opened = prepare(open_masked(capture)) if isinstance(capture, Path | str) else capture
    name = model if isinstance(model, str) else default_method() if model is None else type(model).__name__
    inpainter = model if isinstance(model, Inpainter) else make_method(name, device)
    source = RecordedSource(lambda: opened)
    error_model = error_model_for(inpainter, device)
    renderer = Renderer(source, inpainter, config, device, error_model, completed_cameras=MAX_COMPLETED)
    return Viewer(renderer, source, host=host, port=port, token=token, budget_ms=budget_ms, model=name)
