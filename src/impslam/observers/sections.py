"""Sections of the report: headline figures, uncertainty, landmarks, matches, times, details."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

import numpy as np

from impslam.observers.base import Outcome
from impslam.observers.history import History
from impslam.observers.page import ChartLine, chart, escape, folded, section, table, tiles
from impslam.observers.summary import (
    compiled,
    config_toml,
    kinds,
    length,
    real_time_factor,
    stage_times,
    working_seconds,
)
from impslam.provenance import versions
from impslam.types import Landmark

ANGLES = {"alpha": "α", "angle": "angle"}
"""Parameters that are angles, and their labels."""
NO_LANDMARKS = "<p>No landmark was found.</p>"


def heading(outcome: Outcome, history: History) -> str:
    """Return the title and the headline figures."""
    known = history.known
    landmarks, before = known.landmarks, len(known.stamps) - len(outcome.health.stamps)
    found = kinds(Counter(mark.kind for mark in landmarks))
    scans = outcome.counts.get("steps", 0)  # without those of a continued map
    speed = real_time_factor(outcome)
    per_scan = 1e3 * working_seconds(outcome) / scans if scans else math.nan
    once = f"; {compiled(outcome)}, once, not counted" if compiled(outcome) else ""
    rate = (f"{speed:,.0f}×", f"real time, {per_scan:.2f} ms per scan{once}")
    if not math.isfinite(speed):  # the duration of the log is unknown
        rate = (f"{per_scan:.2f} ms", f"per scan{once}")
    lost = sum(item.count for item in outcome.dropped.values())
    problems = {0: "no problems", 1: "1 problem or note"}.get(lost, f"{lost:,} problems and notes")
    seconds = outcome.log_seconds
    facts = {
        "Scans": (f"{scans:,}", problems),
        "Duration": (duration(seconds), f"{scans / seconds:.1f} scans/s" if seconds > 0 else ""),
        "Path": (f"{length(known, history.path, before):.1f} m", "estimated"),
        "Landmarks": (str(len(landmarks)), found),
        **_loops(outcome),
        "Speed": rate,
    }
    alone = " by the lidar alone, without odometry" * outcome.lidar_alone
    title = f"<h1>{escape(outcome.log.name)}</h1><p>Mapped by impslam{alone}</p>"
    title += f"<p>Pose: {escape(outcome.health.summary)}.</p>"
    if outcome.partial:
        title += f'<p class="partial">Partial: {escape(outcome.partial)}.</p>'
    return f"<header>{title}</header>" + tiles(facts)


def _loops(outcome: Outcome) -> dict[str, tuple[str, str]]:
    """Return the figure of loop closures, if the estimator closes loops."""
    counts = outcome.counts
    if "loops tried" not in counts:
        return {}
    return {"Loops": (str(counts["loops closed"]), f"closed, {counts['loops tried']} tried")}


def duration(seconds: float) -> str:
    """Return a duration in readable units; NaN is unknown."""
    if math.isnan(seconds):
        return "unknown"
    if seconds < 120.0:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02d} min" if hours else f"{minutes} min {rest:02d} s"


def uncertainty(history: History) -> str:
    """Return the charts of the filter's own standard deviations."""
    if len(history.path) < 2:
        return ""
    t, sigma = history.path[:, 0], history.sigmas
    places = [ChartLine("x", 100 * sigma[:, 0], "a"), ChartLine("y", 100 * sigma[:, 1], "b")]
    charts = (
        chart("Position, 1σ in cm", t, places),
        chart("Heading, 1σ in degrees", t, [ChartLine("", np.degrees(sigma[:, 2]), "c")]),
    )
    note = (
        "The estimator's own standard deviations. They grow on new ground and shrink when known "
        "places are revisited."
    )
    return section("Uncertainty", f'<div class="charts">{"".join(charts)}</div>', note=note)


def matching(history: History) -> str:
    """Return the charts of matches and normalised innovations; "" if the estimator has no matches."""
    keyframes = history.known.keyframes
    if len(keyframes) < 2 or not keyframes.innovations[:, 0].any():
        return ""
    t, (count, nis, dof) = keyframes.stamps, keyframes.innovations.T
    width = max(1, len(t) // 100)
    parts = len(t) // width
    edges = np.arange(parts) * width
    total_nis, total_dof = np.add.reduceat(nis, edges), np.add.reduceat(dof, edges)
    ratio = np.divide(total_nis, total_dof, out=np.full(parts, np.nan), where=total_dof > 0)
    mean = np.add.reduceat(count, edges) / np.diff(edges, append=len(t))
    lines = [ChartLine("", ratio, "a"), ChartLine("ideal", np.ones(parts), "bound")]
    charts = (
        chart("Landmarks matched per keyframe", t[edges], [ChartLine("", mean, "b")]),
        chart("NIS per degree of freedom", t[edges], lines),
    )
    note = (
        "The normalised innovation squared (NIS) of the matches is 1 per degree of freedom if the "
        "filter's noise is right; above 1 the filter is overconfident, below 1 underconfident."
    )
    return section("Matches", f'<div class="charts">{"".join(charts)}</div>', note=note)


def landmark_table(landmarks: Sequence[Landmark]) -> str:
    """Return the table of landmarks with their uncertainties."""
    if not landmarks:
        return section("Landmarks", NO_LANDMARKS)
    header = ("kind", "id", "x, y in m", "parameters", "length", "1σ", "seen", "first to last")
    start = min(mark.first_stamp for mark in landmarks)
    ordered = sorted(landmarks, key=lambda mark: (mark.kind, mark.id))
    rows = [landmark_row(mark, start) for mark in ordered]
    note = (
        "x, y: a point's centre, or the point of a wall's line nearest to the map's origin. 1σ: of x, y "
        "of a point, or of distance r and direction α of a wall. Times from the first observation."
    )
    return section("Landmarks", table(header, rows), note=note)


def landmark_row(mark: Landmark, start: float) -> tuple[str, ...]:
    """Return the cells of a landmark's row; times are relative to `start`, s."""
    a, b = np.sqrt(np.maximum(np.diag(mark.covariance), 0.0))
    wall = mark.end_points is not None
    spread = (
        f"{100 * a:.1f} cm, {math.degrees(b):.2f}°" if wall else f"{100 * a:.1f}, {100 * b:.1f} cm"
    )
    length = "" if mark.end_points is None else f"{math.dist(*mark.end_points):.2f} m"
    x, y = mark.position
    return (
        *(mark.kind, str(mark.id), f"{x:z.3f}, {y:z.3f}", parameters(mark), length, spread),
        *(
            f"{mark.observations}×",
            f"{mark.first_stamp - start:.0f}–{mark.last_stamp - start:.0f} s",
        ),
    )


def parameters(mark: Landmark) -> str:
    """Return a landmark's parameters except its position, as text."""
    names = {"r": "r {:.3f} m", "radius": "radius {:.3f} m"}
    texts = []
    for name, value in mark.parameters.items():
        if name in ANGLES:
            texts.append(f"{ANGLES[name]} {math.degrees(value):z.1f}°")
        elif name not in ("x", "y"):
            texts.append(names.get(name, name + " {:g}").format(value))
    return ", ".join(texts)


def stages(outcome: Outcome) -> str:
    """Return the table of times."""
    rows = []
    for name, seconds in outcome.stages.items():
        times = stage_times(seconds)
        cells = ("–" if value is None else f"{value:.2f}" for value in times.values())
        rows.append(
            (name, *cells, f"{100 * np.sum(seconds) / max(outcome.wall_seconds, 1e-9):.0f} %")
        )
    header = ("stage", "mean ms", "median ms", "99 % ms", "of the run")
    note = (
        "sense: per block of the log; track: per group of sweeps up to a keyframe; extract, estimate: "
        "per keyframe; refine: once. In the first run of a version, they include compiling."
    )
    return section("Time", table(header, rows), note=note)


def dropped(outcome: Outcome) -> str:
    """Return the table of dropped and suspicious data."""
    if not outcome.dropped:
        return section("Problems and notes", "<p>None: all data of the log were used.</p>")
    rows = [(kind, f"{d.count:,}", d.example) for kind, d in sorted(outcome.dropped.items())]
    note = "Data that were dropped or are suspicious, with the first example of each kind."
    header = ("kind", "times", "first example")
    return section("Problems and notes", table(header, rows, text=3), note=note)


def details(outcome: Outcome) -> str:
    """Return the data needed to repeat the run."""
    facts = [
        ("log", outcome.log),
        ("SHA-256 of the log", outcome.log_sha256),
        *(
            (f"version of {name}" if name != "platform" else name, v)
            for name, v in versions().items()
        ),
        ("scalars in the filter state", outcome.state_size),
        *(
            (f"{name} in the log" if name[0].isupper() else name, f"{n:,}")
            for name, n in sorted(outcome.counts.items())
        ),
    ]
    config = f"<pre>{escape(config_toml(outcome.config))}</pre>"
    return section(
        "To repeat the run",
        folded("Log, versions and counts", table(("what", ""), facts, text=2)),
        folded("The configuration, as in config.toml", config),
    )
