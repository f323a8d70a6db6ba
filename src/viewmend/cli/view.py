"""`viewmend view`: a capture in the browser, opened at once."""

import webbrowser
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True, kw_only=True)
class Options:
    """Open a capture in the browser. `viewmend serve` has more options, and serves other machines and live rigs."""

    capture: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="CAPTURE")]
    """A capture with masks, in any supported format."""
    model: str | None = None
    """A shipped model's name, a model's folder, or any method of `viewmend evaluate`. By default 'views'."""
    max_image_size: int = 1024
    """Longest side of the cameras' images, in pixels; larger images are reduced when they are read."""
    device: str = "cpu"
    """Device to compute on: cpu or cuda."""


def run(options: Options) -> int:
    """Serve on a free port until interrupted."""
    from viewmend.cli.checks import check_least, load_named, log_preparation
    from viewmend.cli.console import say
    from viewmend.data.prepare import open_masked, prepare
    from viewmend.live.viewer import serve

    check_least(options, max_image_size=1)
    capture = prepare(open_masked(options.capture), max_image_size=options.max_image_size)
    log_preparation(capture)
    with serve(capture, load_named(options.model, options.device), device=options.device) as viewer:
        opened = webbrowser.open(viewer.address)
        say(f"{'opened' if opened else 'open'} {viewer.address}   (Ctrl-C stops it)")
        viewer.wait()
    return 0
