"""The comparison of extractors as tables, and as figures for other programs."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from impslam.studies.extractor_stats import Tally, mean, rms, typical_ratio
from impslam.studies.report import ResultTable

NAMES = {"wall": "Walls", "cylinder": "Cylinders"}
OTHER = {"wall": "doors, boxes", "cylinder": "legs"}
TIMES, DEGREES = 1e3, math.degrees(1.0)  # to mm and deg

Tallies = Mapping[str, Mapping[str, Tally]]
Speeds = Mapping[str, Mapping[str, float]]
"""Scans per second by extractor and condition."""


def detection_table(kind: str, tallies: Tallies, speeds: Speeds) -> ResultTable:
    """Return speed, what was found and what was not there, by extractor and condition."""
    fastest = {
        condition: max(one[condition] for one in speeds.values())
        for condition in next(iter(speeds.values()))
    }
    whole = kind == "cylinder"
    rows = [
        [
            label,
            condition,
            f"{scans:.0f}",
            f"{scans / fastest[condition]:.2f}",
            *_rates(tallies[label][condition], whole),
        ]
        for label, one in speeds.items()
        for condition, scans in one.items()
    ]
    header = ["Extractor", "Scans", "scans/s", "÷ fastest", "found %", "again/scan"]
    header += [f"{OTHER[kind]}/scan", "false/scan"]
    if whole:
        header.insert(5, "of whole ones %")
    return ResultTable(
        f"{NAMES[kind]}: what is found", header, rows, text=2, note=DETECTION_NOTE[kind]
    )


def _rates(tally: Tally, whole: bool) -> list[str]:
    shares = [tally.true_positives, tally.whole_found] if whole else [tally.true_positives]
    rates = [tally.rate(what)[0] for what in ("again", "other", "false")]
    return [f"{100 * share:.1f}" for share, _ in shares] + [f"{rate:.2f}" for rate in rates]


def accuracy_table(kind: str, tallies: Tallies) -> ResultTable:
    """Return errors against the bound, a row for each extractor and condition."""
    columns = WALL_COLUMNS if kind == "wall" else CYLINDER_COLUMNS
    rows = [
        [label, condition, *(_cell(column, tally) for column in columns.values())]
        for label, conditions in tallies.items()
        for condition, tally in conditions.items()
    ]
    header = ["Extractor", "Scans", *columns]
    return ResultTable(f"{NAMES[kind]}: how well", header, rows, text=2, note=ACCURACY_NOTE[kind])


Column = Callable[[Tally], tuple[float, float]]


def _cell(column: Column, tally: Tally) -> str:
    value, error = column(tally) if tally.found else (math.nan, math.nan)
    if not math.isfinite(value):
        return "–"
    # No more digits than the standard error leaves, but at least one that says how small it is.
    digits = 2 if not error > 0.0 else min(max(0, -math.floor(math.log10(error))), 2)
    text = f"{value:.{digits}f}"
    return text.removeprefix("-") if float(text) == 0.0 else text.replace("-", "−")


def _scaled(pair: tuple[float, float], factor: float) -> tuple[float, float]:
    return factor * pair[0], factor * pair[1]


def _used(tally: Tally) -> tuple[float, float]:
    return _scaled(mean(tally.column("used")), 100.0)


def _typical(tally: Tally) -> tuple[float, float]:
    return typical_ratio(tally.excess), math.nan


WALL_COLUMNS: dict[str, Column] = {
    "r bias mm": lambda t: _scaled(mean(t.errors[:, 0]), TIMES),
    "r RMS mm": lambda t: _scaled(rms(t.errors[:, 0]), TIMES),
    "r ÷ CRB": lambda t: t.ratio(0),
    "α bias °": lambda t: _scaled(mean(t.errors[:, 1]), DEGREES),
    "α RMS °": lambda t: _scaled(rms(t.errors[:, 1]), DEGREES),
    "α ÷ CRB": lambda t: t.ratio(1),
    "typical": _typical,
    "own": lambda t: t.own_ratio,
    "used %": _used,
    "NEES": lambda t: mean(t.nees),
}
CYLINDER_COLUMNS: dict[str, Column] = {
    "bias mm": lambda t: _scaled(mean(t.column("radial")), TIMES),
    "RMS mm": lambda t: _scaled(rms(np.hypot(*t.errors.T)), TIMES),
    "÷ CRB": lambda t: t.joint_ratio,
    "typical": _typical,
    "own": lambda t: t.own_ratio,
    "radius bias": lambda t: _scaled(mean(t.column("radius_error")), TIMES),
    "radius RMS": lambda t: _scaled(rms(t.column("radius_error")), TIMES),
    "radius ÷ CRB": lambda t: t.radius_ratio,
    "used %": _used,
    "NEES": lambda t: mean(t.nees),
}


def figures(tallies: Tallies, speeds: Speeds) -> dict[str, Any]:
    """Return all numbers with their standard errors, by extractor and condition; m, rad and s."""
    return {
        label: {
            condition: {
                "scans_per_second": speeds.get(label, {}).get(condition),
                **_figures(tally),
            }
            for condition, tally in conditions.items()
        }
        for label, conditions in tallies.items()
    }


def _figures(tally: Tally) -> dict[str, Any]:
    """Return value and standard error by name; None where there is none."""
    pairs: dict[str, tuple[float, float]] = {
        "true_positives": tally.true_positives,
        "true_positives_of_whole": tally.whole_found,
        **{f"{what}_per_scan": tally.rate(what) for what in ("again", "other", "false")},
    }
    if tally.found:
        z = tally.errors.T
        pairs |= {f"bias_{k}": mean(z[k]) for k in (0, 1)}
        pairs |= {f"rms_{k}": rms(z[k]) for k in (0, 1)}
        pairs |= {f"ratio_{k}": tally.ratio(k) for k in (0, 1)}
        pairs |= {"ratio": tally.joint_ratio, "own_ratio": tally.own_ratio}
        pairs |= {"nees": mean(tally.nees)}
        pairs |= {"beams_used": mean(tally.column("used"))}
    if len(tally.column("radius_error")):
        radius = tally.column("radius_error")
        pairs |= {"radius_bias": mean(radius), "radius_rms": rms(radius)}
        pairs |= {"radius_ratio": tally.radius_ratio}
    numbers = {
        name: {"value": value, "error": error} if math.isfinite(value) else None
        for name, (value, error) in pairs.items()
    }
    typical = {"typical_ratio": typical_ratio(tally.excess)} if tally.found else {}
    return {"scans": len(tally.counts), "compared": len(tally.found), **typical, **numbers}


DETECTION_NOTE = {
    "wall": (
        "Found: share of the visible walls (10 beams and 0.3 m or more of them). Again: further "
        "observations of the same wall, of its other pieces as a rule. Doors, boxes: straight "
        "things that are there but no walls, and walls that are hardly seen. False: of nothing "
        "that is there."
    ),
    "cylinder": (
        "Found: share of the visible cylinders (5 beams or more), those cut by the end of the scan "
        "or by something in front included; of whole ones: of those seen from edge to edge. Legs: "
        "of the people, and cylinders hardly seen. False: of nothing round that is there."
    ),
}
ACCURACY_NOTE = {
    "wall": (
        "÷ CRB: RMS of the errors, each divided by the Cramér-Rao bound of all beams that hit the "
        "wall; 1 is the best possible. Typical: the same of r and α together, by the median, which "
        "the few that went wrong do not rule. Own: RMS of both, against the bound of those beams "
        "that the extractor used, the share of which follows. NEES: squared error in the covariance "
        "that the extractor gives; 2 is honest, less is cautious, more is overconfident."
    ),
    "cylinder": (
        "As for walls; of the centre (its bias along the line of sight), then of the radius in mm. "
        "Extractors to which the radius is told are scored on the cylinders that have it, against "
        "the bound for a known radius."
    ),
}
