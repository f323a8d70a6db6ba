"""`viewmend export`: a model as a file that C++ programs and other runtimes load, without Python or viewmend."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro


@dataclass(frozen=True, kw_only=True)
class Options:
    """Write a reader of whole views as an AOTInductor package (libtorch, C++) or as ONNX.

    Either mends one view at one time: it takes the rendered view, its camera, and the rig's images, masks and
    calibration, of any sizes, and gives colours, alpha, confidence and depth (docs/guide/export.md). A package is
    compiled for the processor that it is made on; ONNX is for any.
    """

    model: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="MODEL")] = "views"
    """A shipped model's name or a model's folder; one that reads whole views."""
    format: Literal["pt2", "onnx"]
    """What is written: pt2 for libtorch and Python's torch, onnx for ONNX Runtime and others."""
    out: Path
    """The file, which ends like the format."""


def run(options: Options) -> int:
    """Run the command; the exit code."""
    if options.out.suffix != f".{options.format}":
        raise ValueError(f"expected --out to end in .{options.format}, got '{options.out}'; rename it")
    if not options.out.parent.is_dir():
        raise ValueError(f"{options.out.parent}: expected a folder to write to, found none; make it first")
    from viewmend.atomic_writes import remove_half_of
    from viewmend.cli.console import busy, say
    from viewmend.deployment.model_files import FORMATS, exportable, metadata, traced
    from viewmend.inpainting.checkpoint import load_network

    demand, write = FORMATS[options.format]
    demand()
    net = exportable(load_network(options.model), options.model)
    remove_half_of(options.out)
    with busy("tracing the model"):
        program = traced(net)
    with busy("compiling it" if options.format == "pt2" else "writing it"):
        write(program, options.out, metadata(net, options.model))
    say(f"wrote {options.out}: {options.out.stat().st_size / 1e6:.1f} MB")
    return 0
