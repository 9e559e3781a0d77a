"""Relocalisation of scans, and of short paths, in maps of recorded and simulated buildings.

    python -m benchmarks.relocalisation --data ../shared/data              # 1000 scans and ways a log
    python -m benchmarks.relocalisation --data ../shared/data --tries 100 intel
    python -m benchmarks.relocalisation --simulated 10000                  # buildings with twins

One part of each log is mapped, and scans of the other part are searched in this map. With alternating
minutes most places are in both parts; with the halves of the building left and right of the median
keyframe they are not. The truth is the refined map of the whole log. A pose is covered by the map if at
most 30 % of its beams end in unknown space and a scan of the map was taken within 1.5 m; it is outside if
more than 60 % do. Of simulated buildings with twins, one half is also mapped alone, and scans of the other
half are searched in it: many look like a place of the map. An answer is correct within 0.3 m and 5 degrees;
an answer reported as found that is not correct is silently wrong.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields, replace
from functools import partial
from itertools import chain, islice
from operator import attrgetter
from pathlib import Path
from typing import NamedTuple

import numpy as np
from benchmarks.twin_buildings import DRIVE_STEP, buildings

from impslam.columns import Sweeps
from impslam.geometry.angles import wrap
from impslam.map import Keyframe, Keyframes, Map, PathRows, Revision, Track
from impslam.observers.base import Observer, Outcome
from impslam.open_log import open_log
from impslam.recognition.beams import explain
from impslam.recognition.drive import DriveRelocaliser
from impslam.recognition.relocalisation import Answer, Relocaliser, Verdict, query
from impslam.recognition.submap import View, view
from impslam.run import map_log
from impslam.types import Array, Ints, Mask

LOGS = ("fr079", "intel", "fr-hospital")
PLAIN = [f"sensors.lidar.extractors.{name}.kind=none" for name in ("walls", "cylinders", "corners")]
MAX_METRES, MAX_RADIANS = 0.3, np.radians(5.0)  # error of a correct answer
COVERED, OUTSIDE = 0.3, 0.6  # share of beams that end in unknown space
COVERED_RADIUS = 1.5  # m from a keyframe of the map to a covered pose
PATH_LENGTH = 2.0  # m
BLOCK = 60.0  # s
QUERIES = 50  # scans that are searched in a simulated building
SPREAD = np.diag([0.01, 0.01, 0.005]) ** 2  # m^2, rad^2, of the motion between scans there


class Step(NamedTuple):
    """A scan: its index, and the tracker's motion to it from a keyframe, -1 for none."""

    sweeps: Sweeps
    row: int
    anchor: int
    motion: Array
    covariance: Array


class Steps(Observer):
    """Stores all scans of a run and the tracker's motions, independent of the estimate."""

    def __init__(self) -> None:
        self.scans: list[Step] = []
        self.keys: list[int] = []  # of the keyframes, in `scans`
        self.known: Map | None = None

    def follow(self, track: Track, path: PathRows) -> None:
        rows = range(*track.rows.indices(1 << 40))
        for k, row in enumerate(rows):
            motion, spread = track.T_anchor_base[k], track.covariance[k]
            self.scans.append(Step(track.sweeps, row, track.anchor, motion, spread))

    def revise(self, keyframe: Keyframe, revision: Revision, path: PathRows) -> None:
        self.keys.append(len(self.scans))
        moved = keyframe.motion
        step = keyframe.sweeps, keyframe.row, keyframe.id - 1, moved.d_pose, moved.covariance
        self.scans.append(Step(*step))

    def finish(self, known: Map, outcome: Outcome) -> None:
        self.known = known

    def view(self, k: int) -> View:
        step = self.scans[k]
        scan = step.sweeps.scan(step.row)
        assert scan is not None
        return view(scan)

    def way(self, k: int) -> list[int]:
        """Return the scans of the path that ends with scan k: keyframes, the oldest first, and k."""
        found, left = [k], PATH_LENGTH
        while left > 0.0 and self.scans[found[-1]].anchor >= 0:
            left -= float(np.hypot(*self.scans[found[-1]].motion[:2]))
            found.append(self.keys[self.scans[found[-1]].anchor])
        return found[::-1]


class Try(NamedTuple):
    """Result of a search for one scan or path; `score` is that of the true pose, `area` in m^2."""

    log: str
    what: str
    place: str  # covered, outside or between
    score: float
    truth: Array
    answer: Answer
    milliseconds: float
    area: float

    @property
    def right(self) -> bool:
        if not self.answer.hypotheses:
            return False
        error = self.answer.hypotheses[0].pose - self.truth
        return bool(np.hypot(*error[:2]) < MAX_METRES and abs(wrap(float(error[2]))) < MAX_RADIANS)

    @property
    def silently_wrong(self) -> bool:
        return self.answer.verdict is Verdict.FOUND and not self.right


def part_of(keyframes: Keyframes, chosen: Mask) -> Keyframes:
    """Return some of the keyframes."""
    counts = np.diff(keyframes.starts)
    names = [f.name for f in fields(keyframes) if f.name not in {"starts", "points"}]
    starts = np.concatenate([[0], np.cumsum(counts[chosen])])
    points = keyframes.points[np.repeat(chosen, counts)]
    rows = {name: getattr(keyframes, name)[chosen] for name in names}
    return replace(keyframes, **rows, starts=starts, points=points)


def parts(seen: Steps) -> Iterator[tuple[str, Mask, Ints]]:
    """Yield how the log is divided, keyframes for a map, and scans to search in it."""
    assert seen.known is not None
    poses, keys = seen.known.rows().poses, np.array(seen.keys)
    n = len(poses)
    seconds = np.arange(n) / n * np.ptp(seen.known.stamps)  # stamps may run backwards
    left = poses[:, 0] < np.median(poses[keys, 0])
    for how, mapped in (("minutes", seconds // BLOCK % 2 == 0), ("halves", left)):
        yield how, mapped[keys], np.flatnonzero(~mapped)


def place_of(
    relocaliser: Relocaliser, places: Array, sought: View, truth: Array
) -> tuple[str, float]:
    """Return whether a map of scans at poses (k, 3) covers the view from a pose, and its score there."""
    told = explain(relocaliser.search_map, query([sought], np.zeros((1, 3))).beams, truth)
    apart = np.hypot(*(places[:, :2] - truth[:2]).T).min()
    if told.unknown <= COVERED and apart < COVERED_RADIUS:
        return "covered", told.score
    return "outside" if told.unknown > OUTSIDE else "between", told.score


def timed(find: Callable[[], Answer]) -> tuple[Answer, float]:
    """Return an answer and its CPU time, ms."""
    begin = time.process_time()
    answer = find()
    return answer, 1e3 * (time.process_time() - begin)


def way_before(relocaliser: Relocaliser, seen: Steps, k: int) -> DriveRelocaliser:
    """Return a relocaliser with the path that ends with scan k."""
    finder = DriveRelocaliser(relocaliser)
    for j in seen.way(k):
        finder.remember(seen.view(j), seen.scans[j].motion, seen.scans[j].covariance)
    return finder


def recorded(log: Path, count: int, seed: int) -> Iterator[Try]:
    """Yield the results for scans and paths of a log, `count` each."""
    seen = Steps()
    config, source = open_log(log, None, PLAIN)
    map_log(config, source, [seen])
    assert seen.known is not None
    poses, rng = seen.known.rows().poses, np.random.default_rng(seed)
    for how, mapped, others in parts(seen):
        name = f"{log.stem}, {how}"
        chosen = part_of(seen.known.keyframes, mapped)
        relocaliser = Relocaliser(chosen)
        area = relocaliser.search_map.area
        relocaliser.find(seen.view(int(others[0])))  # compiles
        for k in rng.choice(others, count // 2, replace=False).tolist():
            truth, sought = poses[k], seen.view(k)
            place = place_of(relocaliser, chosen.poses, sought, truth)
            answer = timed(partial(relocaliser.find, sought))
            yield Try(name, "scan", *place, truth, *answer, area)
            answer = timed(way_before(relocaliser, seen, k).find)
            yield Try(name, "2 m", *place, truth, *answer, area)


def simulated(count: int, seed: int) -> Iterator[Try]:
    """Yield the results for scans in buildings with twins, `QUERIES` in each building.

    As many scans, and drives, of the upper half are searched in a map of the lower half.
    """
    rng = np.random.default_rng(seed)
    for building in islice(buildings(seed), -(-count // QUERIES)):
        chosen = building.map(rng)
        relocaliser = Relocaliser(chosen)
        relocaliser.find(building.view(chosen.poses[0], rng))  # compiles
        for truth in building.places(rng, QUERIES):
            scans = [building.view(truth, rng)]
            yield tried("simulated", relocaliser, chosen, truth, scans)
        middle = 0.5 * building.floors[:, 3].max()
        chosen = part_of(chosen, chosen.poses[:, 1] < middle)
        relocaliser = Relocaliser(chosen)
        for way in building.drives(rng, QUERIES, middle):
            scans = [building.view(pose, rng) for pose in way]
            yield tried("simulated, half", relocaliser, chosen, way[-1], scans[-1:])
            yield tried("simulated, half", relocaliser, chosen, way[-1], scans)


def tried(
    name: str, relocaliser: Relocaliser, known: Keyframes, truth: Array, scans: list[View]
) -> Try:
    """Return the result for the scans of a straight drive, `DRIVE_STEP` apart, that ends at a pose (3,)."""
    finder = DriveRelocaliser(relocaliser)
    for sought in scans:
        finder.remember(sought, np.array([DRIVE_STEP, 0.0, 0.0]), SPREAD)
    what = "scan" if len(scans) == 1 else f"{PATH_LENGTH:g} m"
    place = place_of(relocaliser, known.poses, scans[-1], truth)
    return Try(name, what, *place, truth, *timed(finder.find), relocaliser.search_map.area)


def table(found: Sequence[Try]) -> str:
    """Return shares by log, kind of query and place, as a table."""
    lines = [
        "| log | of | place | tries | best is right | found | ambiguous | nowhere | silently wrong | "
        "CPU ms: median, worst | area |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for key in dict.fromkeys((t.log, t.what, t.place) for t in found):
        some = [t for t in found if (t.log, t.what, t.place) == key]
        n, ms = len(some), np.array([t.milliseconds for t in some])
        told = [f"{sum(t.answer.verdict is v for t in some) / n:.1%}" for v in Verdict]
        areas = np.array([t.area for t in some])
        lines.append(
            f"| {' | '.join(key)} | {n} | {sum(t.right for t in some) / n:.1%} | "
            f"{' | '.join(told)} | {sum(t.silently_wrong for t in some)} | "
            f"{np.median(ms):.0f}, {ms.max():.0f} | {areas.min():.0f} to {areas.max():.0f} m² |"
        )
    return "\n".join(lines)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    options.add_argument("logs", nargs="*", help="default: the three buildings")
    options.add_argument(
        "--data", type=Path, help="the folder of the logs; none are sought without"
    )
    options.add_argument("--tries", type=int, default=1000, help="scans, and ways, of each log")
    options.add_argument("--simulated", type=int, default=0, help="scans in simulated buildings")
    options.add_argument("--seed", type=int, default=0)
    given = options.parse_args()
    logs = [given.data / n / f"{n}.log" for n in given.logs or LOGS] if given.data else []
    sources = [recorded(log, given.tries, given.seed) for log in logs]
    found = list(chain(*sources, simulated(given.simulated, given.seed)))
    for t in filter(attrgetter("silently_wrong"), found):
        print(f"silently wrong: {t.log}, {t.what}, at {t.truth}: {t.answer.hypotheses[0]}")
    print(table(found))


if __name__ == "__main__":
    main()
