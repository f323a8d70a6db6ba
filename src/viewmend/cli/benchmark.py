"""`viewmend benchmark`: what a view costs on this machine, stage by stage, and how that grows."""

from dataclasses import dataclass
from pathlib import Path

PLOTS = (".svg", ".png", ".pdf")


@dataclass(frozen=True, kw_only=True)
class Options:
    """Measure what views cost here: a procedural scene, seen by a ring of cameras, rendered and mended.

    For each stage of the stream's record of times: milliseconds (median), floating-point operations and bytes that
    torch dispatches, the least time for them at this machine's measured ceilings (a matrix product and a copy), and
    how many times as long it took. Then how the cost of a time and its views grows with pixels, cameras, the part of
    the subject that is mended (models that choose it) and viewers, as fitted exponents. Other work on the machine
    makes figures worse; the report tells its load.
    """

    out: Path | None = None
    """A file for the report, as JSON."""
    versus: Path | None = None
    """An earlier report of the same model and sizes: says how each stage changed, and names those that got slower."""
    plots: Path | None = None
    """A file for a page of plots (.svg, .png, .pdf); needs matplotlib, the extra 'plots'."""
    model: str = "views"
    """A shipped model's name or a model's folder; 'telea' and 'nearest' are the classical fills."""
    size: int = 256
    """Width and height of all images; views are measured at half to 1.41 of it, too."""
    cameras: int = 8
    """Cameras of the ring; half and twice as many are measured, too."""
    repeats: int = 3
    """Each figure is the median of so many times, after one to warm up."""


def run(options: Options) -> int:
    """Run the command; the exit code."""
    for name, least in (("size", 64), ("cameras", 4), ("repeats", 1)):
        if (given := getattr(options, name)) < least:
            raise ValueError(f"expected --{name} of at least {least}, got {given}; see --help")
    if options.plots is not None and options.plots.suffix not in PLOTS:
        raise ValueError(f"expected --plots as a file {', '.join(PLOTS)}, got {options.plots.name}; name it so")
    import torch

    from viewmend.cli.checks import load_named
    from viewmend.cli.console import busy, say, show
    from viewmend.evaluation.cost import CostBench, CostScene, ceilings
    from viewmend.evaluation.cost_report import CostReport, read_report, versus, write_plots
    from viewmend.evaluation.provenance import provenance
    from viewmend.evaluation.report_plot import require_matplotlib

    before = None if options.versus is None else read_report(options.versus)
    if options.plots is not None:
        require_matplotlib()
    rigs = (max(3, options.cameras // 2), options.cameras, 2 * options.cameras)
    config = CostScene(size_px=options.size, cameras=options.cameras, repeats=options.repeats, rigs=rigs)
    machine = provenance("cpu", torch.get_num_threads(), 1)
    with busy("measuring"):
        bench, top = CostBench(load_named(options.model, "cpu"), config), ceilings()
        report = CostReport(
            model=options.model,
            size_px=options.size,
            cameras=options.cameras,
            machine=machine,
            ceilings=top,
            stages=bench.stages(top),
            growth=bench.growth(),
        )
    show(*report.lines())
    if before is not None:
        show(*versus(report, before))
    if options.out is not None:
        report.write(options.out)
        say(f"wrote {options.out}")
    if options.plots is not None:
        write_plots(report, options.plots)
        say(f"wrote {options.plots}")
    return 0
