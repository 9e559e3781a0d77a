"""Tables of the comparison of extractors, and the numbers behind them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

from impslam.studies.extractor_stats import ExtractorScore, typical_ratio
from impslam.studies.report import ResultTable, load_text, make_table
from impslam.sweeps.statistics import NONE, Estimate

TEXT = load_text("extractors")
OTHER: Mapping[str, str] = TEXT["other"]
"""By kind, the name of observations of existing things that are no landmarks."""
LABELS = ("Extractor", "Scans")

Scores = Mapping[str, Mapping[str, ExtractorScore]]
"""By extractor and condition."""
Speeds = Mapping[str, Mapping[str, float]]
"""Scans per second by extractor and condition."""


def detection_table(kind: str, scores: Scores, speeds: Speeds) -> ResultTable:
    """Return speed, and found and false landmarks, by extractor and condition."""
    fastest = {
        condition: max(one[condition] for one in speeds.values())
        for condition in next(iter(speeds.values()))
    }

    def share(name: str) -> Callable[[tuple[str, str]], str]:
        return lambda key: f"{100 * getattr(scores[key[0]][key[1]], name).value:.1f}"

    def per_scan(name: str) -> Callable[[tuple[str, str]], str]:
        return lambda key: f"{scores[key[0]][key[1]].rate(name).value:.2f}"

    columns: dict[str, Callable[[tuple[str, str]], str]] = {
        "scans/s": lambda key: f"{speeds[key[0]][key[1]]:.0f}",
        "÷ fastest": lambda key: f"{speeds[key[0]][key[1]] / fastest[key[1]]:.2f}",
        "found %": share("true_positives"),
        **({"of whole ones %": share("whole_found")} if kind == "cylinder" else {}),
        "again/scan": per_scan("again"),
        f"{OTHER[kind]}/scan": per_scan("other"),
        "false/scan": per_scan("false"),
    }
    groups = {(label, condition): (label, condition) for label in speeds for condition in fastest}
    title = f"{kind.capitalize()}s: detection"
    return make_table(title, groups, columns, TEXT["detection"][kind], LABELS)


MM, DEGREES, PERCENT = 1e3, math.degrees(1.0), 100.0
COLUMNS = {
    "wall": {
        "r bias mm": ("bias_0", MM),
        "r RMS mm": ("rms_0", MM),
        "r ÷ CRB": ("ratio_0", 1.0),
        "α bias °": ("bias_1", DEGREES),
        "α RMS °": ("rms_1", DEGREES),
        "α ÷ CRB": ("ratio_1", 1.0),
        "typical": ("typical_ratio", 1.0),
        "own": ("own_ratio", 1.0),
        "used %": ("beams_used", PERCENT),
        "NEES": ("nees", 1.0),
    },
    "cylinder": {
        "bias mm": ("radial_bias", MM),
        "RMS mm": ("rms", MM),
        "÷ CRB": ("ratio", 1.0),
        "typical": ("typical_ratio", 1.0),
        "own": ("own_ratio", 1.0),
        "radius bias": ("radius_bias", MM),
        "radius RMS": ("radius_rms", MM),
        "radius ÷ CRB": ("radius_ratio", 1.0),
        "used %": ("beams_used", PERCENT),
        "NEES": ("nees", 1.0),
    },
}
"""By header, the metric of `ExtractorScore` and the factor to the header's unit."""


def accuracy_table(kind: str, scores: Scores) -> ResultTable:
    """Return errors against the bound, a row for each extractor and condition."""

    def cell(metric: str, factor: float) -> Callable[[Mapping[str, Estimate]], str]:
        return lambda metrics: _rounded(metrics.get(metric, NONE).scaled(factor))

    groups = {
        (label, condition): {
            **score.metrics(),
            "typical_ratio": Estimate(typical_ratio(score.excess), math.nan),
        }
        for label, conditions in scores.items()
        for condition, score in conditions.items()
    }
    columns = {header: cell(*metric) for header, metric in COLUMNS[kind].items()}
    title = f"{kind.capitalize()}s: accuracy"
    return make_table(title, groups, columns, TEXT["accuracy"][kind], LABELS)


def _rounded(estimate: Estimate) -> str:
    value, error = estimate
    if not math.isfinite(value):
        return "–"
    # Significant digits by the standard error, at most two decimals.
    digits = 2 if not error > 0.0 else min(max(0, -math.floor(math.log10(error))), 2)
    text = f"{value:.{digits}f}"
    return text.removeprefix("-") if float(text) == 0.0 else text.replace("-", "−")


def numbers(scores: Scores, speeds: Speeds) -> dict[str, Any]:
    """Return all numbers with their standard errors, by extractor and condition; m, rad and s."""
    return {
        label: {
            condition: {
                "scans_per_second": speeds.get(label, {}).get(condition),
                **_numbers(score),
            }
            for condition, score in conditions.items()
        }
        for label, conditions in scores.items()
    }


def _numbers(score: ExtractorScore) -> dict[str, Any]:
    """Return value and standard error by name; None for missing values."""
    estimates: dict[str, Estimate] = {
        "true_positives": score.true_positives,
        "true_positives_of_whole": score.whole_found,
        **{f"{what}_per_scan": score.rate(what) for what in ("again", "other", "false")},
        **score.metrics(),
    }
    typical = {"typical_ratio": typical_ratio(score.excess)} if score.found else {}
    return {
        "scans": len(score.counts),
        "compared": len(score.found),
        **typical,
        **{k: e._asdict() if math.isfinite(e.value) else None for k, e in estimates.items()},
    }
