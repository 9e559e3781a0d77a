"""Find beams that hit the robot's own body, and sectors without returns."""

from __future__ import annotations

import math

import numpy as np

from impslam.diagnosis.beam_samples import BeamSamples
from impslam.diagnosis.evidence import Evidence
from impslam.diagnosis.finding import MAX_PROBABILITY, Finding
from impslam.diagnosis.travel import SweepMotions, stretches
from impslam.types import Array, Ints

MIN_DEAD_SHARE = 0.02
"""Share of all beams that are adjacent and have no return in any scan."""
MAX_BODY_RANGE = 1.0
"""m: a robot's own body is closer."""
BODY_SPREAD = (0.02, 0.01)
"""m, and share of the range: deviation of a range to the body from its median."""
MIN_BODY_SHARE = 0.8
"""Share of scans in which a beam that hits the body has its median range; each heading counts equally."""
HEADING_WIDTH, MIN_HEADINGS = 0.4, 4
"""rad, and number of headings of this width in which scans are needed. A wall beside a robot that drives
straight also keeps its range, but only at one heading."""
MIN_TRAVEL = (2.0, 1.5)
"""m, rad of laser motion needed to attribute a constant range, or none, to the robot itself: a lidar that
stands sees the same things all the time, and open space in the same directions."""


def check_beams(e: Evidence) -> list[Finding]:
    """Find beams that hit the robot itself, and sectors without returns."""
    if e.samples is None or not _travels(e.sweep_motions):
        return []
    return [*_body(e, e.samples), *_dead(e, e.samples)]


def _travels(motion: SweepMotions) -> bool:
    """Return whether the laser moves far enough to tell the robot itself from its surroundings.

    Motions are summed over stretches, in which the errors of the matches of a standing lidar cancel.
    """
    begins, ends = stretches(motion)
    sums = np.cumsum(motion.twists, axis=0)
    twists = sums[ends] - sums[begins]
    distance, turn = np.hypot(*twists[:, :2].T).sum(), np.abs(twists[:, 2]).sum()
    return bool(distance >= MIN_TRAVEL[0] and turn >= MIN_TRAVEL[1])


def _body(e: Evidence, sample: BeamSamples) -> list[Finding]:
    hits, farthest = body_beams(sample)
    return [_own_body(e, sample, hits, farthest)] if len(hits) else []


def body_beams(sample: BeamSamples) -> tuple[Ints, float]:
    """Return the beams (k,) that hit the robot itself, and their largest range in m (0 without any)."""
    weights = _heading_weights(sample.headings)
    near = np.flatnonzero(sample.valid.mean(axis=0) >= MIN_BODY_SHARE)
    ranges = np.where(sample.valid[:, near], sample.ranges[:, near], np.nan)
    usual = np.nanmedian(ranges, axis=0) if len(near) else np.empty(0)
    steady = np.abs(ranges - usual) <= BODY_SPREAD[0] + BODY_SPREAD[1] * usual
    body = (usual < MAX_BODY_RANGE) & (weights @ steady >= MIN_BODY_SHARE)
    return near[body], float(usual[body].max(initial=0.0))


def _heading_weights(headings: Array) -> Array:
    """Return weights (m,) of scans with which each heading counts equally; all 0 if there are too few."""
    bins = np.floor(np.mod(headings, 2.0 * math.pi) / HEADING_WIDTH)
    _, which, counts = np.unique(bins, return_inverse=True, return_counts=True)
    if len(counts) < MIN_HEADINGS:
        return np.zeros(len(headings))
    return np.asarray(1.0 / (len(counts) * counts[which]))


def _dead(e: Evidence, sample: BeamSamples) -> list[Finding]:
    """Find sectors within the field of view in which no beam ever returns."""
    seen = np.flatnonzero(sample.valid.any(axis=0))
    gaps = np.diff(seen) - 1
    if not len(gaps) or gaps.max() < max(MIN_DEAD_SHARE * len(sample.angles), 2.0):
        return []
    k = int(np.argmax(gaps))
    if not e.lidar.in_field(sample.angles[seen[k] + 1 : seen[k + 1]]).any():
        return []
    first, last = np.degrees(sample.angles[[seen[k] + 1, seen[k + 1] - 1]])
    what = f"no beam between {first:.0f} and {last:.0f} deg ever returns: something covers the lidar there"
    return [Finding("dead sector", what, harmful=False, lidar=e.name)]


def _own_body(e: Evidence, sample: BeamSamples, hits: Ints, farthest: float) -> Finding:
    angles = np.degrees(sample.angles[hits])
    what = (
        f"{len(hits)} beams between {angles.min():.0f} and {angles.max():.0f} deg keep a range of up to "
        f"{farthest:.2f} m while the robot moves: they hit the robot itself"
    )
    limit = math.ceil(100.0 * (farthest + BODY_SPREAD[0] + BODY_SPREAD[1] * farthest)) / 100.0
    return Finding(
        "own body in view",
        what,
        (f"{e.lidar_key}.range_min={limit:.2f}",),
        MAX_PROBABILITY,
        lidar=e.name,
    )
