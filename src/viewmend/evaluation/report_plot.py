"""The trade-off of a table as a picture: quality against milliseconds, as SVG that needs nothing else."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

WIDTH, HEIGHT = 720.0, 400.0
LEFT, RIGHT, TOP, BOTTOM = 62.0, 150.0, 18.0, 48.0
"""Around the axes; labels of the points reach to the right."""
LEAST_MS = 0.1
"""What is faster is drawn here: a logarithm has no 0."""
LINE_PX = 13.0
"""Labels are at least so far apart."""


@dataclass(frozen=True)
class Point:
    """One method."""

    name: str
    ms: float
    quality: float


def trade_off(points: Sequence[Point], quality: str, title: str) -> str:
    """Quality over the median milliseconds of a step (logarithmic), all methods; "" without any.

    Colours are the page's (`currentColor`), so that it can be read on light and dark.
    """
    if not points:
        return ""
    low, high = _decades([max(p.ms, LEAST_MS) for p in points])
    ticks = _ticks([p.quality for p in points])
    x0, x1, y0, y1 = LEFT, WIDTH - RIGHT, HEIGHT - BOTTOM, TOP

    def x(ms: float) -> float:
        return x0 + (x1 - x0) * (math.log10(max(ms, LEAST_MS)) - low) / (high - low)

    def y(value: float) -> float:
        return y0 + (y1 - y0) * (value - ticks[0]) / (ticks[-1] - ticks[0])

    parts = [
        f'<svg class="plot" viewBox="0 0 {WIDTH:g} {HEIGHT:g}" role="img" aria-label="{escape(title)}" '
        'font-family="inherit" font-size="12" fill="currentColor" xmlns="http://www.w3.org/2000/svg">',
        f"<title>{escape(title)}</title>",
    ]
    for power in range(low, high + 1):
        at = x(10.0**power)
        parts.append(_line(at, y0, at, y1, 0.15) + _text(at, y0 + 18, f"{10.0**power:g}", "middle"))
    parts += [_line(x0, y(tick), x1, y(tick), 0.15) + _text(x0 - 8, y(tick) + 4, f"{tick:g}", "end") for tick in ticks]
    parts += [_line(x0, y0, x1, y0, 0.8), _line(x0, y0, x0, y1, 0.8)]
    parts.append(_text((x0 + x1) / 2, HEIGHT - 8, "milliseconds of a step, median", "middle"))
    parts.append(f'<g transform="rotate(-90 14 {(y0 + y1) / 2})">{_text(14.0, (y0 + y1) / 2, quality, "middle")}</g>')
    labels = _apart([(x(p.ms), y(p.quality)) for p in points])
    for point, label in zip(points, labels, strict=True):
        px, py = x(point.ms), y(point.quality)
        said = f"{point.name}: {point.quality:.2f}, {point.ms:.1f} ms"
        parts.append(f'<circle cx="{px:.1f}" cy="{py:.1f}" r="4.5" class="dot"><title>{escape(said)}</title></circle>')
        parts.append(_text(px + 8, label + 4, point.name, "start"))
    return "".join([*parts, "</svg>"])


def _decades(values: Sequence[float]) -> tuple[int, int]:
    low, high = math.floor(math.log10(min(values))), math.ceil(math.log10(max(values)))
    return low, max(high, low + 1)


def _ticks(values: Sequence[float]) -> list[float]:
    """Round numbers from below the least to above the largest."""
    span = max(max(values) - min(values), 0.1)
    size = 10.0 ** math.floor(math.log10(span / 4))
    step = next(s * size for s in (1, 2, 5, 10) if span / (s * size) <= 6)
    first, last = math.floor(min(values) / step), math.ceil(max(values) / step)
    return [round(n * step, 9) for n in range(first, max(last, first + 1) + 1)]


def _apart(places: Sequence[tuple[float, float]]) -> list[float]:
    """Heights of labels, moved towards the middle where one that is near would be written over."""
    heights = [0.0] * len(places)
    written: list[tuple[float, float]] = []
    middle = HEIGHT / 2
    for n in sorted(range(len(places)), key=lambda i: -abs(places[i][1] - middle)):
        across, at = places[n]
        away = math.copysign(LINE_PX, middle - at)
        while any(abs(x - across) < RIGHT and abs(y - at) < LINE_PX for x, y in written):
            at += away
        written.append((across, at))
        heights[n] = at
    return heights


def _line(x0: float, y0: float, x1: float, y1: float, opacity: float) -> str:
    at = f'x1="{x0:.1f}" y1="{y0:.1f}" x2="{x1:.1f}" y2="{y1:.1f}"'
    return f'<line {at} stroke="currentColor" stroke-opacity="{opacity}"/>'


def _text(x: float, y: float, said: str, anchor: str) -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(said)}</text>'
