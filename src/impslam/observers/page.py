"""Parts of a self-contained page: tables, tiles and charts as HTML with inline SVG.

The lines of a chart are an SVG that stretches with the page, and its labels are HTML text beside it, so
that both are readable on any screen.
"""

from __future__ import annotations

import html
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files

import numpy as np

from impslam.types import Array

BUCKETS = 400
"""Longer lines are drawn with the minimum and maximum of so many segments."""
MIN_RETURN = 10.0
"""Thousandths of the time axis by which time runs back between two logs; jitter of stamps is far less."""


@dataclass(frozen=True, slots=True, eq=False)
class ChartLine:
    """A line of a chart: values (n,), and the CSS class of its style, e.g. "a", "b" or "c"."""

    label: str
    values: Array
    style: str = "a"


def escape(text: object) -> str:
    """Return text escaped for HTML."""
    return html.escape(str(text))


def page(title: str, sections: Iterable[str], script: str = "") -> Iterator[str]:
    """Yield the whole page in parts; the script is at its end."""
    style = packaged("report.css")
    yield (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>\n{style}</style>\n</head>\n"
        "<body>\n<main>\n"
    )
    for part in filter(None, sections):
        yield part
        yield "\n"
    yield "</main>\n" + (f"<script>\n{script}</script>\n" if script else "")
    yield "</body>\n</html>\n"


def packaged(name: str) -> str:
    """Return the text of a file of this package."""
    return (files("impslam.observers") / name).read_text(encoding="utf-8")


def section(title: str, *parts: str, note: str = "") -> str:
    """Return a titled section with an optional explaining note."""
    text = f'<p class="note">{escape(note)}</p>' if note else ""
    return f"<section>\n<h2>{escape(title)}</h2>\n{text}\n" + "\n".join(parts) + "\n</section>"


def tiles(facts: Mapping[str, tuple[str, str]]) -> str:
    """Return headline figures: name -> (figure, small print)."""
    items = (
        f'<div class="tile"><div class="name">{escape(name)}</div>'
        f'<div class="figure">{escape(figure)}</div><div class="more">{escape(more)}</div></div>'
        for name, (figure, more) in facts.items()
    )
    return '<div class="tiles">' + "".join(items) + "</div>"


def table(header: Sequence[str], rows: Iterable[Sequence[object]], text: int = 1) -> str:
    """Return a table; the first `text` columns are left-aligned, the others are numbers."""

    def line(cells: Sequence[object], tag: str) -> str:
        styles = ("" if i < text else ' class="number"' for i in range(len(cells)))
        parts = (
            f"<{tag}{style}>{escape(cell)}</{tag}>"
            for style, cell in zip(styles, cells, strict=True)
        )
        return "<tr>" + "".join(parts) + "</tr>"

    body = "\n".join(line(row, "td") for row in rows)
    head = line(header, "th")
    return f'<div class="scroll"><table><thead>{head}</thead><tbody>{body}</tbody></table></div>'


def folded(title: str, content: str) -> str:
    """Return content that is folded until clicked."""
    return f"<details><summary>{escape(title)}</summary>{content}</details>"


def chart(title: str, time: Array, lines: Sequence[ChartLine], band: Array | None = None) -> str:
    """Return a chart over time (n,) s; the area within +-`band` (n,) is shaded."""
    first, last = float(time.min()), float(time.max())  # stamps may run back
    t = time - first
    values = [line.values for line in lines]
    shades = [] if band is None else [band, -band]
    low, high, ticks = _axis(values, shades)
    span = max(last - first, 1e-9)
    x = 1000.0 * t / span

    def y(v: Array) -> Array:
        return 100.0 * (high - np.clip(v, low, high)) / (high - low)

    marks = "".join(f'<path class="rule" d="M0 {_y:.2f}H1000"/>' for _y in y(np.array(ticks)))
    shade = "" if band is None else _area(x, y(band), y(-band))
    drawn = "".join(f'<path class="line {s.style}" d="{_path(x, y(s.values))}"/>' for s in lines)
    ys = _labels("y", ticks, [(high - v) / (high - low) for v in ticks])
    seconds = [v for v in round_numbers(0.0, span, 5) if v <= span]
    xs = _labels("x", seconds, [v / span for v in seconds])
    keys = "".join(
        f'<span class="key {s.style}">{escape(s.label)}</span>' for s in lines if s.label
    )
    return (
        f'<figure class="chart"><figcaption>{escape(title)} {keys}</figcaption>'
        f'<div class="plot"{times(first, last)}>'
        '<svg viewBox="0 0 1000 100" preserveAspectRatio="none" role="img" '
        f'aria-label="{escape(title)}">{marks}{shade}{drawn}</svg>{ys}{xs}</div></figure>'
    )


def times(begin: float, end: float) -> str:
    """Return the HTML attributes with the first and last stamp of a plot, s, for the script."""
    return f' data-begin="{begin:.6f}" data-end="{end:.6f}"'


def _axis(values: list[Array], shades: list[Array]) -> tuple[float, float, list[float]]:
    """Return the minimum and maximum to show, which include 0, and the ticks.

    A band that is far wider than the lines is cut off to keep the lines visible.
    """
    joined = np.concatenate(values)
    joined = joined[np.isfinite(joined)]
    low, high = (joined.min(), joined.max()) if len(joined) else (0.0, 1.0)
    low, high = min(low, 0.0), max(high, 0.0)
    if shades:
        extent = max(-low, high, 1e-12)
        width = min(float(np.nanmax(shades[0])), 4.0 * extent)
        low, high = min(low, -width), max(high, width)
    if high - low < 1e-9:
        high = low + 1.0
    ticks = round_numbers(float(low), float(high), 4)
    return ticks[0], ticks[-1], ticks


def round_numbers(low: float, high: float, count: float) -> list[float]:
    """Return about `count` equally spaced round numbers that enclose an interval."""
    raw = (high - low) / count
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(power * f for f in (1.0, 2.0, 2.5, 5.0, 10.0) if power * f >= raw * 0.999)
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [round(i * step, 12) for i in range(first, last + 1)]


def _labels(axis: str, ticks: Sequence[float], places: Sequence[float]) -> str:
    side = "left" if axis == "x" else "top"
    unit = " s" if axis == "x" else ""
    return "".join(
        f'<span class="tick {axis}" style="{side}:{100.0 * place:.2f}%">{tick:g}'
        f"{unit if i == len(ticks) - 1 else ''}</span>"
        for i, (tick, place) in enumerate(zip(ticks, places, strict=True))
    )


def _path(x: Array, y: Array) -> str:
    """Return an SVG path through the finite points; a long one is reduced to its local extremes."""
    points = np.column_stack((x, y))[np.isfinite(y)]
    return "".join("M" + _joined(_reduced(line)) for line in _logs(points))


def _logs(points: Array) -> list[Array]:
    """Split points (n, c), whose first column is the time, where the next log of a map begins."""
    begins = np.flatnonzero(np.diff(points[:, 0]) < -MIN_RETURN) + 1
    return np.split(points, begins) if len(points) else []


def _reduced(line: Array) -> Array:
    """Return the local extremes of a long line, or a short one as it is."""
    if len(line) <= 2 * BUCKETS:
        return line
    segments = np.array_split(line, BUCKETS)
    return np.vstack([s[np.sort([s[:, 1].argmin(), s[:, 1].argmax()])] for s in segments])


def _joined(points: Array) -> str:
    return "L".join(f"{a:.1f} {b:.2f}" for a, b in points)


def _area(x: Array, top: Array, bottom: Array) -> str:
    """Return the SVG area between two lines."""
    text = ""
    for log in _logs(np.column_stack((x, top, bottom))):
        some = log[:: max(1, len(log) // BUCKETS)]
        text += f"M{_joined(some[:, [0, 1]])}L{_joined(some[::-1, [0, 2]])}Z"
    return f'<path class="band" d="{text}"/>'
