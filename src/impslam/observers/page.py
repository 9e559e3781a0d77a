"""Pieces of a page that needs nothing else: tables, tiles and charts as HTML with inline SVG.

A chart's lines are drawn in a picture that stretches with the page, its labels are text beside it:
both stay readable from a phone to a wall.
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
"""Longer lines are drawn by the least and the greatest value of so many stretches."""


@dataclass(frozen=True, slots=True, eq=False)
class Line:
    """One line of a chart: values (n,), and its look: one of "a", "b", "c"."""

    label: str
    values: Array
    look: str = "a"


def escape(text: object) -> str:
    """Return text that is safe in HTML."""
    return html.escape(str(text))


def page(title: str, sections: Iterable[str], script: str = "") -> Iterator[str]:
    """Yield the whole page piece by piece; the script runs at its end."""
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
    """Return a titled section; `note` explains it in a sentence."""
    said = f'<p class="note">{escape(note)}</p>' if note else ""
    return f"<section>\n<h2>{escape(title)}</h2>\n{said}\n" + "\n".join(parts) + "\n</section>"


def tiles(facts: Mapping[str, tuple[str, str]]) -> str:
    """Return headline figures: name -> (figure, what to add in small)."""
    items = (
        f'<div class="tile"><div class="name">{escape(name)}</div>'
        f'<div class="figure">{escape(figure)}</div><div class="more">{escape(more)}</div></div>'
        for name, (figure, more) in facts.items()
    )
    return '<div class="tiles">' + "".join(items) + "</div>"


def table(header: Sequence[str], rows: Iterable[Sequence[object]], text: int = 1) -> str:
    """Return a table; the first `text` columns are flush left, the others are numbers."""

    def line(cells: Sequence[object], tag: str) -> str:
        looks = ("" if i < text else ' class="number"' for i in range(len(cells)))
        parts = (
            f"<{tag}{look}>{escape(cell)}</{tag}>" for look, cell in zip(looks, cells, strict=True)
        )
        return "<tr>" + "".join(parts) + "</tr>"

    body = "\n".join(line(row, "td") for row in rows)
    head = line(header, "th")
    return f'<div class="scroll"><table><thead>{head}</thead><tbody>{body}</tbody></table></div>'


def folded(title: str, content: str) -> str:
    """Return content that opens at a click."""
    return f"<details><summary>{escape(title)}</summary>{content}</details>"


def chart(
    title: str, time: Array, lines: Sequence[Line], band: Array | None = None, zero: bool = True
) -> str:
    """Return a chart over time (n,) s; `band` (n,) is shaded about zero, to both sides."""
    t = time - time[0]
    values = [line.values for line in lines]
    shades = [] if band is None else [band, -band]
    low, high, ticks = _axis(values, shades, zero)
    span = max(float(t[-1]), 1e-9)
    x = 1000.0 * t / span

    def y(v: Array) -> Array:
        return 100.0 * (high - np.clip(v, low, high)) / (high - low)

    marks = "".join(f'<path class="rule" d="M0 {_y:.2f}H1000"/>' for _y in y(np.array(ticks)))
    shade = "" if band is None else _area(x, y(band), y(-band))
    drawn = "".join(f'<path class="line {s.look}" d="{_path(x, y(s.values))}"/>' for s in lines)
    ys = _labels("y", ticks, [(high - v) / (high - low) for v in ticks])
    seconds = [v for v in round_numbers(0.0, span, 5) if v <= span]
    xs = _labels("x", seconds, [v / span for v in seconds])
    keys = "".join(f'<span class="key {s.look}">{escape(s.label)}</span>' for s in lines if s.label)
    return (
        f'<figure class="chart"><figcaption>{escape(title)} {keys}</figcaption>'
        f'<div class="plot"{times(time[0], time[-1])}>'
        '<svg viewBox="0 0 1000 100" preserveAspectRatio="none" role="img" '
        f'aria-label="{escape(title)}">{marks}{shade}{drawn}</svg>{ys}{xs}</div></figure>'
    )


def times(begin: float, end: float) -> str:
    """Return the attributes that tell a script between which stamps, s, a plot extends."""
    return f' data-begin="{begin:.6f}" data-end="{end:.6f}"'


def _axis(values: list[Array], shades: list[Array], zero: bool) -> tuple[float, float, list[float]]:
    """Return the least and greatest value to show and the ticks between.

    A band that is far wider than the lines is cut, or nothing of the lines could be seen.
    """
    joined = np.concatenate(values)
    joined = joined[np.isfinite(joined)]
    low, high = (joined.min(), joined.max()) if len(joined) else (0.0, 1.0)
    if zero:
        low, high = min(low, 0.0), max(high, 0.0)
    if shades:
        reach = max(-low, high, 1e-12)
        widest = min(float(np.nanmax(shades[0])), 4.0 * reach)
        low, high = min(low, -widest), max(high, widest)
    if high - low < 1e-9:
        high = low + 1.0
    ticks = round_numbers(float(low), float(high), 4)
    return ticks[0], ticks[-1], ticks


def round_numbers(low: float, high: float, about: float) -> list[float]:
    """Return round numbers that enclose an interval, about so many."""
    raw = (high - low) / about
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
    """Return an SVG path through the finite points, long ones by their extremes."""
    points = np.column_stack((x, y))[np.isfinite(y)]
    if len(points) > 2 * BUCKETS:
        stretches = np.array_split(points, BUCKETS)
        picked = [s[np.sort([s[:, 1].argmin(), s[:, 1].argmax()])] for s in stretches]
        points = np.vstack(picked)
    return "M" + "L".join(f"{a:.1f} {b:.2f}" for a, b in points) if len(points) else ""


def _area(x: Array, top: Array, bottom: Array) -> str:
    step = max(1, len(x) // BUCKETS)
    there, back = slice(None, None, step), slice(None, None, -step)
    points = zip((*x[there], *x[back]), (*top[there], *bottom[back]), strict=True)
    return '<path class="band" d="M' + "L".join(f"{a:.1f} {b:.2f}" for a, b in points) + 'Z"/>'
