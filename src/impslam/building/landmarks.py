"""Landmarks from the poses and observations of all keyframes.

This is a pure function: it is called again after keyframes have moved, e.g. by a loop closure. It
transforms the sightings to map, groups them (`association`), removes parts that other scans see through
(`free_space`, `cells`), and fuses the rest (`fusion`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from impslam.building.association import associate
from impslam.building.cells import cell_centres, cell_starts, count_covering, divide, stretches
from impslam.building.free_space import Profile, profile, seen_through
from impslam.building.fusion import Fused, fuse
from impslam.building.groups import Rules
from impslam.building.sightings import PlacedSightings, Sightings, SightingsLog, transform_to_map
from impslam.errors import ConfigError
from impslam.geometry.kernels import plain
from impslam.landmarks.base import OF_THE_ROBOT, LandmarkModel
from impslam.maps.grid import PlacedScans
from impslam.types import Array, Ints, Landmark, Mask, Observation


class Criteria(NamedTuple):
    """Criteria for landmarks.

    Attributes
    ----------
    sightings : minimum number of keyframes; these are 0.4 m apart, so a person is at one place in only one
    sigma_place, sigma_heading : m and rad, maximum standard deviations between keyframes of one place:
        the accuracy of scan matching (1.3 cm and 0.2 deg against measured relations)
    relief : m, standard deviation of a wall's surface from its line: skirting and frames stand off by at
        most 3 cm
    margin : m, a beam that ends so far behind a landmark has passed through it
    width : m, all beams within this distance of a point must pass through
    gap : m, maximum unseen stretch between two pieces of one line; doors are 0.8 to 1 m
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
    """Return the landmarks of keyframes, sorted by id.

    The id is the number of the landmark's first observation among all observations in the order of the
    keyframes, so further keyframes do not change it.

    Parameters
    ----------
    poses, covariances : (k, 3) `T_map_base` of the keyframes and (k, 3, 3)
    seen : their observations; a `SightingsLog` caches conversions between calls. Those of unique kinds
        are left out
    models : by kind; points of dimension 2, and lines with a frame [x, y, phi] and an extent
    scans : the keyframes' scans, to find free space; None: nothing is removed

    Raises
    ------
    ConfigError
        If a kind has no model, or one that is neither a point nor a line.
    """
    log = seen if isinstance(seen, SightingsLog) else _log_of(seen)
    free = None if scans is None else profile(scans._replace(poses=poses))
    found: list[Landmark] = []
    for kind in log.kinds():
        model = _checked_model(kind, models)
        if model.unique:  # such as the frame of a GPS: no object in the world
            continue
        sightings = log.columns(kind)
        limits = np.array([criteria.sigma_place, criteria.sigma_heading, criteria.relief])
        placed = transform_to_map(
            sightings, plain(poses), plain(covariances), limits, model.has_extent
        )
        members = _members(placed, sightings, free, criteria, model.has_extent)
        if len(members.first):
            found += _reported(kind, model, members, sightings, log)
    return tuple(sorted(found, key=lambda landmark: landmark.id))


def _log_of(seen: Sequence[Sequence[Observation]]) -> SightingsLog:
    """Return observations as a log with the keyframe numbers as stamps."""
    log = SightingsLog()
    for k, observations in enumerate(seen):
        log.add(observations, float(k))
    return log


def _checked_model(kind: str, models: Mapping[str, LandmarkModel]) -> LandmarkModel:
    if kind not in models:
        raise ConfigError(f"no landmark model for observations of kind {kind!r}; register one")
    model = models[kind]
    if model.dim_z != 2 or (model.dim != (3 if model.has_extent else 2) and not model.unique):
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
    placed: PlacedSightings,
    sightings: Sightings,
    free: Profile | None,
    criteria: Criteria,
    is_line: bool,
) -> _Members:
    """Return the confirmed landmarks of all sightings of a kind."""
    keyframes, labels = sightings.keyframes, sightings.labels
    extra = np.zeros_like(placed.relative)
    extra[:, 0] = criteria.sigma_place**2 / 2
    extra[:, 2] = criteria.sigma_heading**2 if is_line else criteria.sigma_place**2 / 2
    rules = Rules(is_line, criteria.gap, criteria.relief)
    group = associate(placed, keyframes, labels, extra, rules)
    members = _confirmed(placed, np.arange(len(group)), group, keyframes, criteria, is_line)
    if free is None or not len(members.first):
        return members
    kept, (rows, index, _, _, fused) = _take(placed, members.rows), members
    starts = cell_starts(fused)
    centres, normals = cell_centres(fused, starts, is_line)
    through = seen_through(free, centres, normals, starts, criteria.margin, criteria.width)
    is_free = (through > count_covering(kept, index, fused, starts, is_line)).astype(np.int64)
    runs, begin = stretches(fused, starts, is_free)
    run = divide(kept, index, fused, runs, begin, is_line)
    return _confirmed(kept, rows, run, keyframes[rows], criteria, is_line)


def _take(placed: PlacedSightings, rows: Ints) -> PlacedSightings:
    return PlacedSightings(*(column[rows] for column in placed))


def _confirmed(
    placed: PlacedSightings,
    rows: Ints,
    group: Ints,
    keyframes: Ints,
    criteria: Criteria,
    is_line: bool,
) -> _Members:
    """Return the landmarks of groups (n,) with enough keyframes; -1 means no group."""
    each = int(keyframes.max(initial=0)) + 1
    pairs = np.unique(group[group >= 0] * each + keyframes[group >= 0]) // each
    counts = np.bincount(pairs, minlength=int(group.max(initial=0)) + 1)
    keep: Mask = (group >= 0) & (counts[group] >= criteria.sightings)
    _, first, index = np.unique(group[keep], return_index=True, return_inverse=True)
    counts = counts[group[keep][first]]
    fused = fuse(_take(placed, np.flatnonzero(keep)), index, first, is_line)
    return _Members(rows[keep], index, first, counts, fused)


def _reported(
    kind: str,
    model: LandmarkModel,
    members: _Members,
    sightings: Sightings,
    log: SightingsLog,
) -> list[Landmark]:
    """Return the landmarks of a kind as `types.Landmark`."""
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
    """Return the mean attributes of each landmark, except those that change as the robot turns."""
    sums: list[dict[str, list[float]]] = [{} for _ in range(count)]
    for row, g in zip(rows.tolist(), index.tolist(), strict=True):
        for name, value in observations[row].attributes.items():
            if name not in OF_THE_ROBOT:
                sums[g].setdefault(name, []).append(value)
    return [{name: float(np.mean(v)) for name, v in values.items()} for values in sums]
