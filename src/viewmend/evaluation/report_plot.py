"""Plots of quality against milliseconds and of what an ablation's variants lose, as SVG, by matplotlib."""

import io
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

NO_MATPLOTLIB = "plots need matplotlib: pip install 'viewmend[plots]'"
LEAST_MS = 0.1
"""What is faster is drawn here: a logarithm has no 0."""
LINE_PX = 13.0
"""Labels are at least so far apart."""
LABEL_PX = 150.0
"""Labels are at most about so wide."""
INK = "#1a1a1a"
"""The colour of axes and text."""
STYLE: Any = {
    "svg.hashsalt": "viewmend",
    "svg.fonttype": "none",
    "font.size": 12,
    **dict.fromkeys(("text.color", "axes.edgecolor", "axes.labelcolor", "xtick.color", "ytick.color"), INK),
    "axes.spines.top": False,
    "axes.spines.right": False,
}
"""Settings with which the same figures give the same bytes, and text stays text."""


class MissingMatplotlibError(ValueError):
    """Plots were asked for where matplotlib is not installed."""

    def __init__(self) -> None:
        super().__init__(NO_MATPLOTLIB)


@dataclass(frozen=True)
class Point:
    """One method."""

    name: str
    ms: float
    quality: float


def require_matplotlib() -> None:
    """Do nothing where matplotlib is installed.

    Raises:
        MissingMatplotlibError: matplotlib is not installed.
    """
    try:
        import matplotlib  # noqa: F401
    except ImportError as error:
        raise MissingMatplotlibError from error


def trade_off(points: Sequence[Point], quality: str, title: str) -> str:
    """An `<svg>` of quality over the median milliseconds of a step (logarithmic), all methods; "" without any.

    Text and axes take the page's colour (`currentColor`), so that they can be read on light and dark.

    Raises:
        MissingMatplotlibError: matplotlib is not installed.
    """
    if not points:
        return ""
    require_matplotlib()
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(STYLE):
        figure = Figure((10, 5.56), dpi=72)
        axes = figure.add_axes((0.09, 0.12, 0.7, 0.83))
        axes.set(xscale="log", xlabel="milliseconds of a step, median", ylabel=quality)
        axes.xaxis.set_major_formatter("{x:g}")
        axes.grid(alpha=0.3, clip_on=False)
        for n, point in enumerate(points):
            axes.plot(max(point.ms, LEAST_MS), point.quality, "o", color="#0b62c4", clip_on=False, gid=f"dot{n}")
        axes.margins(0.05, 0.1)
        axes.autoscale_view()
        _label(axes, points)
        svg = _svg(figure, transparent=True).replace(INK, "currentColor")
    for n, point in enumerate(points):
        said = f"{point.name}: {point.quality:.2f}, {point.ms:.1f} ms"
        svg = svg.replace(f'<g id="dot{n}">', f'<g class="dot"><title>{escape(said)}</title>')
    return svg.replace("<svg ", f'<svg class="plot" role="img" aria-label="{escape(title)}" ', 1)


def ablation_plot(
    losses: Sequence[tuple[str, Sequence[float]]], top_k: Sequence[tuple[str, float, float]], title: str
) -> str:
    """An `<svg>` of two plots: the losses in dB of each variant's seeds, and quality over milliseconds by top-k.

    Args:
        losses: each variant's name, and what each seed loses.
        top_k: the number of tokens as text, milliseconds and dB.
        title: of the losses' plot.

    Raises:
        MissingMatplotlibError: matplotlib is not installed.
    """
    require_matplotlib()
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(STYLE):
        figure = Figure((12, 2 + 0.35 * len(losses)), dpi=72, layout="constrained")
        left, right = figure.subplots(1, 2)
        left.set(title=title, xlabel="dB", yticks=range(len(losses)), yticklabels=[name for name, _ in losses])
        left.invert_yaxis()
        left.axvline(0, color="#888888", linewidth=1)
        for n, (_, values) in enumerate(losses):
            left.plot(values, [n] * len(values), "o", color="#d33333", gid=f"variant{n}")
        right.set(title="full by top-k", xlabel="milliseconds of a step, median", ylabel="PSNR in the holes, dB")
        right.plot([ms for _, ms, _ in top_k], [db for _, _, db in top_k], "o-", color="#3366cc", gid="top-k")
        for name, ms, db in top_k:
            right.annotate(name, (ms, db), (6, 6), textcoords="offset points")
        return _svg(figure)


def _svg(figure: "Figure", transparent: bool = False) -> str:
    """The figure's `<svg>` alone, without date, metadata and prologue."""
    file = io.StringIO()
    figure.savefig(
        file, format="svg", transparent=transparent, metadata=dict.fromkeys(("Date", "Creator", "Format", "Type"))
    )
    svg = file.getvalue()
    return re.sub(r"font-family: [^;]*", "font-family: inherit", svg[svg.index("<svg ") :])


def _label(axes: "Axes", points: Sequence[Point]) -> None:
    """Names beside the points, moved towards the middle where one that is near would be written over."""
    places = [tuple(axes.transData.transform((max(p.ms, LEAST_MS), p.quality))) for p in points]
    middle = float(axes.transAxes.transform((0, 0.5))[1])
    written: list[tuple[float, float]] = []
    for n in sorted(range(len(places)), key=lambda i: -abs(places[i][1] - middle)):
        across, at = places[n]
        away = math.copysign(LINE_PX, middle - at)
        while any(abs(x - across) < LABEL_PX and abs(y - at) < LINE_PX for x, y in written):
            at += away
        written.append((across, at))
        axes.annotate(
            points[n].name, places[n], (across + 8, at - 4), xycoords="figure pixels", textcoords="figure pixels"
        )
