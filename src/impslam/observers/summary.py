"""The summary of a run: counts, dropped data, times, versions, hashes."""

from __future__ import annotations

import hashlib
import math
from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np
import tomli_w

from impslam.health import Health
from impslam.map import Map
from impslam.observers.base import Outcome
from impslam.observers.history import History
from impslam.provenance import versions
from impslam.types import Array


def summarise(outcome: Outcome, history: History, refused: int) -> dict[str, Any]:
    """Return the contents of summary.json. Values that can differ between equal runs are under "time"."""
    kinds = Counter(mark.kind for mark in history.known.landmarks)
    return {
        "log": {
            "path": str(outcome.log),
            "sha256": outcome.log_sha256,
            "seconds": _round(outcome.log_seconds),
        },
        "partial": outcome.partial or None,
        "config_sha256": hashlib.sha256(config_toml(outcome.config).encode()).hexdigest(),
        "seed": outcome.config.get("seed"),
        "counts": dict(sorted(outcome.counts.items())),
        "landmarks": dict(sorted(kinds.items())),
        "lidar_alone": outcome.lidar_alone,
        "state_size": outcome.state_size,
        "path_length_m": {
            "slam": _round(length(history.known, history.path), 6),
            "odometry": _round(length(history.known, history.odometry), 6),
        },
        "quality": {name: _round(value, 6) for name, value in history.quality.figures().items()},
        "health": _health(outcome.health),
        "dropped": {
            kind: {"count": dropped.count, "example": dropped.example}
            for kind, dropped in sorted(outcome.dropped.items())
        },
        "grid_beams_refused": refused,
        "versions": versions(),
        "time": {
            "wall_s": _round(outcome.wall_seconds, 3),
            "compile_s": _round(outcome.compile_seconds, 3),
            "real_time_factor": _round(real_time_factor(outcome), 1),
            "stages_ms": {name: stage_times(t) for name, t in outcome.stages.items()},
        },
    }


def _health(health: Health) -> dict[str, Any]:
    """Return the number of scans in each state, the spans that are not TRACKING, and the last state."""
    spans = [
        {
            "begin": _round(span.begin),
            "end": _round(span.end),
            "state": span.state,
            "reason": span.description,
            "scans": span.scans,
        }
        for span in health.spans()
    ]
    return {
        "scans": health.counts(),
        "spans": spans,
        "silent_at_end_s": _round(health.silent),
        "at_end": health.at_end,
    }


def kinds(numbers: Mapping[str, int]) -> str:
    """Return the numbers of landmarks of each kind in words, e.g. "1 corner, 4 walls"."""
    return ", ".join(f"{n} {kind}{'s' * (n != 1)}" for kind, n in sorted(numbers.items()))


def loops(counts: Mapping[str, int]) -> str:
    """Return how many loops were closed, or "" if the estimator closes none."""
    if "loops tried" not in counts:
        return ""
    return f"{counts['loops closed']} closed, {counts['loops tried']} tried"


def real_time_factor(outcome: Outcome) -> float:
    """Return the duration of the log divided by that of the run, without compiling."""
    seconds = working_seconds(outcome)
    return outcome.log_seconds / seconds if seconds > 0.0 else math.nan


def working_seconds(outcome: Outcome) -> float:
    """Return the duration of the run without compiling, s."""
    return outcome.wall_seconds - outcome.compile_seconds


def compiled(outcome: Outcome) -> str:
    """Return how long the run compiled, or "" if less than 0.5 s."""
    seconds = outcome.compile_seconds
    return f"{seconds:.0f} s compiling" if seconds >= 0.5 else ""


def stage_times(seconds: Array) -> dict[str, float | None]:
    """Return mean, median and 99th percentile in ms of times (n,) in s; None without times."""
    if len(seconds) == 0:
        return {"mean": None, "p50": None, "p99": None}
    p50, p99 = np.percentile(seconds, (50, 99))
    values = {"mean": float(np.mean(seconds)), "p50": float(p50), "p99": float(p99)}
    return {name: _round(1e3 * value, 4) for name, value in values.items()}


def length(known: Map, path: Array, begin: int = 0) -> float:
    """Return the length in m of a map's path, (n, 4) stamp, x, y, theta of its placed sweeps.

    It is measured from sweep `begin` of the map. Gaps between sessions do not count.
    """
    sweeps = np.flatnonzero(known.placed())
    sessions = known.keyframes.sessions[known.anchors[sweeps]]
    driven = (np.diff(sessions) == 0) & (sweeps[:-1] >= begin)
    return float(np.hypot(*np.diff(path[:, 1:3], axis=0)[driven].T).sum())


def config_toml(config: Mapping[str, Any]) -> str:
    """Return a config as TOML. Unset values are omitted, because TOML has no null."""
    return tomli_w.dumps(_plain(config))


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items() if v is not None}
    if isinstance(value, list | tuple | np.ndarray):
        return [_plain(item) for item in value]
    if isinstance(value, np.generic):
        return value.item()
    return value if isinstance(value, str | bool | int | float) else str(value)


def _round(value: float, digits: int = 9) -> float | None:
    return round(value, digits) if math.isfinite(value) else None
