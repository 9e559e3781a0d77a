"""Time of the trackers per sweep, and how well their motion agrees with relations between poses.

    python benchmarks/tracking.py LOG [RELATIONS]      # a log with a 2D lidar; *.relations of it

The log is read and converted to sweeps first; then each tracker follows all of them in one process, after
a first batch that compiles. Times are CPU times. Relations are compared over at most 30 s: over longer
times, all trackers drift.
"""
# ruff: noqa: E402  threads are limited before numpy is imported

from __future__ import annotations

import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path

for _library in ("OPENBLAS", "MKL", "OMP"):  # one core
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")

import numpy as np

from impslam.columns import Motions, Sweeps
from impslam.component import build
from impslam.geometry.se2 import between, compose
from impslam.health import PUSHED, SLIPPED, STALLED
from impslam.open_log import open_log
from impslam.robot import Robot
from impslam.tracking.base import KeyframeGate, Tracker
from impslam.types import Array

KINDS = ("odometry", "scan_to_map")
SECONDS = 30.0
AGAINST = (SLIPPED, PUSHED, STALLED)
Sensed = list[tuple[Motions, Sweeps]]


def main(log: str, relations: str = "") -> None:
    """Print a line for each tracker."""
    sensed = sense(log)
    sweeps = sum(len(s) for _, s in sensed)
    print(f"{sweeps} sweeps in {len(sensed)} batches")
    for kind in KINDS:
        follow(kind, sensed[:1])
        stamps, poses, contradicted, seconds = follow(kind, sensed)
        line = f"{kind:11} {1e6 * seconds / sweeps:7.1f} us a sweep, {contradicted} contradicted"
        if relations:
            metres, radians = errors(stamps, poses, np.loadtxt(Path(relations)))
            line += (
                f"; off by {metres.mean():.4f} m (median {np.median(metres):.4f}), "
                f"{np.degrees(radians.mean()):.3f} deg (median {np.degrees(np.median(radians)):.3f})"
            )
        print(line)


def sense(log: str) -> Sensed:
    """Return all sweeps of a log with the motions to them."""
    config, source = open_log(log, None, ())
    robot: Robot = config.make_robot()
    with source:
        found = [pair for batch in robot.streams.read(source) for pair in robot.sense(batch)]
    return [*found, *robot.flush()]


def follow(kind: str, sensed: Sensed) -> tuple[Array, Array, int, float]:
    """Return stamps (n,), poses (n, 3) by tracking only, the number of contradicted ones, and CPU s."""
    tracker: Tracker = build("tracker", {"kind": kind})
    tracker.start(np.zeros(3), KeyframeGate())
    begin = time.process_time()
    tracks = [track for pair in sensed for track in tracker.follow(*pair)]
    seconds = time.process_time() - begin
    pose, stamps, poses, contradicted = np.zeros(3), [], [], 0
    for track in tracks:
        contradicted += sum(reason in AGAINST for reason in track.reasons.tolist())
        for stamp, T in zip(track.stamps, track.T_anchor_base, strict=True):
            stamps.append(stamp)
            poses.append(compose(pose, T))
        if track.keyframe is not None:
            pose = compose(pose, track.keyframe.motion.d_pose)
            stamps.append(track.keyframe.stamp)
            poses.append(compose(pose, track.keyframe.T_keyframe_stamp))
            contradicted += track.keyframe.reason in AGAINST
    return np.array(stamps), np.array(poses), contradicted, seconds


def errors(stamps: Array, poses: Array, relations: Array) -> tuple[Array, Array]:
    """Return m and rad between relations (r, >= 8: stamps, x, y, ..., yaw) and the poses."""
    near = np.abs(relations[:, 1] - relations[:, 0]) < SECONDS
    order = np.argsort(stamps, kind="stable")
    first, second = (
        poses[order[np.clip(np.searchsorted(stamps[order], t - 1e-4), 0, len(order) - 1)]]
        for t in relations[near, :2].T
    )
    off = between(relations[near][:, [2, 3, 7]], between(first, second))
    return np.hypot(off[:, 0], off[:, 1]), np.abs(off[:, 2])


if __name__ == "__main__":
    arguments: Sequence[str] = sys.argv[1:]
    main(*arguments)
