"""The report's section on health: whether the pose can be trusted over time, and why not."""

from __future__ import annotations

from impslam.health import STATES, Health, Span
from impslam.observers.page import escape, round_numbers, section, table, times
from impslam.types import Array

MAX_ROWS = 30
"""Number of spans in the table: all LOST ones first, then the longest."""
MIN_WIDTH = 2.0
"""Minimum width of a drawn span, of 1000: about two pixels, so that a single scan is visible."""
NOTE = (
    "TRACKING: the true pose is within the error ellipse. DEGRADED: the pose is the best estimate, but "
    "some of its data are missing or faulty. LOST: it may be anywhere, and the map is not updated."
)


def health_section(health: Health) -> str:
    """Return the section: a band coloured by state, and a table of reasons."""
    if len(health.stamps) < 2:
        return ""
    spans = list(health.spans())
    counts = health.counts()
    keys = "".join(
        f'<span class="key {state}">{state} {100.0 * counts[state] / len(health.stamps):.1f} %</span>'
        for state in STATES
        if counts[state]
    )
    figure = f'<figure class="chart"><figcaption>{keys}</figcaption>{_band(health.stamps, spans)}</figure>'
    return section("Health", figure, _reasons(spans, float(health.stamps.min())), note=NOTE)


def _band(stamps: Array, spans: list[Span]) -> str:
    """Return a band from the first to the last stamp, with each span in the colour of its state."""
    first = float(stamps.min())
    seconds = max(float(stamps.max()) - first, 1e-9)
    marks = []
    for span in sorted(spans, key=lambda span: span.state != "DEGRADED"):  # LOST on top
        x = 1000.0 * (min(span.begin, span.end) - first) / seconds
        width = max(1000.0 * abs(span.end - span.begin) / seconds, MIN_WIDTH)
        title = f"{span.begin - first:.1f} s: {span.state}, {span.description}"
        marks.append(
            f'<rect class="{span.state}" x="{x:.1f}" y="0" width="{width:.1f}" height="100">'
            f"<title>{escape(title)}</title></rect>"
        )
    ticks = [t for t in round_numbers(0.0, seconds, 5) if t <= seconds]
    labels = "".join(
        f'<span class="tick x" style="left:{100.0 * t / seconds:.2f}%">{t:g}'
        f"{' s' * (t == ticks[-1])}</span>"
        for t in ticks
    )
    return (
        f'<div class="plot health"{times(first, first + seconds)}><svg viewBox="0 0 1000 100" '
        'preserveAspectRatio="none" role="img" aria-label="Health over time">'
        '<rect class="TRACKING" x="0" y="0" width="1000" height="100"/>'
        f"{''.join(marks)}</svg>{labels}</div>"
    )


def _reasons(spans: list[Span], first: float) -> str:
    """Return the table of the longest spans, in order of time."""
    if not spans:
        return "<p>The pose could be trusted throughout.</p>"
    longest = sorted(spans, key=lambda span: (span.state != "LOST", -span.scans))[:MAX_ROWS]
    rows = [
        (
            span.state,
            span.description,
            f"{span.begin - first:.1f}",
            f"{span.end - first:.1f}",
            span.scans,
        )
        for span in sorted(longest, key=spans.index)
    ]
    hidden = len(spans) - len(longest)
    more = f"<p>{hidden} shorter ones are in summary.json.</p>" if hidden else ""
    return table(("state", "reason", "from s", "to s", "scans"), rows, text=2) + more
