"""`viewmend export`: writes a model as a file for C++ programs and other runtimes, without Python or viewmend."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro


@dataclass(frozen=True, kw_only=True)
class Options:
    """Export a model as an AOTInductor package (libtorch, C++) or as ONNX.

    The file completes one view of one frame: its inputs are the rendered view, its camera, and the
    rig's images, masks and calibration, of 64 to 4096 pixels a side; its outputs are colours,
    alpha, confidence and depth (docs/guide/export.md). A package is compiled for the processor of
    this machine; ONNX runs anywhere.
    """

    model: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="MODEL")] = "views"
    """'views', or the folder of a model trained from it."""
    format: Literal["pt2", "onnx"]
    """pt2 for libtorch and PyTorch, onnx for ONNX Runtime and others."""
    out: Path
    """File to write; its suffix must match the format."""


def run(options: Options) -> int:
    """Run the command; the exit code."""
    if options.out.suffix != f".{options.format}":
        raise ValueError(f"expected --out to end in .{options.format}, got '{options.out}'; rename it")
    if not options.out.parent.is_dir():
        raise ValueError(f"{options.out.parent}: expected a folder to write to, found none; create it first")
    from viewmend.cli.console import busy, say
    from viewmend.export.model import check_format, load_exportable, metadata, trace, write_program
    from viewmend.utils.atomic_writes import remove_partial_file

    check_format(options.format)
    net = load_exportable(options.model)
    remove_partial_file(options.out)
    with busy("tracing the model"):
        program = trace(net)
    with busy("compiling it" if options.format == "pt2" else "writing it"):
        write_program(program, options.out, options.format, metadata(net, options.model))
    say(f"wrote {options.out}: {options.out.stat().st_size / 1e6:.1f} MB")
    return 0
