"""Landmarks of a building, each once, from the poses of all keyframes and what they saw.

A pure function of poses and observations: where a loop closure moves keyframes, it is called anew and
the landmarks follow. It places the sightings in map, groups them (`association`), takes out what later
scans saw through (`free_space`, `cells`), and fuses what remains (`fusion`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from impslam.building.association import associate
from impslam.building.cells import cell_places, cell_starts, covered, divide, stretches
from impslam.building.free_space import Profile, profile, seen_through
from impslam.building.fusion import Fused, fuse
from impslam.building.groups import Rules
from impslam.building.sightings import Placed, Sightings, SightingsLog, place
from impslam.errors import ConfigError
from impslam.landmarks.base import LandmarkModel
from impslam.maps.grid import PlacedScans
from impslam.types import Array, Ints, Landmark, Mask, Observation


class Criteria(NamedTuple):
    """What makes a landmark.

    Attributes
    ----------
    sightings : keyframes that must show it; 0.4 m apart, a walker is at one place for one of them
    sigma_place, sigma_heading : m and rad, largest standard deviations of keyframes of one place
        against each other: what scan matching keeps (1.3 cm and 0.2 deg against measured relations)
    relief : m, standard deviation of a wall's surface from its line: skirting and frames stand off by
        3 cm at most
    margin : m, a beam that ends so far behind a landmark has gone through it
    width : m, beams that pass a point within this must all go through
    gap : m, the longest stretch that nobody saw between two pieces of one line; doors are 0.8 to 1 m
    """

    sightings: int = 3
    sigma_place: float = 0.02
    sigma_heading: float = 0.005
    relief: float = 0.01
    margin: float = 0.3
    width: float = 0.1
    gap: float = 1.0


DEFAULT = Criteria()


def landmarks_of(
    poses: Array,
    covariances: Array,
    seen: SightingsLog | Sequence[Sequence[Observation]],
    models: Mapping[str, LandmarkModel],
    scans: PlacedScans | None = None,
    criteria: Criteria = DEFAULT,
) -> tuple[Landmark, ...]:
    """Return the landmarks that keyframes saw, by id.

    The id is the number of the first observation that shows the landmark, among all observations in
    the order of the keyframes: more keyframes do not change it.

    Parameters
    ----------
    poses, covariances : (k, 3) `T_map_base` of the keyframes and (k, 3, 3)
    seen : their observations; as `SightingsLog` those of earlier calls are not converted again
    models : by kind; points of dimension 2, and lines with a frame [x, y, phi] and an extent
    scans : the keyframes' scans, for what was seen through; None: nothing is taken out

    Raises
    ------
    ConfigError
        If there is no model for a kind, or one that is neither a point nor a line.
    """
    log = seen if isinstance(seen, SightingsLog) else _gathered(seen)
    free = None if scans is None else profile(scans._replace(poses=poses))
    found: list[Landmark] = []
    for kind in log.kinds():
        model = _checked(kind, models)
        sightings = log.columns(kind)
        most = np.array([criteria.sigma_place, criteria.sigma_heading, criteria.relief])
        placed = place(sightings, poses, covariances, most, model.has_extent)
        members = _members(placed, sightings, free, criteria, model.has_extent)
        if len(members.first):
            found += _reported(kind, model, members, sightings, log)
    return tuple(sorted(found, key=lambda landmark: landmark.id))


def _gathered(seen: Sequence[Sequence[Observation]]) -> SightingsLog:
    """Return observations as a log whose stamps are the keyframes' numbers."""
    log = SightingsLog()
    for k, observations in enumerate(seen):
        log.add(observations, float(k))
    return log


def _checked(kind: str, models: Mapping[str, LandmarkModel]) -> LandmarkModel:
    if kind not in models:
        raise ConfigError(f"no landmark model for observations of kind {kind!r}; register one")
    model = models[kind]
    if model.dim_z != 2 or model.dim != (3 if model.has_extent else 2):
        raise ConfigError(f"landmarks of kind {kind!r} are neither points nor lines")
    return model


class _Members(NamedTuple):
    """The landmarks of a kind: `rows` (n,) of sightings, `landmark` (n,) of each, `first` (L,)."""

    rows: Ints
    landmark: Ints
    first: Ints
    counts: Ints
    fused: Fused


def _members(
    placed: Placed, sightings: Sightings, free: Profile | None, criteria: Criteria, is_line: bool
) -> _Members:
    """Return the landmarks that remain of all sightings of a kind."""
    keyframes, labels = sightings.keyframes, sightings.labels
    extra = np.zeros_like(placed.relative)
    extra[:, 0] = criteria.sigma_place**2 / 2
    extra[:, 2] = criteria.sigma_heading**2 if is_line else criteria.sigma_place**2 / 2
    rules = Rules(is_line, criteria.gap, criteria.relief)
    group = associate(placed, keyframes, labels, extra, rules)
    members = _confirmed(placed, np.arange(len(group)), group, keyframes, criteria, is_line)
    if free is None or not len(members.first):
        return members
    at, (rows, index, _, _, fused) = _at(placed, members.rows), members
    starts = cell_starts(fused)
    places, normals = cell_places(fused, starts, is_line)
    through = seen_through(free, places, normals, starts, criteria.margin, criteria.width)
    is_free = (through > covered(at, index, fused, starts, is_line)).astype(np.int64)
    runs, begin = stretches(fused, starts, is_free)
    run = divide(at, index, fused, runs, begin, is_line)
    return _confirmed(at, rows, run, keyframes[rows], criteria, is_line)


def _at(placed: Placed, rows: Ints) -> Placed:
    return Placed(*(column[rows] for column in placed))


def _confirmed(
    placed: Placed, rows: Ints, group: Ints, keyframes: Ints, criteria: Criteria, is_line: bool
) -> _Members:
    """Return the groups (n,) that enough keyframes saw; -1 is none."""
    each = int(keyframes.max(initial=0)) + 1
    pairs = np.unique(group[group >= 0] * each + keyframes[group >= 0]) // each
    counts = np.bincount(pairs, minlength=int(group.max(initial=0)) + 1)
    keep: Mask = (group >= 0) & (counts[group] >= criteria.sightings)
    _, first, index = np.unique(group[keep], return_index=True, return_inverse=True)
    counts = counts[group[keep][first]]
    fused = fuse(_at(placed, np.flatnonzero(keep)), index, first, is_line)
    return _Members(rows[keep], index, first, counts, fused)


def _reported(
    kind: str,
    model: LandmarkModel,
    members: _Members,
    sightings: Sightings,
    log: SightingsLog,
) -> list[Landmark]:
    """Return the landmarks of a kind in the form users read."""
    rows, index, first, counts, fused = members
    states = fused.states[:, : model.dim]
    outlines = model.outline(states, fused.extents)
    order = np.argsort(index, kind="stable")
    last = order[np.cumsum(np.bincount(index)) - 1]
    stamps = np.array(log.stamps)
    means = _means(log.observations(kind), rows, index, len(first))
    out = []
    for g, state in enumerate(states):
        report = model.report(state)
        xx, xy, yy = fused.covariances[g]
        P = np.zeros((model.dim, model.dim))
        P[0, 0], P[0, -1], P[-1, 0], P[-1, -1] = xx, xy, xy, yy
        out.append(
            Landmark(
                int(sightings.numbers[rows[first[g]]]),
                kind,
                report.position,
                {**report.values, **means[g]},
                report.values_D_m @ P @ report.values_D_m.T,
                outlines[g] if model.has_extent else None,
                int(counts[g]),
                float(stamps[sightings.keyframes[rows[first[g]]]]),
                float(stamps[sightings.keyframes[rows[last[g]]]]),
            )
        )
    return out


def _means(
    observations: list[Observation], rows: Ints, index: Ints, count: int
) -> list[dict[str, float]]:
    """Return the mean of each landmark's attributes, but for "heading", which is in base_link."""
    sums: list[dict[str, list[float]]] = [{} for _ in range(count)]
    for row, g in zip(rows.tolist(), index.tolist(), strict=True):
        for name, value in observations[row].attributes.items():
            if name != "heading":
                sums[g].setdefault(name, []).append(value)
    return [{name: float(np.mean(v)) for name, v in values.items()} for values in sums]
