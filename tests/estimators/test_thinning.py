"""Keyframes that add nothing are dropped, and nothing else is."""

import numpy as np
import pytest
from tests.estimators.drives import LAP, RING, begun, box, driven, keyframes, way
from tests.estimators.test_sessions import mapped
from tests.filters.worlds import MODELS
from tests.numeric import wrapped

from impslam.estimators.graph import Graph
from impslam.estimators.loop_closing import CONFIRMATION_DISTANCE
from impslam.geometry.se2 import between, compose
from impslam.map import Map

TRUTH = np.concatenate([way(*LAP)] + 2 * [way(*LAP)[1:]])
"""Three times round."""
LAPS = len(way(*LAP)) - 1
START = TRUTH[0]


def frames_of(plans, drift=(0.0, 0.0, 0.0)):
    """Return the keyframes of a lap through each of three plans."""
    parts = [slice(0, LAPS + 1), slice(LAPS + 1, 2 * LAPS + 1), slice(2 * LAPS + 1, None)]
    frames = []
    for part, plan in zip(parts, plans, strict=True):
        whole = keyframes(plan, TRUTH, drift, rng=np.random.default_rng(5))
        frames += whole[part]
    return frames


def round_thrice(plans, drift=(0.0, 0.0, 0.0)):
    """Drive a lap through each of three plans; return the estimator and its revisions."""
    made = begun(START)
    return made, driven(made, frames_of(plans, drift))


@pytest.fixture(scope="module")
def still():
    return round_thrice([RING] * 3, drift=(0.0, 0.0, 0.002))


def test_a_lap_driven_again_adds_nothing(still):
    made, _ = still
    keys, graph = made._keys, made._graph
    late = keys.distance > keys.distance[-1] - CONFIRMATION_DISTANCE
    again = (np.arange(len(keys)) > LAPS + 40) & ~late
    assert keys.is_kept[:LAPS].all()
    assert keys.is_kept[again].mean() < 0.1
    nodes = ~graph.is_folded
    per_lap = np.count_nonzero(keys.nodes <= LAPS)
    assert np.count_nonzero(nodes) < 1.6 * per_lap
    assert len(graph.edges.i) < 3 * per_lap


def test_dropped_keyframes_are_reported_once(still):
    made, revisions = still
    told = [k for revision in revisions for k in revision.dropped]
    assert len(set(told)) == len(told)
    np.testing.assert_array_equal(np.sort(told), np.flatnonzero(~made._keys.is_kept))
    assert all(made._keys.views[k] is None for k in told)


def test_dropped_keyframes_are_where_they_were(still):
    made, _ = still
    refined = made.refine()
    assert refined is not None
    poses, dropped = refined.poses, ~made._keys.is_kept
    hosts = made._keys.hosts[dropped]
    error = between(TRUTH[hosts], TRUTH[dropped]) - between(poses[hosts], poses[dropped])
    assert np.abs(wrapped(error, 2))[:, :2].max() < 0.03
    assert np.abs(wrapped(error, 2))[:, 2].max() < 0.01
    assert np.hypot(*(poses - TRUTH)[:, :2].T).max() < 0.1


@pytest.mark.parametrize("change", ["came", "went"])
def test_keyframes_that_show_a_change_are_kept(change):
    crate = box(9.0, 0.0, 1.0, 0.7)
    more = np.concatenate([RING, crate])
    plans = [RING, more, more] if change == "came" else [more, RING, RING]
    made, _ = round_thrice(plans)
    keys = made._keys
    beside = np.hypot(TRUTH[:, 0] - 9.5, TRUTH[:, 1] - 1.25) < 2.5
    second = (np.arange(len(keys)) > LAPS) & (np.arange(len(keys)) <= 2 * LAPS)
    seen_first = np.count_nonzero(keys.is_kept[beside & second])
    assert seen_first >= 2
    third = np.arange(len(keys)) > 2 * LAPS
    late = keys.distance > keys.distance[-1] - CONFIRMATION_DISTANCE
    assert np.count_nonzero(keys.is_kept[beside & third & ~late]) < seen_first


def test_passes_that_the_graph_does_not_connect_are_kept():
    """Two passes that the graph does not tie to each other stay apart, alike as they look."""
    made = begun(START, loops={"candidates": 0})
    driven(made, keyframes(RING, TRUTH))
    assert made._keys.is_kept.all()
    assert not made._graph.is_folded.any()


def test_hosts_are_kept_themselves(still):
    made, _ = still
    assert made._keys.is_kept[made._keys.hosts].all()
    poses = compose(TRUTH[made._keys.hosts], made._keys.T_host)
    assert np.hypot(*(poses - TRUTH)[:, :2].T).max() < 0.05


def test_a_map_keeps_its_place_without_the_scans_that_add_nothing(tmp_path):
    """A map that was saved goes on, although its edges are no chain any more."""
    made = begun(START)
    frames = frames_of([RING] * 3)
    known = mapped(made, frames)
    lengths = np.diff(known.keyframes.starts)
    np.testing.assert_array_equal(lengths == 0, ~made._keys.is_kept)
    assert lengths.sum() == len(known.keyframes.points)
    k = int(np.flatnonzero(made._keys.is_kept)[-30])
    np.testing.assert_allclose(
        known.keyframes.points[known.keyframes.starts[k] : known.keyframes.starts[k + 1]],
        frames[k].scan.points[frames[k].scan.valid].astype(np.float32),
    )
    again = Graph()
    again.start(np.zeros(3), models=MODELS)
    again.resume(Map.load(known.save(tmp_path / "ring.imp")))
    graph = again._graph
    assert graph.closures == np.isfinite(made._graph.edges.kernel).sum() > 0
    assert again.counts()["loops closed"] == 0, "the closures of the map are not its own"
    assert (graph.path_lengths(0) >= 0.0).all()
    assert graph.path_lengths(0).max() < 60.0
    refined = again.refine()
    assert np.hypot(*(refined.poses - TRUTH)[:, :2].T).max() < 0.1
