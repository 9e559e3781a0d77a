"""EKF SLAM at a cost that hardly grows with the map: conditionally independent submaps in a junction tree.

A robot sees only a few landmarks at a time. Only those of one square area are in the active Gaussian, on
which predictions and corrections work as in `ekf`. When the robot leaves the area, a copy of its pose is
kept as an additional variable, which both areas have in common (Pinies & Tardos 2008). The rest of the map
is updated through the common variables of areas when needed: see `junction_tree` and `clique`. Means and
covariances are those of `ekf`, with two exceptions. An inactive wall receives its steps later and as a sum,
which is the same to first order. And common errors of a sensor's readings are independent at each scan,
because considering a state (Schmidt) is not conditioning.

The inactive part is linear: it stores the sum of the steps of a perturbation, not the state. A step costs
as much as one of `ekf` with the landmarks of one area. A change of areas costs products of matrices of the
size of the common variables, which grows with the border that is crossed. Every change adds three scalars,
so crossing a border a thousand times has a cost.

`riekf` has no such form: its corrections change the coordinates of every landmark by that landmark's own
step, which is not linear. `submaps_fej` is the consistent filter of this kind.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import ClassVar

import numpy as np
from pydantic import PrivateAttr

from impslam.association.base import Hypotheses
from impslam.component import parameter, register
from impslam.filters.archive import Archive, codes_of
from impslam.filters.base import Filter, Reach, everything
from impslam.filters.belief import POSE, GaussianBelief
from impslam.filters.clique import Clique
from impslam.filters.ekf import Ekf
from impslam.filters.junction_tree import JunctionTree, Node, parent
from impslam.landmarks.base import LandmarkModel
from impslam.types import NO_COVARIANCE, Array, Increment, Ints, Landmark, Observation

_NONE = np.empty(0, np.int64)
_BASE = np.zeros(POSE)
_MIDDLE = 0x15555555
"""Column and row of the first area: binary 0101..., so that it is not near a border of a high level."""
_HYSTERESIS = 1.1  # times half an area: maximum distance from its centre before a change of areas
_RANGE_MARGIN = 1.05  # times the maximum range seen: landmarks within are active


@register("submaps")
class SubmapEkf(Ekf):
    """The textbook EKF at a cost that hardly grows with the map."""

    follows: ClassVar[bool] = False
    considers_shared_errors: ClassVar[bool] = False
    area: float = parameter(
        20.0, "m", "side of the square areas; about twice the range of landmarks is good", gt=0
    )
    margin: float = parameter(
        2.0,
        "m",
        "landmarks within this distance of the area in view are compared with observations: more than the "
        "width of a gate, and than the drift before a loop closure",
        gt=0,
    )
    _archive: Archive = PrivateAttr()
    _tree: JunctionTree = PrivateAttr()
    _origin: Array = PrivateAttr()
    _areas: dict[Node, int] = PrivateAttr()
    _node: Node = PrivateAttr()
    _range: float = PrivateAttr()
    """Radius around the robot within which landmarks are active, m."""
    _codes: Ints = PrivateAttr()
    """Codes (n - 3,) of the scalars of the belief after the pose; see `Clique`."""
    _shift: Array = PrivateAttr()
    """Sum of their steps (n - 3,)."""
    _cuts: int = PrivateAttr()
    _motion: Increment = PrivateAttr()

    def start(self, pose: Array, covariance: Array, models: Mapping[str, LandmarkModel]) -> None:
        """Start with a new state; see `Filter.start`."""
        super().start(pose, covariance, models)
        self._archive, self._tree = Archive(models), JunctionTree()
        self._origin, self._node = np.array(pose[:2]), (0, _MIDDLE, _MIDDLE)
        self._areas, self._range, self._cuts = {self._node: 0}, 0.0, 0
        self._codes, self._shift = np.empty(0, np.int64), np.empty(0)

    def resembles(self, other: Filter, share: float) -> bool:
        """Return False, because inactive landmarks are not up to date."""
        del other, share
        return False

    def predict(self, increment: Increment) -> None:
        """Predict the pose, after a change of areas if the robot is in another one."""
        offset = np.abs(self.pose[:2] - self._centre(self._node))
        if offset.max() > 0.5 * _HYSTERESIS * self.area:
            self._change_area(self._area_of(self.pose[:2]))
        self._motion = increment
        super().predict(increment)

    def hypothesise(
        self, observations: Sequence[Observation], reach: Reach = everything
    ) -> list[Hypotheses]:
        """Score the pairings with landmarks nearby, and with those of the observations' labels.

        Landmarks farther than `margin` from the area in view are left out, for any `reach`.
        """
        missing = self._missing(observations)
        if len(missing):
            self.undo_predict()
            self._change_area(self._node, missing)
            super().predict(self._motion)
        return super().hypothesise(observations, reach)

    def extend(self, observations: Sequence[Observation], stamp: float) -> tuple[int, ...]:
        """Add landmarks; see `Ekf.extend`."""
        if not observations:
            return ()
        own = [o if o.shared is None else replace(o, shared=None) for o in observations]
        ids = super().extend(own, stamp)
        self._archive.add(ids, [o.kind for o in own], self._areas[self._node])
        dims = [self._atlas.table(o.kind).model.dim for o in own]
        new = [codes_of(np.array([i]), dim)[0] for i, dim in zip(ids, dims, strict=True)]
        self._codes = np.concatenate([self._codes, *new])
        self._shift = np.concatenate([self._shift, np.zeros(sum(dims))])
        return ids

    def remove(self, ids: Sequence[int]) -> None:
        """Remove landmarks, but not their variables that other areas have in common."""
        if not ids:
            return
        self._archive.kinds[list(ids)] = -1
        shared = set((self._shared() >> 2).tolist())
        own = self._atlas.remove([i for i in ids if i not in shared], self._belief.n)
        self._atlas.forget([i for i in ids if i in shared])
        self._keep(own)

    def landmarks(self) -> tuple[Landmark, ...]:
        """Return all landmarks as `types.Landmark`; no estimate changes."""
        self._store()
        archive = self._archive
        shift, blocks = np.zeros_like(archive.shift), dict[int, Array]()
        for node, known in self._tree.complete(self._node, self._clique()):
            if node in self._areas:
                for kind, ids in archive.of_area(self._areas[node]):
                    at = known.places(codes_of(ids, archive.model(kind).dim))
                    shift[ids, : at.shape[1]] = known.mean[at]
                    blocks |= zip(ids.tolist(), known.P[at[:, :, None], at[:, None]], strict=True)
        return archive.report(self._atlas, shift, blocks)

    def landmark_covariance(self) -> Array:
        """Return none, (0, 0): landmarks of different areas have no joint covariance here."""
        return NO_COVARIANCE

    @property
    def state_size(self) -> int:
        """Number of estimated scalars."""
        return POSE + self._archive.size

    def _keep(self, remaining: Ints) -> None:
        """Keep only these entries of the belief (sorted)."""
        self._belief.keep(remaining)
        inner = remaining[POSE:] - POSE
        self._codes, self._shift = self._codes[inner], self._shift[inner]

    def _missing(self, observations: Sequence[Observation]) -> Ints:
        """Return the ids of inactive landmarks that observations may show."""
        found = _NONE
        for kind, seen in self._atlas.columns(observations).kinds.items():
            table = self._atlas.table(kind)
            if table.model.unique:
                continue
            ahead = table.model.invert(_BASE, seen.z)[..., :2]
            far = float(np.square(ahead).sum(-1).max())
            if table.model.has_extent:
                far = max(far, float(np.square(seen.ends).sum(-1).max()))
            if far > self._range**2:
                self._range = _RANGE_MARGIN * float(np.sqrt(far))
                found = np.union1d(found, self._nearby(self._node))
            labels = {observations[i].label for i in seen.indices.tolist()} - {None}
            if labels and not labels <= set(table.labels.tolist()):
                found = np.union1d(found, self._archive.labelled(kind, list(labels)))
        return np.setdiff1d(found, self._codes >> 2) if len(found) else found

    def _nearby(self, node: Node) -> Ints:
        """Return the ids of landmarks that may be seen from an area."""
        half, distance = 0.5 * _HYSTERESIS * self.area, self._range + self.margin
        return self._archive.near(self._centre(node), half, distance)

    def _area_of(self, place: Array) -> Node:
        i, j = np.rint((place - self._origin) / self.area).astype(int).tolist()
        return 0, _MIDDLE + i, _MIDDLE + j

    def _centre(self, node: Node) -> Array:
        return self._origin + self.area * (np.array(node[1:]) - _MIDDLE)

    def _shared(self) -> Ints:
        """Return the codes that other areas have in common with this one."""
        return np.intersect1d(self._codes, self._tree[parent(self._node)].codes)

    def _clique(self) -> Clique:
        """Return the joint of all active variables except the pose."""
        return Clique(self._codes, self._shift, self._belief.covariance[POSE:, POSE:])

    def _store(self) -> None:
        """Store the active landmarks in the archive."""
        for table in self._atlas.tables():
            mean = self._belief.mean
            self._archive.put(table, table.states(mean), self._shift[table.columns - POSE])

    def _change_area(self, node: Node, also: Ints | None = None) -> None:
        """Change areas: keep a copy of the pose, and activate landmarks that may be seen from there."""
        self._store()
        tree, archive = self._tree, self._archive
        self._cuts += 1
        cut = codes_of(np.array([-self._cuts]), POSE)[0]
        gone = self._codes < 0  # copies of the pose
        gone[~gone] = archive.kinds[self._codes[~gone] >> 2] < 0
        keep = ~gone | np.isin(self._codes, self._shared())
        codes = np.concatenate([cut, self._codes])
        here = Clique(codes, np.concatenate([np.zeros(POSE), self._shift]), self._belief.covariance)
        tree.cliques[self._node] = here.marginal(np.concatenate([cut, self._codes[keep]]))
        self._node, nodes = node, tree.propagate_along(self._node, node, cut)
        self._areas.setdefault(node, len(self._areas))
        for updated in [*nodes, *tree.propagate(nodes, 0.25 * self.margin)]:
            if updated in self._areas:
                self._update_places(updated)
        wanted = self._nearby(node) if also is None else also
        self._fetch(wanted)
        self._load()

    def _update_places(self, node: Node) -> None:
        """Update the positions of the landmarks of an area from its clique."""
        clique, archive = self._tree[node], self._archive
        for kind, ids in archive.of_area(self._areas[node]):
            at = clique.places(codes_of(ids, archive.model(kind).dim))
            archive.places[ids] = archive.states(ids, kind, clique.mean[at])[:, :2]

    def _fetch(self, ids: Ints) -> None:
        """Add landmarks of other areas to this one."""
        homes, areas = self._archive.homes[ids], list(self._areas)
        wanted = {areas[k]: self._scalars(ids[homes == k]) for k in np.unique(homes).tolist()}
        wanted.pop(self._node, None)
        self._tree.fetch(self._node, wanted)

    def _scalars(self, ids: Ints) -> Ints:
        """Return the codes (k,) of all scalars of landmarks."""
        archive = self._archive
        parts = [codes_of(s, archive.model(kind).dim).ravel() for kind, s in archive.by_kind(ids)]
        return np.concatenate(parts)

    def _load(self) -> None:
        """Activate the variables of this area; the pose is the newest copy."""
        clique, archive, pose = self._tree[self._node], self._archive, self.pose
        self._codes, self._shift = clique.codes, clique.mean.copy()
        cut = clique.places(codes_of(np.array([-self._cuts]), POSE)[0])
        at = np.concatenate([cut, np.arange(len(clique.codes))])
        self._belief = GaussianBelief.of(np.zeros(len(at)), clique.P.take(at, 0).take(at, 1))
        self._belief.mean[:POSE] = pose
        self._atlas.clear()
        ids = np.unique(clique.codes[clique.codes >= 0] >> 2)
        for kind, some in archive.by_kind(ids):
            places = clique.places(codes_of(some, archive.model(kind).dim))
            table = archive.take(self._atlas, kind, some, POSE + places[:, 0])
            self._belief.mean[table.columns] = archive.states(some, kind, clique.mean[places])

    def _retract(self, step: Array) -> None:
        """Move the mean, and add the step to the shift."""
        super()._retract(step)
        self._shift += step[POSE : self._belief.n]
