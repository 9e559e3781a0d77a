"""Recognises a place: finds the pose of one submap in another, and verifies it.

A small window is left to alignment, which seldom loses its way there. A wide one is searched (see
`correlative`), and the peak aligned. A pose is refused if free space contradicts it (see `verify`), and
if another pose in the window fits nearly as well and agrees nearly as much with free space.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.geometry.kernels import plain
from impslam.recognition.correlative import TURN, Window, deep_enough, search
from impslam.recognition.pyramid import Memory, Pyramid, build
from impslam.recognition.submap import Submap
from impslam.recognition.verify import MIN_MATCHED, Support, Verdict, judge, verify
from impslam.surfaces.features import Features
from impslam.surfaces.surface_map import (
    Alignment,
    Evidence,
    SurfaceMap,
    add,
    align,
    clear,
    empty_surface_map,
    no_evidence,
)
from impslam.types import Array

ALIGNED = 0.4
"""m: alignment pairs points so far apart; in a wider window it may stop at a false pose."""
ALIGNED_TURN, ALIGNED_POINTS = math.pi / 4, 400  # rad; points that it uses, about
FEWEST = 60  # points of either submap: fewer fit anywhere
SEARCHED, SEARCH_REACH = 150, 11.0  # points to search with, and m: enough of them are so close
NARROW = 1.2  # m: a wider window holds more poses that fit by chance,
NARROW_SCORE, WIDE_SCORE = 0.4, 0.5  # so that more must speak for the best of them
AMBIGUOUS = 0.9  # of the best score: a second peak so high may be the true one,
MARGIN = 0.1  # unless free space agrees with it so much less: three sigma of a share of 250 points
MOST = 20.0  # points that a surfel averages over
SLACK = 0.4  # m that an alignment may move out of its window: how far it pairs points
RESIDUAL = 0.015  # m, of a point, at least: noise of a range, and cells of 5 cm
SHARED = 40.0
"""Points that share one error, for a submap's surfaces are bent as a whole.

Chosen on 2700 closures in two recorded buildings, of which 94 and 98 % then lie within their 90 % bounds.
In a hospital with ways outdoors only 81 % of pairs of closures agreed at the 99 % gate, for reasons
not known yet: weigh closures robustly.
"""
_FLOOR = np.array([0.01, 0.01, 0.002])  # m, m, rad: what no number of points brings down
_COARSE = Alignment(15, 0.4, 0.08, 1.0 / 0.05**2, 1, 9.0)
FINE = Alignment(15, 0.3, 0.08, 1.0 / 0.05**2, 1, 9.0)
_COARSE_PRIOR, FINE_PRIOR = np.array([4.0, 4.0, 100.0]), np.ones(3)  # 1/m^2, 1/m^2, 1/rad^2


class Closure(NamedTuple):
    """A place recognised.

    Attributes
    ----------
    pose : (3,) T_reference_query
    information : (3, 3) of an additive error on it
    support, verdict : what the two submaps say of it; a weak one needs others that agree
    score : of the search; NaN where alignment found the pose and nothing was searched
    rival : agreement of the best pose elsewhere; -inf if there is none with a score of
        `AMBIGUOUS` times the first one's, or none was sought
    """

    pose: Array
    information: Array
    support: Support
    verdict: Verdict
    score: float
    rival: float


class Search(NamedTuple):
    """What is sought: points, the step between headings in rad, and where."""

    points: Features
    turn: float
    window: Window


class Recogniser:
    """Finds queries in references; keeps the grids of the last reference, and their memory.

    `overlap` is the share of a query's points that have to lie on the reference at least; see `judge`.

    Attributes
    ----------
    counts : attempts, and what came of them
    """

    def __init__(self, overlap: float = MIN_MATCHED) -> None:
        self._overlap = overlap
        names = ("attempts", "too few points", "no peak", "ambiguous", "contradicted", "found")
        self.counts = dict.fromkeys(names, 0)
        self._memory, self._known = Memory(), empty_surface_map(40.0, 40.0, 20000)
        self._reference: Submap | None = None
        self._pyramid: Pyramid | None = None

    def close(
        self, reference: Submap, query: Submap, guess: Array, window: Window
    ) -> Closure | None:
        """Return where the query is in the reference, sought in a window around a guess (3,).

        The same reference given again, as an object, costs no new grids. Nothing is returned where
        there is no pose, or no single one; `counts` tells why.
        """
        self.counts["attempts"] += 1
        if min(len(reference.features), len(query.features)) < FEWEST:
            return self._refuse("too few points")
        self._load(reference)
        find = Search(*search_points(query.features), window)
        return self._aligned(query, plain(guess), find) or self._searched(query, plain(guess), find)

    def _aligned(self, query: Submap, guess: Array, find: Search) -> Closure | None:
        """Return what alignment from the guess finds, if nothing is to be said against it."""
        wide = max(find.window.x, find.window.y)
        if wide > ALIGNED or find.window.heading > ALIGNED_TURN:
            return None
        step = max(1, len(query.features) // ALIGNED_POINTS)
        closure = self._settle(query, guess, _COARSE._replace(step=step), _COARSE_PRIOR)
        shift = np.abs(closure.pose - guess)
        if shift[0] > find.window.x + SLACK or shift[1] > find.window.y + SLACK:
            return None
        if closure.verdict != Verdict.STRONG:
            return None
        return self._found(closure)

    def _searched(self, query: Submap, guess: Array, find: Search) -> Closure | None:
        """Return what a search finds and alignment settles."""
        pyramid = self._grid(find.window)
        least = NARROW_SCORE if max(find.window.x, find.window.y) <= NARROW else WIDE_SCORE
        least *= min(1.0, self._overlap / MIN_MATCHED)
        peak = search(pyramid, find.points, guess, find.window, least, turn=find.turn)
        if peak.score == 0.0:
            return self._refuse("no peak")
        closure = self._settle(query, peak.pose, FINE, FINE_PRIOR)._replace(score=peak.score)
        if closure.verdict == Verdict.REFUSED:
            return self._refuse("contradicted")
        closure = self._against_rivals(query, guess, find, closure)
        if closure.rival >= closure.support.agreement - MARGIN:
            return self._refuse("ambiguous")
        return self._found(closure)

    def _against_rivals(
        self, query: Submap, guess: Array, find: Search, closure: Closure
    ) -> Closure:
        """Return the closure with the agreement of the best pose elsewhere."""
        least = AMBIGUOUS * closure.score
        pyramid = self._grid(find.window)
        peak = search(pyramid, find.points, guess, find.window, least, closure.pose, find.turn)
        if peak.score == 0.0:
            return closure
        rival = self._settle(query, peak.pose, FINE, FINE_PRIOR)
        agreement = 0.0 if rival.verdict == Verdict.REFUSED else rival.support.agreement
        return closure._replace(rival=agreement)

    def _settle(self, query: Submap, start: Array, how: Alignment, prior: Array) -> Closure:
        """Align the query from a pose on, and judge."""
        assert self._reference is not None
        pose, evidence = start.copy(), no_evidence()
        align(self._known, query.features, pose, prior, how, evidence)
        support = verify(self._known, self._reference, query, pose)
        verdict = judge(support, self._overlap)
        return Closure(pose, information(evidence), support, verdict, math.nan, -math.inf)

    def _load(self, reference: Submap) -> None:
        """Make the surface map of a reference, unless it is there."""
        if reference is self._reference:
            return
        self._reference, self._pyramid = reference, None
        low = reference.features[:, :2].min(0).astype(float) - 1.0
        high = reference.features[:, :2].max(0).astype(float) + 1.0
        self._known = _cleared(self._known, low, high, len(reference.features))
        add(self._known, reference.features, np.zeros(3), MOST)

    def _grid(self, window: Window) -> Pyramid:
        """Return the pyramid of the reference, as deep as a search of this window wants it."""
        assert self._reference is not None
        level = deep_enough(window)
        if self._pyramid is None or len(self._pyramid.levels) != level + 1:
            self._pyramid = build(self._reference.features, level, self._memory)
        return self._pyramid

    def _refuse(self, why: str) -> Closure | None:
        self.counts[why] += 1
        return None

    def _found(self, closure: Closure) -> Closure:
        self.counts["found"] += 1
        return closure


def _cleared(known: SurfaceMap, low: Array, high: Array, surfels: int) -> SurfaceMap:
    """Return an empty map from corner to corner (2,), the one given if it is large enough."""
    extent = high - low
    height, width = known.nearest.shape
    have = np.array([width, height]) * 0.05
    if (extent > have).any() or surfels > len(known.surfels):
        x, y = np.ceil(np.maximum(extent, have) / 8.0) * 8.0
        known = empty_surface_map(x, y, max(surfels, len(known.surfels)))
    clear(known, low)
    return known


def search_points(features: Features) -> tuple[Features, float]:
    """Return the features to search with, and the step between headings in rad that suits them.

    Those far away fix the heading but ask for a finer step; they are left out where enough are close.
    """
    ranges = np.hypot(features[:, 0], features[:, 1])
    reach = SEARCH_REACH
    if np.count_nonzero(ranges < reach) < SEARCHED:
        reach = max(reach, float(np.sort(ranges)[min(SEARCHED, len(ranges)) - 1]))
    close = features[ranges <= reach]
    count = min(SEARCHED, len(close))
    return close[np.arange(count) * len(close) // count], TURN * SEARCH_REACH / reach


def information(evidence: Evidence) -> Array:
    """Return the information (3, 3) of an aligned pose.

    Its covariance is that of the points, C = sigma^2 H^-1 with sigma^2 from their residuals, and a floor
    F. (C + F)^-1 is formed as G - G (C^-1 + G)^-1 G with G = F^-1, for H has no inverse along a bare
    corridor.
    """
    squares, weights = evidence.sums[2:]
    sigma2 = SHARED * max(squares / max(weights, 1.0), RESIDUAL**2)
    G = np.diag(1.0 / _FLOOR**2)
    result = G - G @ np.linalg.inv(evidence.H / sigma2 + G) @ G
    return np.asarray(0.5 * (result + result.T))
