"""The comparison of extractors as tables, and as figures for other programs."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from impslam.experiments.base import Table
from impslam.experiments.extractor_stats import Tally, mean, rms, typical_ratio

NAMES = {"wall": "Walls", "cylinder": "Cylinders"}
OTHER = {"wall": "doors, boxes", "cylinder": "legs"}
TIMES, DEGREES = 1e3, math.degrees(1.0)  # to mm and deg

Tallies = Mapping[str, Mapping[str, Tally]]


def detection_table(
    kind: str, tallies: Tallies, speeds: Mapping[str, float], empty: str, crowded: str
) -> Table:
    """Return what was found and what was not there, without and with people, and the speed.

    `empty` and `crowded` are the names of the conditions.
    """
    fastest = max(speeds.values())
    rows = [
        [
            label,
            f"{scans:.0f}",
            f"{scans / fastest:.2f}",
            *_shares(tallies[label][empty], tallies[label][crowded]),
        ]
        for label, scans in speeds.items()
    ]
    header = ["Extractor", "scans/s", "of fastest", "found %", "with people", "again/scan"]
    header += ["with people", f"{OTHER[kind]}/scan", "with people", "false/scan", "with people"]
    return Table(f"{NAMES[kind]}: what is found", header, rows, note=DETECTION_NOTE[kind])


def _shares(*both: Tally) -> list[str]:
    cells = [f"{100 * tally.true_positives[0]:.1f}" for tally in both]
    for what in ("again", "other", "false"):
        cells += [f"{tally.rate(what)[0]:.2f}" for tally in both]
    return cells


def accuracy_table(kind: str, tallies: Tallies) -> Table:
    """Return errors against the bound, a row for each extractor and condition."""
    columns = WALL_COLUMNS if kind == "wall" else CYLINDER_COLUMNS
    rows = [
        [label, condition, str(len(tally.found)), *(_cell(c, tally) for c in columns.values())]
        for label, conditions in tallies.items()
        for condition, tally in conditions.items()
    ]
    header = ["Extractor", "Scans", "number", *columns]
    return Table(f"{NAMES[kind]}: how well", header, rows, text=2, note=ACCURACY_NOTE[kind])


Column = Callable[[Tally], tuple[float, float]]


def _cell(column: Column, tally: Tally) -> str:
    value, error = column(tally) if tally.found else (math.nan, math.nan)
    if not math.isfinite(value):
        return "-"
    digits = 2 if not error > 0.0 else max(0, min(2, 1 - math.floor(math.log10(error))))
    return f"{value:.{digits}f}"


def _scaled(pair: tuple[float, float], factor: float) -> tuple[float, float]:
    return factor * pair[0], factor * pair[1]


def _used(tally: Tally) -> tuple[float, float]:
    return _scaled(mean(tally.column("used")), 100.0)


def _typical(tally: Tally) -> tuple[float, float]:
    return typical_ratio(tally.excess), math.nan


WALL_COLUMNS: dict[str, Column] = {
    "r bias mm": lambda t: _scaled(mean(t.errors[:, 0]), TIMES),
    "r RMS mm": lambda t: _scaled(rms(t.errors[:, 0]), TIMES),
    "r ÷ bound": lambda t: t.ratio(0),
    "α bias °": lambda t: _scaled(mean(t.errors[:, 1]), DEGREES),
    "α RMS °": lambda t: _scaled(rms(t.errors[:, 1]), DEGREES),
    "α ÷ bound": lambda t: t.ratio(1),
    "typical ÷ bound": _typical,
    "beams used %": _used,
    "NEES (2)": lambda t: mean(t.nees),
}
CYLINDER_COLUMNS: dict[str, Column] = {
    "range bias mm": lambda t: _scaled(mean(t.column("radial")), TIMES),
    "centre RMS mm": lambda t: _scaled(rms(np.hypot(*t.errors.T)), TIMES),
    "centre ÷ bound": lambda t: t.joint_ratio,
    "typical ÷ bound": _typical,
    "radius bias mm": lambda t: _scaled(mean(t.column("radius_error")), TIMES),
    "radius RMS mm": lambda t: _scaled(rms(t.column("radius_error")), TIMES),
    "radius ÷ bound": lambda t: t.radius_ratio,
    "beams used %": _used,
    "NEES (2)": lambda t: mean(t.nees),
}


def figures(tallies: Tallies, speeds: Mapping[str, float]) -> dict[str, Any]:
    """Return all numbers with their standard errors, by extractor and condition; m, rad and s."""
    return {
        label: {
            **({"scans_per_second": speeds[label]} if label in speeds else {}),
            **{condition: _figures(tally) for condition, tally in conditions.items()},
        }
        for label, conditions in tallies.items()
    }


def _figures(tally: Tally) -> dict[str, Any]:
    pairs: dict[str, tuple[float, float]] = {
        "true_positives": tally.true_positives,
        **{f"{what}_per_scan": tally.rate(what) for what in ("again", "other", "false")},
    }
    if tally.found:
        z = tally.errors.T
        pairs |= {f"bias_{k}": mean(z[k]) for k in (0, 1)}
        pairs |= {f"rms_{k}": rms(z[k]) for k in (0, 1)}
        pairs |= {f"ratio_{k}": tally.ratio(k) for k in (0, 1)}
        pairs |= {"ratio": tally.joint_ratio, "nees": mean(tally.nees)}
        pairs |= {"beams_used": mean(tally.column("used"))}
    if len(tally.column("radius_error")):
        radius = tally.column("radius_error")
        pairs |= {"radius_bias": mean(radius), "radius_rms": rms(radius)}
        pairs |= {"radius_ratio": tally.radius_ratio}
    numbers = {name: {"value": value, "error": error} for name, (value, error) in pairs.items()}
    typical = {"typical_ratio": typical_ratio(tally.excess)} if tally.found else {}
    return {"scans": len(tally.counts), "found": len(tally.found), **typical, **numbers}


DETECTION_NOTE = {
    "wall": (
        "Found: share of the visible walls (10 beams and 0.3 m or more of them). Again: further "
        "observations of the same wall, of its other pieces as a rule. Doors, boxes: straight "
        "things that are there but no walls, and walls that are hardly seen. False: of nothing "
        "that is there."
    ),
    "cylinder": (
        "Found: share of the visible cylinders (5 beams or more), those cut by the end of the scan "
        "or by something in front included. Legs: of the people, and cylinders hardly seen. False: "
        "of nothing round that is there."
    ),
}
ACCURACY_NOTE = {
    "wall": (
        "÷ bound: RMS of the errors, each divided by its Cramér-Rao bound; 1 is the best possible. "
        "Typical: the same by the median, which the few that went wrong do not rule. Beams used: of "
        "those that hit the wall. NEES: squared error in the covariance that the extractor gives; "
        "2 is honest, less is cautious, more is overconfident."
    ),
    "cylinder": (
        "As for walls. Extractors to which the radius is told are scored on the cylinders that have "
        "it, against the bound for a known radius."
    ),
}
