"""Loop closures of recorded buildings: tried, accepted, false, and the time of each attempt.

    python -m benchmarks.closures --data ../shared/data [LOG ...]

Every accepted closure is checked against: manually verified relations (Kümmerle et al. 2009), if one joins
the same two passes within `MAX_GAP` m of driving at both ends; an exhaustive search for the best pose with
any heading within `WINDOW` m; and the refined poses. If it differs by more than 0.5 m or 5 degrees from the
relation or from the best pose, free space decides: the closure is false if free space agrees with the other
pose at least as well. Rooms and corridors look alike, and a reference may be distorted.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from benchmarks.buildings import FALSE, LOGS, row, table, timed

from impslam.estimators.keyframe_log import KeyframeLog
from impslam.estimators.loop_closing import QUERY_CELL, QUERY_RANGE, REFERENCE_CELL
from impslam.evaluation.relations import read_relations
from impslam.geometry.se2 import between, compose
from impslam.map import Map
from impslam.open_log import open_log
from impslam.recognition.correlative import Window, search, start_level
from impslam.recognition.places import search_points
from impslam.recognition.pyramid import build
from impslam.recognition.submap import Submap, gather
from impslam.recognition.verify import verify
from impslam.run import Run
from impslam.surfaces.surface_map import add, clear, empty_surface_map
from impslam.types import Array

MAX_GAP = 2.0  # m driven between the ends of a relation and of a closure: tracking drifts by 2 cm
WINDOW = 8.0  # m, half the extent of the exhaustive search
REFERENCE_PATH, QUERY_PATH = 8.0, 4.0  # m driven on both sides in the two submaps
MAX_RANGE = 30.0  # m: visible to the query from the edge of the window
OWN_RADIUS = 0.3  # m and rad around a closure, in which the search takes the closure's own score
NONE = np.full(3, math.nan)


class Check(NamedTuple):
    """Results of the checks of one closure; NaN without a relation.

    Attributes
    ----------
    i, j : the keyframes
    pose : (3,) T_i_j as closed
    relation, refined, found : (3,) differences of the closure from the relation, from the refined poses,
        and from the best pose of the search
    scores : of the closure's own pose and of that best one
    agreements : with free space, of both, and of the pose by the relation
    """

    i: int
    j: int
    pose: Array
    relation: Array
    refined: Array
    found: Array
    scores: tuple[float, float]
    agreements: tuple[float, float, float]

    @property
    def elsewhere(self) -> bool:
        """Whether a different pose has a better score."""
        return differs(self.found)

    @property
    def off(self) -> bool:
        """Whether it differs from the relation."""
        return differs(self.relation)

    @property
    def false(self) -> bool:
        mine, best, relation = self.agreements
        return (self.elsewhere and best >= mine) or (self.off and relation >= mine)


def differs(d: Array) -> bool:
    return bool(math.hypot(d[0], d[1]) > FALSE[0] or abs(d[2]) > FALSE[1])


def mapped(log: Path) -> tuple[Run, Map, list[float]]:
    """Return a finished run with its map, and the CPU ms of each attempt to close a loop."""
    config, source = open_log(log, None, ())
    run, attempts = Run(config), []
    recogniser = run.estimator._closer.recogniser  # type: ignore[attr-defined]  # the graph's
    recogniser.find_closure = timed(recogniser.find_closure, attempts)
    with source:
        for batch in run.robot.streams.read(source):
            run.feed(batch)
    run.flush()
    return run, run.refined(), attempts


def checks(run: Run, known: Map, relations: Array) -> list[Check]:
    """Check all closures of a run."""
    keys: KeyframeLog = run.estimator._keys  # type: ignore[attr-defined]
    poses, edges, out = known.keyframes.poses, known.edges, []
    for k in np.flatnonzero(np.isfinite(edges.kernel)):
        i, j, pose = int(edges.i[k]), int(edges.j[k]), edges.T_i_j[k]
        refined = between(between(poses[i], poses[j]), pose)
        relation = by_relations(known, keys, i, j, pose, relations)
        other = compose(pose, between(relation, np.zeros(3)))
        out.append(Check(i, j, pose, relation, refined, *by_search(keys, i, j, pose, other)))
    return out


def by_relations(
    known: Map, keys: KeyframeLog, i: int, j: int, pose: Array, relations: Array
) -> Array:
    """Return the difference of a closure from the best relation between its ends; NaN if there is none.

    What lies between an end of the closure and that of the relation is taken from the refined map.
    """
    order = np.argsort(known.stamps, kind="stable")
    ranks = np.searchsorted(known.stamps[order], relations[:, :2].ravel()).clip(0, len(order) - 1)
    sweeps = order[ranks].reshape(-1, 2)
    ways = keys.distance[known.anchors[sweeps]]
    poses = known.path()[:, 1:][sweeps]
    base, best, out = known.keyframes.poses, MAX_GAP, NONE
    for way, ends, (*_, x, y, theta) in zip(ways, poses, relations, strict=True):
        for one, other in ((0, 1), (1, 0)):
            away = max(abs(way[one] - keys.distance[i]), abs(way[other] - keys.distance[j]))
            if away >= best:
                continue
            T = np.array([x, y, theta])
            T = T if one == 0 else between(T, np.zeros(3))
            expected = compose(between(base[i], ends[one]), T)
            best, out = away, between(compose(expected, between(ends[other], base[j])), pose)
    return out


def by_search(
    keys: KeyframeLog, i: int, j: int, pose: Array, other: Array
) -> tuple[Array, tuple[float, float], tuple[float, float, float]]:
    """Return the best pose of all around, less that of the closure; the scores and the agreements.

    `other` (3,) is the pose by the relation.
    """
    reference = around(keys, i, REFERENCE_PATH, (REFERENCE_CELL, MAX_RANGE))
    query = around(keys, j, QUERY_PATH, (QUERY_CELL, QUERY_RANGE))
    points, turn = search_points(query.features)
    window, own = Window(WINDOW, WINDOW, math.pi), Window(OWN_RADIUS, OWN_RADIUS, OWN_RADIUS)
    pyramid = build(reference.features, start_level(window))
    mine = search(pyramid, points, pose, own, turn=turn)
    best = search(pyramid, points, pose, window, turn=turn)
    low = reference.features[:, :2].min(0).astype(float) - 1.0
    x, y = reference.features[:, :2].max(0).astype(float) + 1.0 - low
    surface = empty_surface_map(x, y, len(reference.features))
    clear(surface, low)
    add(surface, reference.features, np.zeros(3), 20.0)
    poses = (pose, best.pose, other if np.isfinite(other).all() else pose)
    mine_, best_, other_ = (verify(surface, reference, query, p).agreement for p in poses)
    return between(pose, best.pose), (mine.score, best.score), (mine_, best_, other_)


def around(keys: KeyframeLog, k: int, way: float, extent: tuple[float, float]) -> Submap:
    """Return the submap around a keyframe, as tracked: independent of closures."""
    near = np.flatnonzero(np.abs(keys.distance - keys.distance[k]) <= way)
    rows = [row for row in near if keys.views[row] is not None]
    views: list[Any] = [keys.views[row] for row in rows]
    return gather(views, keys.chain[rows], keys.chain[k], *extent)


def figures(run: Run, found: Sequence[Check], attempts: Sequence[float]) -> list[object]:
    """Return a row of the table."""
    covered = [c for c in found if np.isfinite(c.relation[0])]
    offs = [f"{np.hypot(*c.relation[:2]):.2f}" for c in covered]
    return [
        run.estimator._closer.recogniser.counts["attempts"],  # type: ignore[attr-defined]
        len(found),
        f"{len(covered)} ({max(offs, default='-')} m)",
        sum(c.off for c in found),
        sum(differs(c.refined) for c in found),
        sum(c.elsewhere for c in found),
        sum(c.false for c in found),
        f"{np.median(attempts):.1f}",
        f"{np.quantile(attempts, 0.99):.0f}",
        f"{max(attempts):.0f}",
    ]


HEAD = ("log", "tried", "accepted", "with a relation (worst)", "off from it", "off when refined")
HEAD += ("better score elsewhere", "false", "median, ms", "p99", "worst")


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    options.add_argument("--data", type=Path, required=True)
    options.add_argument("logs", nargs="*", default=LOGS)
    given = options.parse_args()
    rows = []
    for name in given.logs:
        run, known, attempts = mapped(given.data / name / f"{name}.log")
        found = checks(run, known, read_relations(given.data / name / f"{name}.relations"))
        rows.append(row(name, *figures(run, found, attempts)))
        for c in found:
            if c.elsewhere or c.off:
                print(f"{name} {c.i} to {c.j}: {c}", flush=True)
    table(HEAD, rows)


if __name__ == "__main__":
    main()
