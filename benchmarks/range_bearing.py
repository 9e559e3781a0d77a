"""Logs of detected landmarks against the truth: MRPT's simulation, and MRCLAM's five robots.

    python benchmarks/range_bearing.py --data ../shared/data kf-demo mrclam6
    python benchmarks/range_bearing.py --data FOLDER --filters ekf,fej,riekf mrclam6 mrclam7

One row for each robot, filter and association. Path and map are fitted together to the truth by the path.
A landmark is compared with the true one of the most frequent label of its observations, so that confused
neighbours do not count as found, or, without labelled matches, with the nearest one; observations with
other labels are wrong associations. With associations other than `known` the program does not use labels.
"""

from __future__ import annotations

import argparse
import itertools
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.real_logs import Run  # noqa: E402  found from the root of the project

from impslam.evaluation.label_votes import LabelVotes  # noqa: E402
from impslam.evaluation.run_files import RecordedRun  # noqa: E402
from impslam.evaluation.scores import Consistency, score_path  # noqa: E402
from impslam.evaluation.trajectory import align, associate, ate  # noqa: E402
from impslam.geometry.se2 import transform  # noqa: E402
from impslam.map import Keyframe, PathRows, Revision  # noqa: E402
from impslam.open_log import open_log  # noqa: E402
from impslam.run import map_log  # noqa: E402
from impslam.types import Array, Landmark, TrueLandmark, TruePose  # noqa: E402

GATE = 0.5
"""m: an estimate further from its true landmark is false."""
SIMULATED = "kf-demo"
CLUSTERS = "association.new_gate=0.9"
"""MRCLAM's barcodes are in groups of two or three, 18 cm apart: one beside a matched one is another."""


@dataclass
class Labelled(Run):
    """A run, the true path, and the labels of the observations of each landmark."""

    truth_path: list[Array] = field(default_factory=list)
    labels: LabelVotes = field(default_factory=LabelVotes)

    def revise(self, keyframe: Keyframe, revision: Revision, path: PathRows) -> None:
        """Count labels."""
        super().revise(keyframe, revision, path)
        self.labels.revise(keyframe, revision, path)

    def truth(self, pose: TruePose) -> None:
        """Keep a true pose."""
        self.truth_path.append(np.array([pose.stamp, *pose.pose]))


@dataclass(frozen=True)
class Row:
    """Results of one run; lengths in m. Without a true path its values are NaN and None."""

    path: float
    odometry: float
    consistency: Consistency | None
    marks: float
    found: int
    missing: int
    false: int
    doubles: int
    wrong: int
    matched: int
    observations: int

    def __str__(self) -> str:
        c = self.consistency
        nees = "-" if c is None else f"{c.mean:6.2f} ({100 * c.within:3.0f} %)"
        counts = f"{self.found:3d} {self.missing:3d} {self.false:3d} {self.doubles:3d}"
        used = f"{self.wrong:4d} {self.matched:5d} {self.observations:5d}"
        metres = f"{self.path:8.3f} {self.odometry:8.3f} {self.marks:8.3f}"
        return f"{metres}  {counts}  {used}  {nees}"


HEADER = (
    f"{'log':9} {'filter':6} {'association':12} {'path m':>8} {'odo m':>8} {'marks m':>8}  "
    "fnd mis fls dbl  wrng  used   all  NEES of 3 (in 95 %)"
)


def drive(log: Path, settings: Sequence[str] = ()) -> tuple[Labelled, list[TrueLandmark]]:
    """Map a log with the preset that fits it; return also the surveyed landmarks."""
    config, source = open_log(log, None, settings)
    seen = Labelled()
    map_log(config, source, [seen])
    return seen, source.true_landmarks()


def measure(
    data: Path, name: str, robot: int = 0, association: str = "known", settings: Sequence[str] = ()
) -> Row:
    """Map and score MRPT's simulation, or a robot of an MRCLAM data set."""
    chosen = [f"association.kind={association}"]
    if name == SIMULATED:
        return score(*drive(data / name / "kf-slam_demo.txt", [*chosen, *settings]))
    chosen += [CLUSTERS] if association != "known" else []
    return score(*drive(data / name, [f"source.robot={robot}", *chosen, *settings]))


def score(seen: Labelled, truth: Sequence[TrueLandmark]) -> Row:
    """Score a run."""
    path, odometry, consistency, T = math.nan, math.nan, None, None
    if seen.truth_path:
        true = np.array(seen.truth_path)
        assert seen.known is not None
        record = RecordedRun(seen.path, seen.known.rows().covariances)
        scored = score_path(record, true, "fit", 1.0)
        path, consistency, T = scored.aligned.rmse, scored.consistency, scored.T_truth_map
        odometry = ate(associate(seen.wheels, true)).rmse
    places = {mark.name: mark.position for mark in truth}
    best, doubles = _judged(seen, places, T)
    known = [(best[name].position, places[name]) for name in places if name in best]
    ours, theirs = (np.array(column) for column in zip(*known, strict=True))
    if T is None:
        T = align(ours, theirs)
    off = np.hypot(*(transform(T, ours) - theirs).T)
    found = off < GATE
    missing, false = len(places) - int(found.sum()), int((~found).sum())
    rms = math.sqrt(float(np.mean(off[found] ** 2))) if found.any() else math.nan
    counts = (int(found.sum()), missing, false + len(seen.landmarks) - len(best) - doubles, doubles)
    used = (seen.labels.wrong, seen.labels.matched, seen.labels.observations)
    return Row(path, odometry, consistency, rms, *counts, *used)


def _judged(
    seen: Labelled, places: Mapping[str, Array], T: Array | None
) -> tuple[dict[str, Landmark], int]:
    """Return the landmark most often observed with each label, and the number of others with a label.

    Where no label is known and T, `T_truth_map`, is, the nearest of the true places gives it.
    """
    named: list[tuple[Landmark, str]] = []
    for mark in seen.landmarks:
        label = seen.labels.label(mark)
        if label is not None:
            named.append((mark, str(label)))
        elif T is not None:
            here = transform(T, mark.position[None])[0]
            named.append((mark, min(places, key=lambda name: math.dist(here, places[name]))))
    best = {name: mark for mark, name in sorted(named, key=lambda pair: pair[0].observations)}
    return best, len(named) - len(best)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("logs", nargs="*", default=["kf-demo", "mrclam6"], help="folders")
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    parser.add_argument("--filters", default="riekf", help="default: riekf")
    parser.add_argument("--associations", default="known,mahalanobis,jcbb")
    parser.add_argument("--set", action="append", default=[], dest="settings", metavar="KEY=VALUE")
    arguments = parser.parse_args()
    print(HEADER)
    ways = [arguments.filters.split(","), arguments.associations.split(",")]
    for name in arguments.logs:
        robots = (0,) if name == SIMULATED else range(1, 6)
        for robot, kind, association in itertools.product(robots, *ways):
            settings = [f"filter.kind={kind}", *arguments.settings]
            row = measure(arguments.data, name, robot, association, settings)
            print(f"{name} {robot or ' '} {kind:6} {association:12} {row}", flush=True)


if __name__ == "__main__":
    main()
