"""Drift of scan matching on recorded logs, relative to what the config assumes (`tracker.drift`).

    python -m benchmarks.drift LOG...

Each log is mapped twice: as usual, and without closing loops. The final path of the first run is the
reference; the live path of the second one has the drift of the tracker. The table shows the root mean
square of the errors over pieces of the path, each divided by the standard deviation of the assumed random
walk: it is 1 if the assumption is right. Both paths share the drift that a wrong range scale causes, so
the table does not show it.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from benchmarks.random_buildings import Live

from impslam.component import build
from impslam.geometry.angles import wrap
from impslam.geometry.se2 import between
from impslam.open_log import open_log
from impslam.run import run
from impslam.types import Array

LENGTHS = 2.0, 5.0, 10.0, 20.0
"""m: shorter pieces show the noise of single matches, on longer ones the reference drifts, too."""
NO_LOOPS = ["estimator.loops.min_path=1e6"]


def paths(log: str) -> tuple[Array, Array]:
    """Return the reference and the drifting poses (n, 3) of the scans that both runs located."""
    final = run(log).path()
    live = Live()
    run(log, settings=NO_LOOPS, observers=[live])
    drifting = {float(stamp): pose for stamp, pose, _ in live.rows}
    both = [row for row in final if float(row[0]) in drifting]
    return np.array(both)[:, 1:], np.array([drifting[float(row[0])] for row in both])


def ratios(log: str) -> list[tuple[float, float]]:
    """Return the ratios of errors and standard deviations, of heading and position, for `LENGTHS`."""
    config, _ = open_log(log)
    drift = build("tracker", config.tracker).drift
    truth, drifting = paths(log)
    steps = between(truth[:-1], truth[1:])
    distance = np.append(0.0, np.cumsum(np.hypot(steps[:, 0], steps[:, 1])))
    turned = np.append(0.0, np.cumsum(np.abs(wrap(steps[:, 2]))))
    out = []
    for length in LENGTHS:
        ends = np.searchsorted(distance, distance + length)
        begins = np.flatnonzero(ends < len(distance))
        ends = ends[begins]
        error = between(
            between(truth[begins], truth[ends]), between(drifting[begins], drifting[ends])
        )
        variance = drift.variances(distance[ends] - distance[begins], turned[ends] - turned[begins])
        of_heading = variance[:, 2] * length**2 / 3.0  # across the path, of its random walk
        heading = np.sqrt(np.mean(wrap(error[:, 2]) ** 2 / variance[:, 2]))
        position = np.sqrt(
            np.mean(
                (error[:, :2] ** 2).sum(axis=1) / (variance[:, 0] + variance[:, 1] + of_heading)
            )
        )
        out.append((float(heading), float(position)))
    return out


def main(logs: list[str]) -> None:
    print("| log |" + "".join(f" {length:.0f} m: heading, position |" for length in LENGTHS))
    print("|---|" + "---|" * len(LENGTHS))
    for log in logs:
        cells = "".join(f" {heading:.2f}, {position:.2f} |" for heading, position in ratios(log))
        print(f"| {Path(log).name} |{cells}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
