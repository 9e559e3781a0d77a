"""The graph estimator on a drive that leads back: what closures and refinement make of drift."""

from dataclasses import replace

import numpy as np
import pytest
from tests.contracts.test_estimators import told
from tests.estimators.drives import (
    LAP,
    RING,
    begun,
    box,
    driven,
    keyframe,
    keyframes,
    motions,
    scanned,
    way,
)
from tests.extractors.scans import room
from tests.filters.worlds import wall_seen
from tests.numeric import wrapped
from tests.recognition.plans import walls

from impslam.errors import NumericalError
from impslam.estimators.graph import _refinable
from impslam.estimators.keyframe_log import KeyframeLog
from impslam.estimators.loop_closing import LoopCloser
from impslam.estimators.pose_graph import PoseGraph
from impslam.geometry.se2 import between, compose
from impslam.types import Observation

TRUTH = way(*LAP, (12.0, 1.25))
"""A lap of 56 m, and 9 m of a second one."""
DRIFT = (0.0, 0.0, 0.003)
"""rad/m: 1.4 m at the far side of the lap."""
OPEN = {"candidates": 0}


@pytest.fixture(scope="module")
def frames():
    return keyframes(RING, TRUTH, DRIFT)


@pytest.fixture(scope="module")
def closed(frames):
    """A graph that has been driven round, and its revisions."""
    made = begun(TRUTH[0])
    return made, driven(made, frames)


def errors(poses, truth=TRUTH):
    """Return the distances (k,) m from the true poses."""
    return np.hypot(*(poses - truth)[:, :2].T)


def many(revisions):
    """Return the keyframes whose revisions move others."""
    return [k for k, revision in enumerate(revisions) if len(revision.ids) > 1]


def newest(revisions):
    return np.array([r.poses[r.ids == k][0] for k, r in enumerate(revisions)])


# --------------------------------------------------------------------------- a loop


def test_without_closures_the_ends_do_not_meet(frames):
    made = begun(TRUTH[0], loops=OPEN)
    revisions = driven(made, frames)
    assert many(revisions) == []
    assert errors(newest(revisions)).max() > 1.3
    assert errors(made.refine().poses).max() > 1.0


def test_a_closure_revises_all_keyframes_and_the_ends_meet(closed):
    _, revisions = closed
    moved = many(revisions)
    assert len(moved) >= 1
    # The second lap begins with keyframe 157; the recogniser wants what lies around a node.
    assert 150 < moved[0] < 180
    for k in moved:
        assert revisions[k].ids.tolist() == list(range(k + 1))
    before = errors(newest(revisions))
    assert before.max() > 1.3
    last = moved[-1]
    assert errors(revisions[last].poses, TRUTH[: last + 1]).max() < 0.25


def test_refined_poses_are_within_centimetres(closed):
    made, _ = closed
    done = made.refine()
    assert done.ids.tolist() == list(range(len(TRUTH)))
    assert errors(done.poses).max() < 0.06
    assert np.abs(wrapped(done.poses - TRUTH, 2)[:, 2]).max() < 0.01
    np.testing.assert_array_equal(done.poses[0], TRUTH[0])


def test_a_drive_that_ends_where_it_began_is_closed_at_its_end(frames, closed):
    """The newest node has no closure while the robot drives: what follows it is still unknown."""
    k = many(closed[1])[0]
    made = begun(TRUTH[0])
    driven(made, frames[:k])
    assert made.counts()["loops closed"] == made._graph.closures == 0
    assert errors(made.refine().poses, TRUTH[:k]).max() < 0.1
    counts = made.counts()
    assert counts["loops closed"] == np.isfinite(made.edges().kernel).sum() > 0
    assert counts["loops tried"] >= counts["loops closed"], "those of the newest node count, too"
    revision = made.add(frames[k])
    assert len(revision.ids) == k + 1, "the drive goes on as if it had not ended"
    np.testing.assert_array_equal(revision.poses, closed[1][k].poses)


def test_covariances_shrink_with_a_closure_and_cover_the_errors(closed):
    made, revisions = closed
    k = many(revisions)[0]
    before = revisions[k - 1].covariances[-1]
    assert np.trace(revisions[k].covariances[-1]) < 0.2 * np.trace(before)
    done = made.refine()
    assert (np.linalg.eigvalsh(done.covariances) > 0.0).all()
    # The farthest keyframes, half a lap from the start, are the least sure.
    farthest = int(np.argmax(done.covariances[:, 0, 0] + done.covariances[:, 1, 1]))
    assert 40 < farthest < 130


def test_a_rigid_motion_of_the_start_moves_the_whole_run(frames, closed):
    """The first pose says where the map lies, and nothing else does."""
    motion = np.array([7.0, -3.0, 2.5])
    other = begun(compose(motion, TRUTH[0]))
    moved = driven(other, frames)
    assert many(moved) == many(closed[1])
    poses = compose(motion, closed[0].refine().poses)
    assert np.abs(wrapped(other.refine().poses - poses, 2)).max() < 2e-3  # grids lie otherwise


def test_the_same_keyframes_give_the_same_bytes(frames, closed):
    made = begun(TRUTH[0])
    assert [told(r) for r in driven(made, frames)] == [told(r) for r in closed[1]]
    assert told(made.refine()) == told(closed[0].refine())


def test_refining_does_not_affect_later_keyframes(frames, closed):
    """Refined and asked for landmarks after every third keyframe, before and after closures."""
    made, revisions = begun(TRUTH[0]), []
    for k, frame in enumerate(frames):
        revisions.append(made.add(frame))
        if k % 3 == 0 and (k < 9 or k > 150):
            one, two = made.refine(), made.refine()
            assert told(one) == told(two)
            made.landmarks()
    assert [told(r) for r in revisions] == [told(r) for r in closed[1]]
    assert told(made.refine()) == told(closed[0].refine())


def test_refining_a_draft_changes_nothing_in_the_graph_that_has_gone_on(frames):
    made = begun(TRUTH[0])
    driven(made, frames[:150])
    draft = made.draft()
    driven(made, frames[150:])
    edges, refined = made.edges(), made.refine().poses
    draft.refine()
    assert draft.edges().i.max() < 150
    for now, before in zip(made.edges(), edges, strict=True):
        assert now.tobytes() == before.tobytes()
    assert made.refine().poses.tobytes() == refined.tobytes()


def test_the_edges_of_a_refined_draft_contain_its_last_closures(frames):
    made = begun(TRUTH[0])
    revisions = driven(made, frames)
    first = many(revisions)[0]
    made = begun(TRUTH[0])
    driven(made, frames[:first])  # the closure waits for the next node
    draft = made.draft()
    assert draft.refine() is not None
    assert len(draft.edges().i) > len(made.edges().i)


def test_a_closure_with_a_dropped_keyframe_is_not_one_with_its_neighbour():
    keys, graph, still = KeyframeLog(), PoseGraph(), np.zeros(3)
    for k in range(4):  # two sessions of two nodes
        keys.add(keyframe(k, still), still if k % 2 == 0 else None)
        if k % 2:
            keys.mark_node()
            graph.extend(still, np.eye(3), 1.0)
        else:
            graph.add_root(still, np.eye(3))
    graph.add_closure(0, 2, np.array([1.0, 0.0, 0.0]), np.eye(3))
    assert _refinable(keys, graph).links.j.tolist() == [2]
    keys.drop(np.array([2]), np.array([0]), np.zeros((1, 3)))
    part = _refinable(keys, graph)
    assert part.rows.tolist() == [0, 1, 3]
    assert part.links.j.tolist() == []


def test_an_exact_drive_stays_exact():
    made = begun(TRUTH[0])
    revisions = driven(made, keyframes(RING, TRUTH, noise=0.0))
    assert many(revisions) == []
    assert made._graph.closures > 0
    assert errors(newest(revisions)).max() < 1e-9
    assert errors(made.refine().poses).max() < 2e-3


def test_a_stationary_robot_adds_no_nodes():
    scan = scanned(RING, TRUTH[0])
    made = begun(TRUTH[0])
    driven(made, [keyframe(k, np.zeros(3), scan) for k in range(40)])
    assert made.state_size == 3
    assert errors(made.refine().poses, np.tile(TRUTH[0], (40, 1))).max() < 1e-6


def test_a_robot_that_turns_on_the_spot_closes_no_loop_with_itself():
    scans = [scanned(RING, np.array([3.0, 1.25, 0.3 * k]), noise=0.01) for k in range(120)]
    made = begun((3.0, 1.25, 0.0))
    turn = [keyframe(k, [0.0, 0.0, 0.3 * (k > 0)], scan) for k, scan in enumerate(scans)]
    driven(made, turn)
    poses = made.refine().poses
    assert np.hypot(*(poses[:, :2] - [3.0, 1.25]).T).max() < 0.02


# --------------------------------------------------------------------------- places that look alike

BARE = np.concatenate([room(-2.0, 42.0, -1.2, 1.2)])
"""A corridor of 44 m that looks the same all along."""
WIDE = {"drift": 0.2, "max_window": 16.0}
"""So wide a window that it holds two rooms."""


def two_rooms(apart):
    """Return a corridor with two rooms that are the same, their left sides so many metres apart."""

    def one(x):
        return [
            walls(
                [x, 1.2, x, 5.2], [x, 5.2, x + 4, 5.2], [x + 4, 5.2, x + 4, 1.2],
                [x + 4, 1.2, x + 2.6, 1.2], [x + 1.4, 1.2, x, 1.2],
            ),
            box(x + 0.5, 4.0, 0.7, 0.6),
            box(x + 3.2, 2.0, 0.5, 0.9),
        ]  # fmt: skip

    corridor = walls(
        [-20, -1.2, 20, -1.2], [-20, -1.2, -20, 1.2], [20, -1.2, 20, 1.2], [-20, 1.2, 0, 1.2],
        [4, 1.2, apart, 1.2], [apart + 4, 1.2, 20, 1.2],
    )  # fmt: skip
    clutter = [box(-15, -1.2, 0.6, 0.4), box(15, -1.2, 0.8, 0.3), box(17, 0.8, 0.5, 0.4)]
    return np.concatenate([corridor, *one(0.0), *one(apart), *clutter])


def test_closures_in_a_bare_corridor_fix_all_but_the_position_along_it():
    truth = way((0.0, 0.0), (40.0, 0.0), (0.0, 0.0))
    made, by_odometry = begun(truth[0], loops=WIDE), begun(truth[0], loops=OPEN)
    frames = keyframes(BARE, truth, (0.002, 0.0, 0.0003))
    last, open_last = driven(made, frames)[-1], driven(by_odometry, frames)[-1]
    assert made._graph.closures > 3
    off, open_off = last.poses[-1] - truth[-1], open_last.poses[-1] - truth[-1]
    assert (np.abs(wrapped(off, 2)[1:]) < 0.6 * np.abs(wrapped(open_off, 2)[1:])).all()
    assert off[0] == pytest.approx(open_off[0], abs=0.15)
    along, open_along = last.covariances[-1, 0, 0], open_last.covariances[-1, 0, 0]
    assert along > 0.9 * open_along


@pytest.mark.parametrize("loops", [{}, WIDE], ids=["usual", "wide"])
@pytest.mark.parametrize("apart", [4.6, 7.0])
def test_identical_rooms_are_not_confused(apart, loops):
    """Odometry is exact, so that whatever a false closure moved would be off."""
    at = apart + 2.0
    truth = way((2, 0), (2, 4), (2, 0), (-19, 0), (at, 0), (at, 4), (at, 0), (18, 0))
    made = begun(truth[0], loops=loops)
    revisions = driven(made, keyframes(two_rooms(apart), truth))
    assert made._graph.closures > 0
    assert errors(newest(revisions), truth).max() < 0.1
    assert errors(made.refine().poses, truth).max() < 0.1


@pytest.mark.parametrize("apart", [4.6, 5.0])
@pytest.mark.parametrize(("loops", "clutter"), [({}, 0), ({}, 1), (WIDE, 0), (WIDE, 1)])
def test_no_false_closure_enters_the_graph(loops, clutter, apart):
    """`clutter` is a box 10 m away from both rooms, or none; without it, many poses in the corridor fit."""
    plan = np.concatenate([two_rooms(apart), *[box(-8.0, 0.9, 1.0, 0.3)] * clutter])
    at = apart + 2.0
    truth = way((2, 0), (2, 4), (2, 0), (-19, 0), (at, 0), (at, 4), (at, 0), (18, 0))
    made = begun(truth[0], loops=loops)
    driven(made, keyframes(plan, truth))
    edges, nodes = made._graph.edges, truth[made._keys.nodes]
    closures = np.isfinite(edges.kernel)
    i, j = edges.i[closures], edges.j[closures]
    off = wrapped(edges.T_i_j[closures] - between(nodes[i], nodes[j]), 2)
    assert errors(made.refine().poses, truth).max() < 0.1, "the map moved"
    assert np.einsum("ki,kij,kj->k", off, edges.information[closures], off).max() < 9.0


# --------------------------------------------------------------------------- what fails


def test_a_graph_without_a_solution_keeps_the_last_one_and_is_reported(frames, monkeypatch):
    """The first closure has no solution: the run goes on by odometry, until the next one."""
    solve, failed = PoseGraph.solve, []

    def failing(self):
        if not failed:
            failed.append(len(self))
            raise NumericalError("no convergence")
        solve(self)

    monkeypatch.setattr(PoseGraph, "solve", failing)
    made = begun(TRUTH[0])
    revisions = driven(made, frames)
    refused = [r for r in revisions if r.refused]
    assert len(refused) == 1
    (k,) = refused[0].ids
    assert refused[0].refused == f"no loop is closed at {k:.3f} s: no convergence"
    twin = driven(begun(TRUTH[0], loops=OPEN), frames)
    np.testing.assert_array_equal(refused[0].poses, twin[k].poses)
    assert errors(made.refine().poses).max() < 0.1  # by the closures that came later


def test_a_closure_without_a_solution_does_not_block_later_ones(frames, monkeypatch):
    """A closure that is no number comes first; the true one comes when it comes."""
    search, told = LoopCloser.search, []

    def spoilt(self, node, keys, graph):
        if len(told) < 1:
            told.append(graph.add_closure(0, node, np.full(3, np.nan), np.eye(3)))
            return True
        return search(self, node, keys, graph)

    monkeypatch.setattr(LoopCloser, "search", spoilt)
    made = begun(TRUTH[0])
    revisions = driven(made, frames)
    assert [r.refused for r in revisions if r.refused] == [
        "no loop is closed at 14.000 s: pose graph: edge 2 is not finite"
    ]
    assert len(many(revisions)) >= 1
    assert errors(made.refine().poses).max() < 0.06


BAD = Observation("cylinder", np.array([1.0, np.nan]), np.eye(2))


def test_a_bad_observation_is_reported_also_at_a_closure(frames, closed):
    k = many(closed[1])[0]
    made = begun(TRUTH[0])
    spoilt = replace(frames[k], observations=(BAD,))
    revision = driven(made, [*frames[:k], spoilt])[-1]
    assert len(revision.ids) == k + 1
    assert "observation is not finite" in revision.refused


def test_a_bad_observation_and_a_failure_are_both_reported(frames, closed, monkeypatch):
    def failing(_):
        raise NumericalError("no convergence")

    monkeypatch.setattr(PoseGraph, "solve", failing)
    k = many(closed[1])[0]
    spoilt = replace(frames[k], observations=(BAD,))
    refused = driven(begun(TRUTH[0]), [*frames[:k], spoilt])[-1].refused
    assert "observation is not finite" in refused
    assert "no convergence" in refused
    assert "\n" not in refused


def test_refining_without_a_solution_keeps_the_last_one(frames, monkeypatch):
    made = begun(TRUTH[0])
    driven(made, frames)

    def failing(_):
        raise NumericalError("no convergence")

    monkeypatch.setattr(PoseGraph, "solve", failing)
    done = made.refine()
    assert done.refused == "the last closures are not in the map: no convergence"
    assert errors(done.poses).max() < 0.06


def test_blind_scans_and_missing_ones_break_nothing(frames):
    """On the way back into the known, ten scans are blind and ten are missing."""
    blind = scanned(RING, TRUTH[0], range_max=0.1)
    some = [
        replace(f, scan=blind) if 60 <= k < 70 else replace(f, scan=None) if 80 <= k < 90 else f
        for k, f in enumerate(frames)
    ]
    made = begun(TRUTH[0])
    revisions = driven(made, some)
    assert len(many(revisions)) >= 1
    assert [r.refused for r in revisions] == [""] * len(TRUTH)
    assert errors(made.refine().poses).max() < 0.3


# --------------------------------------------------------------------------- landmarks


def walls_seen(pose, plan):
    """Return all walls (w, 2, 2) of a plan, observed from a pose without noise."""
    found = [wall_seen(pose, ends) for ends in plan]
    R = np.diag([1e-4, 1e-5])
    return [Observation("wall", z, R, np.arange(50), ends) for z, ends in found]


def test_each_wall_of_a_noiseless_room_is_one_landmark():
    plan = room(0.0, 6.0, 0.0, 5.0)
    truth = way((1.0, 1.0), (5.0, 1.0), (5.0, 4.0), (1.0, 4.0), (1.0, 1.0), (5.0, 1.0))
    frames = keyframes(plan, truth, noise=0.0)
    made = begun(truth[0])
    driven(made, [replace(f, observations=tuple(walls_seen(truth[f.id], plan))) for f in frames])
    for refine in (lambda: None, made.refine):
        refine()
        marks = made.landmarks()
        assert [mark.kind for mark in marks] == ["wall"] * 4
        feet = np.array(sorted(mark.position.round(2).tolist() for mark in marks))
        np.testing.assert_allclose(feet, [[0, 0], [0, 0], [0, 5], [6, 0]], atol=0.011)
        ends = np.concatenate([mark.end_points for mark in marks])
        for corner in plan[:, 0]:
            assert np.sort(np.hypot(*(ends - corner).T))[1] < 5e-3
        assert {mark.observations for mark in marks} == {len(truth)}


def test_covariances_of_landmarks_include_those_of_the_poses_that_saw_them():
    """A post at the end of a long way is as unsure as the way, and one at its start is not."""
    truth = way((0.0, 0.0), (30.0, 0.0))
    frames = [keyframe(k, d) for k, d in enumerate(motions(truth))]
    R = 1e-4 * np.eye(2)
    post = (Observation("cylinder", np.array([2.0, 0.0]), R, attributes={"radius": 0.1}),)
    near, far = (0, 1, 2), (len(truth) - 3, len(truth) - 2, len(truth) - 1)
    made = begun(truth[0])
    ahead = dict.fromkeys((near[0], far[0]), post)
    for k in (*near[1:], *far[1:]):
        d = truth[near[0] if k in near else far[0], 0] + 2.0 - truth[k, 0]
        ahead[k] = (replace(post[0], z=np.array([d, 0.0])),)
    revisions = driven(made, [replace(f, observations=ahead.get(f.id, ())) for f in frames])
    first, last = sorted(made.landmarks(), key=lambda mark: mark.position[0])
    assert np.sqrt(np.diag(first.covariance)).max() < 0.03
    P = revisions[-1].covariances[-1]
    assert (np.diag(last.covariance)[:2] >= 0.9 * np.diag(P)[:2]).all()


def test_without_a_loop_refining_keeps_the_covariances():
    made = begun(scale_sigma=0.0)  # its part changes with the refined poses
    truth = way(*LAP[:3])
    claimed = [r.covariances[-1] for r in driven(made, keyframes(RING, truth))]
    np.testing.assert_allclose(made.refine().covariances, claimed, rtol=1e-9, atol=1e-15)
