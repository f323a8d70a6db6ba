"""`viewmend benchmark`: the time of a view on this machine, stage by stage."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, kw_only=True)
class Options:
    """Measure the cost of views on this machine, with a procedural scene and a ring of cameras.

    Prints median and 95th percentile milliseconds of each stage. Other work on the machine slows it down: the report
    includes the load.
    """

    out: Path | None = None
    """File for the report, as JSON."""
    versus: Path | None = None
    """Earlier report of the same model and sizes, to compare with; names the stages that got slower."""
    model: str = "views"
    """Name of a shipped model, or a model's folder; 'telea' and 'nearest' are classical fills."""
    size: int = 256
    """Width and height of all images."""
    cameras: int = 8
    """Cameras of the ring."""
    repeats: int = 3
    """Repetitions of each measurement, after one for warm-up."""


def run(options: Options) -> int:
    """Run the command; the exit code."""
    for name, least in (("size", 64), ("cameras", 4), ("repeats", 1)):
        if (given := getattr(options, name)) < least:
            raise ValueError(f"expected --{name} of at least {least}, got {given}; see --help")
    import torch

    from viewmend.cli.checks import load_named
    from viewmend.cli.console import busy, say, show
    from viewmend.evaluation.cost import CostReport, compare, measure_stages, read_report
    from viewmend.evaluation.provenance import provenance

    before = None if options.versus is None else read_report(options.versus)
    machine = provenance("cpu", torch.get_num_threads(), 1)
    with busy("measuring"):
        inpainter = load_named(options.model, "cpu")
        report = CostReport(
            model=options.model,
            size_px=options.size,
            cameras=options.cameras,
            machine=machine,
            stages=measure_stages(inpainter, options.size, options.cameras, options.repeats),
        )
    show(*report.lines())
    if before is not None:
        show(*compare(report, before))
    if options.out is not None:
        report.write(options.out)
        say(f"wrote {options.out}")
    return 0
