"""EKF SLAM at a cost that hardly grows with the map: conditionally independent submaps in a junction tree.

A robot sees a few landmarks at a time. Only those, of one square area, are in the Gaussian that predictions
and corrections work on, which is that of `ekf` in full. When the robot leaves the area, its pose at that
moment is kept as one more variable, which both areas have in common (Pinies & Tardos 2008). The rest of the
map is updated through what areas have in common when it is needed: see `junction_tree` and `clique`.
Nothing is approximated: means and covariances are those of `ekf`, but for two things. A wall that is not
handled takes its steps later and in one piece, the same to first order. And errors that the readings of a
sensor share are taken for new at each scan: to consider a state (Schmidt) is no conditioning.

What is kept of the rest is linear: the sum of the steps that a perturbation has made, not the state. A step
costs as much as one of `ekf` with the landmarks of one area. To change areas costs products of matrices as
large as what the areas on both sides have in common, which grows with the border that is crossed. Every
change leaves three scalars: a robot that crosses a border a thousand times pays for it.

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
from impslam.types import Array, Increment, Ints, Landmark, Observation

_NONE = np.empty(0, np.int64)
_BASE = np.zeros(POSE)
_MIDDLE = 0x15555555
"""Column and row of the first area: in binary 0101..., so that no border of high level is near it."""
_BEYOND = 1.1  # times half an area: so far from its centre the robot may be in it, lest it goes to and fro
_SPARE = 1.05  # times what was seen farthest: landmarks within are held ready


@register("submaps")
class SubmapEkf(Ekf):
    """The textbook EKF at a cost that hardly grows with the map."""

    follows: ClassVar[bool] = False
    considers_shared_errors: ClassVar[bool] = False
    area: float = parameter(
        20.0, "m", "side of the squares; good is about twice as far as landmarks are seen", gt=0
    )
    margin: float = parameter(
        2.0,
        "m",
        "a landmark is compared with observations if it is thought to lie this near the area that is "
        "seen: more than a gate is wide, and than odometry drifts before a loop closes",
        gt=0,
    )
    _archive: Archive = PrivateAttr()
    _tree: JunctionTree = PrivateAttr()
    _origin: Array = PrivateAttr()
    _areas: dict[Node, int] = PrivateAttr()
    _node: Node = PrivateAttr()
    _reach: float = PrivateAttr()
    """How far around the robot landmarks are held ready, m."""
    _codes: Ints = PrivateAttr()
    """By what the scalars of the belief after the pose are known (n - 3,); see `Clique`."""
    _shift: Array = PrivateAttr()
    """Sum of their steps (n - 3,)."""
    _cuts: int = PrivateAttr()
    _motion: Increment = PrivateAttr()

    def start(self, pose: Array, covariance: Array, models: Mapping[str, LandmarkModel]) -> None:
        """Begin anew; see `Filter.start`."""
        super().start(pose, covariance, models)
        self._archive, self._tree = Archive(models), JunctionTree()
        self._origin, self._node = np.array(pose[:2]), (0, _MIDDLE, _MIDDLE)
        self._areas, self._reach, self._cuts = {self._node: 0}, 0.0, 0
        self._codes, self._shift = np.empty(0, np.int64), np.empty(0)

    def resembles(self, other: Filter, share: float) -> bool:
        """Say no: what is not handled is not known yet."""
        del other, share
        return False

    def predict(self, increment: Increment) -> None:
        """Move the robot, after a change of areas if it stands in another one."""
        apart = np.abs(self.pose[:2] - self._centre(self._node))
        if apart.max() > 0.5 * _BEYOND * self.area:
            self._enter(self._area_of(self.pose[:2]))
        self._motion = increment
        super().predict(increment)

    def hypothesise(
        self, observations: Sequence[Observation], reach: Reach = everything
    ) -> list[Hypotheses]:
        """Score the pairings with landmarks nearby, and with those of the observations' labels.

        Others are left out, whatever the reach: those farther than `margin` from all that may be seen.
        """
        missing = self._missing(observations)
        if len(missing):
            self.undo_predict()
            self._enter(self._node, missing)
            super().predict(self._motion)
        return super().hypothesise(observations, reach)

    def extend(self, observations: Sequence[Observation], stamp: float) -> tuple[int, ...]:
        """Add landmarks; see `Ekf.extend`."""
        if not observations:
            return ()
        own = [o if o.shared is None else replace(o, shared=None) for o in observations]
        ids = super().extend(own, stamp)
        self._archive.enter(ids, [o.kind for o in own], self._areas[self._node])
        dims = [self._atlas.table(o.kind).model.dim for o in own]
        new = [codes_of(np.array([i]), dim)[0] for i, dim in zip(ids, dims, strict=True)]
        self._codes = np.concatenate([self._codes, *new])
        self._shift = np.concatenate([self._shift, np.zeros(sum(dims))])
        return ids

    def remove(self, ids: Sequence[int]) -> None:
        """Forget landmarks; what other areas have in common through them stays."""
        if not ids:
            return
        self._archive.kinds[list(ids)] = -1
        shared = set((self._shared() >> 2).tolist())
        own = self._atlas.remove([i for i in ids if i not in shared], self._belief.n)
        self._atlas.forget([i for i in ids if i in shared])
        self._keep(own)

    def landmarks(self) -> tuple[Landmark, ...]:
        """Return the whole map in the form users read; no estimate is changed."""
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

    @property
    def state_size(self) -> int:
        """Number of scalars that are estimated."""
        return POSE + self._archive.size

    def _keep(self, stays: Ints) -> None:
        """Keep these entries of the belief (sorted), forget the others."""
        self._belief.keep(stays)
        inner = stays[POSE:] - POSE
        self._codes, self._shift = self._codes[inner], self._shift[inner]

    def _missing(self, observations: Sequence[Observation]) -> Ints:
        """Return the ids of landmarks that observations may show and that are not handled."""
        found = _NONE
        for kind, seen in self._atlas.columns(observations).kinds.items():
            table = self._atlas.table(kind)
            if table.model.unique:
                continue
            ahead = table.model.invert(_BASE, seen.z)[..., :2]
            far = float(np.square(ahead).sum(-1).max())
            if table.model.has_extent:
                far = max(far, float(np.square(seen.ends).sum(-1).max()))
            if far > self._reach**2:
                self._reach = _SPARE * float(np.sqrt(far))
                found = np.union1d(found, self._nearby(self._node))
            labels = {observations[i].label for i in seen.indices.tolist()} - {None}
            if labels and not labels <= set(table.labels.tolist()):
                found = np.union1d(found, self._archive.labelled(kind, list(labels)))
        return np.setdiff1d(found, self._codes >> 2) if len(found) else found

    def _nearby(self, node: Node) -> Ints:
        """Return the ids of landmarks that may be seen from an area."""
        half, reach = 0.5 * _BEYOND * self.area, self._reach + self.margin
        return self._archive.near(self._centre(node), half, reach)

    def _area_of(self, place: Array) -> Node:
        i, j = np.rint((place - self._origin) / self.area).astype(int).tolist()
        return 0, _MIDDLE + i, _MIDDLE + j

    def _centre(self, node: Node) -> Array:
        return self._origin + self.area * (np.array(node[1:]) - _MIDDLE)

    def _shared(self) -> Ints:
        """Return the codes that other areas have in common with this one."""
        return np.intersect1d(self._codes, self._tree[parent(self._node)].codes)

    def _clique(self) -> Clique:
        """Return what is known of all that is handled but the pose."""
        return Clique(self._codes, self._shift, self._belief.covariance[POSE:, POSE:])

    def _store(self) -> None:
        """Keep what tables hold."""
        for table in self._atlas.tables():
            mean = self._belief.mean
            self._archive.put(table, table.states(mean), self._shift[table.columns - POSE])

    def _enter(self, node: Node, also: Ints | None = None) -> None:
        """Change areas: leave a copy of the pose behind, and handle what may be seen from this one."""
        self._store()
        tree, archive = self._tree, self._archive
        self._cuts += 1
        cut = codes_of(np.array([-self._cuts]), POSE)[0]
        gone = (self._codes < 0) | (archive.kinds[self._codes >> 2] < 0)
        keep = ~gone | np.isin(self._codes, self._shared())
        codes = np.concatenate([cut, self._codes])
        here = Clique(codes, np.concatenate([np.zeros(POSE), self._shift]), self._belief.covariance)
        tree.cliques[self._node] = here.marginal(np.concatenate([cut, self._codes[keep]]))
        self._node, nodes = node, tree.walk(self._node, node, cut)
        self._areas.setdefault(node, len(self._areas))
        for told in [*nodes, *tree.spread(nodes, 0.25 * self.margin)]:
            if told in self._areas:
                self._update_places(told)
        wanted = self._nearby(node) if also is None else also
        self._fetch(wanted)
        self._load()

    def _update_places(self, node: Node) -> None:
        """Find out where the landmarks of an area are, as far as it has been told."""
        clique, archive = self._tree[node], self._archive
        for kind, ids in archive.of_area(self._areas[node]):
            at = clique.places(codes_of(ids, archive.model(kind).dim))
            archive.places[ids] = archive.states(ids, kind, clique.mean[at])[:, :2]

    def _fetch(self, ids: Ints) -> None:
        """Bring landmarks of other areas into this one."""
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
        """Handle the variables of this area; the pose is where the newest copy of it is."""
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
        """Move the mean, and remember by how much."""
        super()._retract(step)
        self._shift += step[POSE : self._belief.n]
