"""Which closures are sought, which are believed, and which wait for others."""

import numpy as np
import pytest
from tests.estimators.drives import LAP, RING, begun, driven, keyframe, keyframes, motions, way

from impslam.estimators.loop_closing import (
    CONFIRMATION_DISTANCE,
    MAX_REACH,
    PASS_DISTANCE,
    SAFE_WINDOW,
    LoopCloser,
    LoopSearch,
    PendingClosure,
)
from impslam.estimators.pose_graph import PoseGraph
from impslam.geometry.se2 import between
from impslam.recognition.places import Closure
from impslam.recognition.verify import ClosureStrength, Support

TRUTH = way(*LAP, (12.0, 1.25))
DRIFT = (0.0, 0.0, 0.003)
INFORMATION = np.diag([1e4, 1e4, 1e5])
NARROW, WIDE = 0.5 * SAFE_WINDOW, 2.0 * SAFE_WINDOW
SPACING = 2.5  # m between nodes


def lap(n=20, spread=1.0):
    """Return a graph of a ring of n nodes and half a second round, drifting by 1 mm from node to node.

    `spread` scales the standard deviations of the motions.
    """
    turn = 2.0 * np.pi / n
    step = np.array([SPACING, 0.0, turn])
    graph = PoseGraph()
    graph.add_root(np.zeros(3), 1e-8 * np.eye(3))
    for _ in range(n + n // 2):
        drift = np.array([0.001, 0.001, 0.0])
        graph.extend(step + drift, spread**2 * np.diag([1e-4, 1e-4, 1e-5]), SPACING)
    return graph


SUPPORT = {
    ClosureStrength.STRONG: Support(0.8, 0.9, 0.9, 500),
    ClosureStrength.WEAK: Support(0.8, 0.9, 0.7, 500),
}


def found(graph, j, verdict=ClosureStrength.STRONG, off=(0.0, 0.0, 0.0), support=None, n=20):
    """Return a closure of node j with the one a lap before, which lies at the same place."""
    pose = np.array(off, float)
    closure = Closure(pose, INFORMATION, support or SUPPORT[verdict], verdict, 0.9, -np.inf)
    return PendingClosure(j - n, j, closure, SPACING * j, 1.0)


def taken(window, *rows, spread=1.0):
    """Take closures one after the other; return the graph, the closer, and what each was told."""
    graph, closer = lap(spread=spread), LoopCloser(LoopSearch())
    told = [closer._accept(found(graph, *row), graph, window) for row in rows]
    return graph, closer, told


# --------------------------------------------------------------------------- belief


def test_a_strong_closure_from_a_narrow_window_is_accepted_immediately():
    graph, closer, told = taken(NARROW, (20,))
    assert told == [False]  # it says nothing new: the drift is 2 cm
    assert graph.closures == 1
    assert closer._pending == []


def test_a_weak_closure_from_a_narrow_window_is_dropped():
    """Alignment that hardly fits where it must is no place, and no other will speak for it."""
    graph, closer, _ = taken(
        NARROW, (20, ClosureStrength.WEAK), (21, ClosureStrength.WEAK), (22, ClosureStrength.WEAK)
    )
    assert graph.closures == 0
    assert closer._pending == []


def test_a_closure_from_a_wide_window_is_pending():
    graph, closer, told = taken(WIDE, (20,))
    assert told == [False]
    assert graph.closures == 0
    assert len(closer._pending) == 1


@pytest.mark.parametrize(
    "verdicts",
    [
        (ClosureStrength.STRONG, ClosureStrength.STRONG),
        (ClosureStrength.STRONG, ClosureStrength.WEAK),
        (ClosureStrength.WEAK, ClosureStrength.STRONG),
        (ClosureStrength.WEAK, ClosureStrength.WEAK, ClosureStrength.WEAK),
    ],
)
def test_a_strong_and_another_or_three_weak_closures_are_accepted(verdicts):
    rows = [(20 + k, verdict) for k, verdict in enumerate(verdicts)]
    graph, closer, _ = taken(WIDE, *rows[:-1])
    assert graph.closures == 0
    closer._accept(found(graph, *rows[-1]), graph, WIDE)
    assert graph.closures == len(verdicts)
    assert closer._pending == []
    assert graph.edges.j[-len(verdicts) :].tolist() == [row[0] for row in rows]


def test_closures_without_a_position_count_like_weak_ones():
    """Along a corridor, two of them agree wherever a wall is parallel to the true one."""
    graph, closer = lap(), LoopCloser(LoopSearch())
    for j, closures in ((20, 0), (21, 0), (22, 3)):
        one = found(graph, j)
        closer._accept(one._replace(closure=one.closure._replace(has_position=False)), graph, WIDE)
        assert graph.closures == closures


@pytest.mark.parametrize(
    ("matched", "seen", "count"),
    [(0.35, 44, 2), (0.3, 44, 2), (0.25, 60, 2), (0.2, 60, 3), (0.35, 34, 3), (0.15, 20, 3)],
)
def test_the_smaller_the_common_area_the_more_closures_have_to_agree(matched, seen, count):
    rows = [
        (20 + k, ClosureStrength.WEAK, (0.0, 0.0, 0.0), Support(matched, 1.0, 1.0, seen))
        for k in range(count)
    ]
    graph, closer, _ = taken(WIDE, *rows[:-1])
    assert graph.closures == 0
    closer._accept(found(graph, *rows[-1]), graph, WIDE)
    assert graph.closures == count


@pytest.mark.parametrize(("share", "count"), [(0.5, 2), (0.33, 2), (0.3, 3), (0.16, 3)])
def test_more_closures_have_to_agree_in_a_narrow_view(share, count):
    """In a depth camera's 57 deg, a wall with a corner is all that there is to see of most rooms."""
    graph, closer = lap(), LoopCloser(LoopSearch())
    for k in range(count):
        assert graph.closures == 0
        closer._accept(found(graph, 20 + k)._replace(view_share=share), graph, WIDE)
    assert graph.closures == count


@pytest.mark.parametrize(
    ("third", "count"),
    [(ClosureStrength.STRONG, 3), (ClosureStrength.WEAK, 3), (None, 0)],
)
def test_more_closures_have_to_agree_if_the_node_may_be_far_off(third, count):
    """The true place may be elsewhere, and look like the one found."""
    rows = [(20,), (21,)] + ([(22, third)] if third is not None else [])
    graph, closer, _ = taken(WIDE, *rows, spread=100.0)
    assert lap(spread=100.0).reach(21)[1] > MAX_REACH > lap().reach(21)[1]
    assert graph.closures == count
    assert bool(closer._pending) == (count == 0)


@pytest.mark.parametrize(
    "off", [(1.0, 0.0, 0.0), (0.0, -0.6, 0.0), (0.0, 0.0, 0.2), (2.5, 0.0, 0.3)]
)
def test_inconsistent_closures_stay_pending(off):
    graph, closer, _ = taken(WIDE, (20, ClosureStrength.STRONG), (21, ClosureStrength.STRONG, off))
    assert graph.closures == 0
    assert len(closer._pending) == 2
    # A third one that agrees with the first is believed with it; the one between is forgotten.
    closer._accept(found(graph, 22), graph, WIDE)
    assert graph.edges.j[-2:].tolist() == [20, 22]
    assert graph.closures == 2
    assert closer._pending == []


def test_an_old_pending_closure_is_discarded():
    late = 20 + int(CONFIRMATION_DISTANCE // SPACING) + 1
    graph, closer, _ = taken(WIDE, (20,), (late,))
    assert graph.closures == 0
    assert [p.j for p in closer._pending] == [late]


def test_closures_trigger_a_solution_where_the_graph_was_wrong():
    _, _, told = taken(
        WIDE, (20, ClosureStrength.STRONG, (0.3, 0, 0)), (21, ClosureStrength.STRONG, (0.3, 0, 0))
    )
    assert told == [False, True]


# --------------------------------------------------------------------------- where it is sought


def seeking(frames, **search):
    made = begun(TRUTH[0], loops=search)
    driven(made, frames)
    return made


@pytest.fixture(scope="module")
def frames():
    return keyframes(RING, TRUTH, DRIFT)


def test_nothing_is_tried_without_candidates(frames):
    made = seeking(frames, candidates=0)
    assert made._closer.recogniser.counts["attempts"] == 0


@pytest.mark.parametrize("candidates", [1, 2, 4])
def test_the_number_of_candidates_at_a_node_is_limited(frames, candidates):
    made = begun(TRUTH[0], loops={"candidates": candidates})
    counts = made._closer.recogniser.counts
    for frame in frames:
        before, nodes = counts["attempts"], len(made._graph)
        made.add(frame)
        assert counts["attempts"] - before <= candidates * (len(made._graph) - nodes)


def test_no_search_where_the_path_through_the_graph_is_short(frames):
    """The whole lap is 56 m; a way back that long is nowhere."""
    made = seeking(frames, min_path=200.0)
    assert made._closer.recogniser.counts["attempts"] == 0


def test_a_closed_loop_is_not_searched_again(frames):
    made = seeking(frames)
    assert made._graph.closures >= 1
    assert made._closer.recogniser.counts["attempts"] < 8


def test_out_of_the_window_nothing_is_found(frames):
    """So little drift is allowed that the window misses the place by a metre."""
    made = seeking(frames, drift=0.001, min_window=0.1, turn_drift=1e-4, min_turn_window=0.01)
    assert made._graph.closures == 0


@pytest.mark.parametrize(("away", "count"), [(100.0, 2), (350.0, 8)])
def test_the_wider_the_window_the_more_candidates_are_tried(frames, away, count):
    """After a way without scans, there and back, the window is 8 and 28 m wide."""
    lap = len(way(*LAP))
    blind = [keyframe(lap + k, [ahead, 0.0, 0.0]) for k, ahead in enumerate((away, -away))]
    made = begun(TRUTH[0])
    driven(made, [*frames[:lap], *blind])
    paths = made._graph.path_lengths(len(made._graph) - 1)
    chosen = made._closer._candidates(len(made._graph) - 1, paths, made._keys, made._graph)
    assert len(chosen) == count
    apart = np.diff(np.sort(made._keys.distance[made._keys.nodes[chosen]]))
    assert apart.min() >= PASS_DISTANCE


def test_a_strong_closure_is_preferred_to_a_weak_one_with_a_nearer_candidate(frames, monkeypatch):
    made = begun(TRUTH[0])
    driven(made, frames[:-1])
    verdicts = iter((ClosureStrength.WEAK, ClosureStrength.STRONG))
    monkeypatch.setattr(made._closer, "_candidates", lambda *_: [2, 8])
    monkeypatch.setattr(
        made._closer.recogniser, "find_closure",
        lambda *_: found(made._graph, 25, next(verdicts)).closure,
    )  # fmt: skip
    made._closer._pending = []
    made._closer.search(len(made._graph) - 1, made._keys, made._graph)
    assert [p.i for p in made._closer._pending] == [8]
    assert made._closer._pending[0].is_strong


def test_closures_are_where_the_truth_is(frames):
    made = seeking(frames)
    edges = made._graph.edges
    truth = TRUTH[made._keys.nodes]
    for row in np.flatnonzero(np.isfinite(edges.kernel)):
        error = edges.T_i_j[row] - between(truth[edges.i[row]], truth[edges.j[row]])
        assert np.hypot(*error[:2]) < 0.1
        assert abs(np.remainder(error[2] + np.pi, 2 * np.pi) - np.pi) < 0.02


def test_keyframes_without_scans_have_no_closures():
    made = begun(TRUTH[0])
    driven(made, [keyframe(k, d) for k, d in enumerate(motions(TRUTH))])
    assert made._closer.recogniser.counts["attempts"] == 0
    assert made._graph.closures == 0


def test_a_place_that_was_passed_blindly_is_not_found(frames):
    """On the first 20 m no scan was taken; the second lap looks for them in vain."""
    blind = [keyframe(k, f.motion.d_pose) if k < 60 else f for k, f in enumerate(frames)]
    made = begun(TRUTH[0])
    driven(made, blind)
    assert made._graph.closures == 0
