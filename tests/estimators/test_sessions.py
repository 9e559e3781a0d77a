"""Sessions: drives in one graph whose relation is not known until a closure joins them."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from tests.estimators.drives import LAP, RING, STEP, begun, box, driven, keyframes, way
from tests.extractors.scans import room
from tests.filters.worlds import MODELS
from tests.numeric import wrapped
from tests.recognition.plans import walls

from impslam.errors import NumericalError
from impslam.estimators.graph import Graph
from impslam.estimators.keyframe_log import revised
from impslam.estimators.loop_closing import (
    Comparison,
    LoopCloser,
    LoopSearch,
    PendingClosure,
    _relation,
)
from impslam.estimators.pose_graph import PoseGraph
from impslam.estimators.session_finder import Guess
from impslam.estimators.sessions import (
    MIN_CLOSURES,
    MIN_SEARCH_DISTANCE,
    MIN_SURPRISING_CLOSURES,
    SessionPlacer,
    _distinct_closure,
)
from impslam.geometry.se2 import between, compose, rotation
from impslam.health import ELSEWHERE
from impslam.map import Map, with_begins
from impslam.map_builder import MapBuilder, blended
from impslam.recognition.places import Closure
from impslam.recognition.verify import ClosureStrength, Support
from impslam.types import NO_EDGES

TRUTH = way(*LAP[:4])
CUT = 60
NOWHERE = np.full(3, np.nan)
FIRM = np.diag([1e4, 1e4, 1e5])
SUPPORT = Support(0.8, 0.9, 0.9, 500)


@pytest.fixture(scope="module")
def frames():
    """The keyframes of a drive on which the motion to number `CUT` is not known."""
    made = keyframes(RING, TRUTH)
    motion = replace(made[CUT].motion, d_pose=NOWHERE)
    return [*made[:CUT], replace(made[CUT], motion=motion, lost=True), *made[CUT + 1 :]]


def mapped(made, frames):
    """Return the map that an estimator makes of keyframes."""
    builder = MapBuilder()
    for frame in frames:
        builder.revise(frame, made.add(frame))
    known = replace(
        builder.map(),
        landmarks=made.landmarks(),
        edges=made.edges(),
        observations=made.observations(),
    )
    return blended(known.revised(made.refine()))


def test_keyframes_after_an_unknown_motion_are_not_placed(frames):
    revisions = driven(begun(TRUTH[0]), frames)
    placed = [bool(np.all(r.placed)) for r in revisions]
    assert placed == [k < CUT for k in range(len(frames))]
    assert all(r.refused == "" for r in revisions)
    assert revisions[CUT].covariances[0].min() >= 0.0
    assert revisions[-1].covariances[0, 0, 0] > 1e5  # m^2: it may be anywhere


def test_a_pending_session_does_not_change_the_map(frames):
    """Grid and landmarks are those of a drive that ended before."""
    known = mapped(begun(TRUTH[0]), frames)
    before = mapped(begun(TRUTH[0]), frames[:CUT])
    keyframes = known.keyframes
    assert keyframes.sessions.tolist() == [0] * CUT + [1] * (len(frames) - CUT)
    np.testing.assert_array_equal(keyframes.placed, keyframes.sessions == 0)
    np.testing.assert_array_equal(keyframes.poses[:CUT], before.keyframes.poses)
    np.testing.assert_array_equal(known.grid().logodds, before.grid().logodds)
    assert [m.id for m in known.landmarks] == [m.id for m in before.landmarks]


def test_a_closure_joins_a_session_to_the_map(frames):
    made = begun(TRUTH[0])
    driven(made, frames)
    graph, keys = made._graph, made._keys
    (i,) = np.flatnonzero(keys.nodes == 0)
    j = len(graph) - 1
    T = between(TRUTH[0], TRUTH[keys.nodes[j]])
    assert graph.add_closure(int(i), j, T, FIRM)
    graph.solve()
    revision = made.refine()
    assert np.all(revision.placed)
    assert np.abs(wrapped(revision.poses - TRUTH, 2)).max() < 0.02
    assert revision.covariances[:, 0, 0].max() < 1.0


def loaded(known, path):
    """Return an estimator that continues a map from its file."""
    again = Graph()
    again.start(np.zeros(3), models=MODELS)
    again.resume(Map.load(known.save(path)))
    return again


def test_a_map_of_two_sessions_is_continued_unchanged(frames, tmp_path):
    made = begun(TRUTH[0])
    again = loaded(mapped(made, frames), tmp_path / "map.imp")
    assert np.all(again.edges().i == made.edges().i)
    np.testing.assert_array_equal(again._graph.roots, made._graph.roots)
    np.testing.assert_allclose(again._keys.distance, made._keys.distance, atol=1e-9)


def test_a_map_without_a_graph_keeps_its_poses(tmp_path, rng):
    """Its estimator corrects the poses of landmarks and keyframes, but not odometry's motions."""
    known = mapped(begun(TRUTH[0]), keyframes(RING, TRUTH))
    rows = known.keyframes
    drift = np.array([0.0, 0.0, 0.01]) + rng.normal(0.0, 0.01, rows.motions.shape)
    rows = replace(rows, motions=rows.motions + drift)
    made = loaded(replace(known, keyframes=rows, edges=NO_EDGES), tmp_path / "map.imp")
    off = wrapped(revised(made._keys, made._graph) - rows.poses, 2)
    assert np.abs(off).max() < 1e-9
    assert np.hypot(*(made.refine().poses - rows.poses)[:, :2].T).max() < 0.05  # matched anew


@pytest.mark.parametrize("stop", [40, 61, 90])
def test_a_continued_map_equals_an_uninterrupted_run(stop, tmp_path):
    frames = keyframes(RING, TRUTH)
    whole = mapped(begun(TRUTH[0]), frames)
    part = Map.load(mapped(begun(TRUTH[0]), frames[:stop]).save(tmp_path / "map.imp"))
    made, builder = Graph(), MapBuilder(part)
    made.start(np.zeros(3), models=MODELS)
    made.resume(part)
    for frame in frames[stop:]:
        revision = made.add(frame)
        assert revision.ids.max() == frame.id
        builder.revise(frame, revision)
    resumed = builder.map().revised(made.refine())
    off = wrapped(resumed.keyframes.poses - whole.keyframes.poses, 2)
    assert np.abs(off).max() < 0.01
    assert len(made.landmarks()) == len(whole.landmarks)
    np.testing.assert_array_equal(resumed.keyframes.motions, whole.keyframes.motions)


def test_a_map_with_unknown_motions_is_continued(tmp_path):
    frames = keyframes(RING, TRUTH[:40])
    unknown = replace(frames[20].motion, d_pose=NOWHERE, covariance=np.full((3, 3), np.nan))
    frames[20] = replace(frames[20], motion=unknown)
    made = begun(TRUTH[0])
    file = mapped(made, frames).save(tmp_path / "map.imp")
    again = Graph()
    again.start(np.zeros(3), models=MODELS)
    again.resume(Map.load(file))
    np.testing.assert_allclose(again._keys.steps, made._keys.steps)
    np.testing.assert_allclose(again._keys.chain, made._keys.chain, atol=1e-9)


AGAIN = way(*LAP, (16.0, 1.25))
"""A lap, and 13 m of the next one."""


@pytest.fixture(scope="module")
def lap():
    return keyframes(RING, AGAIN, drift=(0.0, 0.0, 0.001))


def test_a_session_is_located_in_the_known_area(lap):
    cut = len(way(*LAP))
    lost = replace(lap[cut], motion=replace(lap[cut].motion, d_pose=NOWHERE), lost=True)
    made = begun(AGAIN[0])
    revisions = driven(made, [*lap[:cut], lost, *lap[cut + 1 :]])
    assert not np.all(revisions[cut + 5].placed)
    assert np.all(revisions[-1].placed)
    assert made.counts()["sessions"] == 2
    assert made.counts()["sessions not found"] == 0
    off = np.hypot(*(made.refine().poses - AGAIN)[:, :2].T)
    assert off[cut:].max() < 0.15


SHELVES = [
    box(15.0, 11.5, 0.6, 1.0), box(13.0, 13.2, 1.5, 0.8), box(11.5, 11.5, 1.2, 0.9),
    box(8.5, 13.0, 2.0, 1.0), box(6.0, 11.5, 1.0, 0.9), box(3.5, 13.2, 1.0, 0.8),
]  # fmt: skip
"""Along the corridor in the north, so that it differs from that in the south."""


@pytest.fixture(scope="module")
def carried():
    """A lap, then a drive through another corridor; no motion shows that the robot was carried there."""
    plan, cut = np.concatenate((RING, *SHELVES)), len(way(*LAP))
    truth = np.vstack((AGAIN[:cut], way(LAP[2], LAP[3], (1.25, 4.0))[3:]))
    frames = keyframes(plan, truth)
    unnoticed = replace(frames[cut].motion, d_pose=np.array([STEP, 0.0, 0.0]))
    return [*frames[:cut], replace(frames[cut], motion=unnoticed), *frames[cut + 1 :]], truth


def test_a_robot_that_was_carried_without_notice_is_found_where_the_map_contradicts_it(carried):
    frames, truth = carried
    cut = len(way(*LAP))
    made = begun(AGAIN[0])
    revisions = driven(made, frames)
    assert made.counts()["sessions"] == 2
    assert np.all(revisions[-1].placed)
    assert not any(r.contradicted for r in revisions[:cut])
    assert any(r.contradicted for r in revisions[cut:])
    assert not revisions[-1].contradicted
    off = np.hypot(*(made.refine().poses - truth)[:, :2].T)
    assert off[cut:].max() < 0.1
    assert (
        off[:cut] > 0.1
    ).sum() <= made.spacing / STEP  # less than the distance between two nodes


def test_a_map_with_such_a_robot_is_continued_unchanged(carried, tmp_path):
    """The motion across the place where it was carried connects nothing, here and in the file."""
    frames, _ = carried
    made = begun(AGAIN[0])
    known = mapped(made, frames)
    np.testing.assert_array_equal(known.keyframes.sessions, made._keys.sessions)
    again = loaded(known, tmp_path / "map.imp")
    np.testing.assert_array_equal(again._keys.sessions, made._keys.sessions)
    assert again.edges().i.tolist() == made.edges().i.tolist()
    off = np.hypot(*(again.refine().poses - known.keyframes.poses)[:, :2].T)
    assert off.max() < 0.02


def test_separated_nodes_whose_closures_have_no_solution_stay_pending(carried, monkeypatch):
    """What was assumed to join them is forgotten, so that the map before is as good as without them."""
    frames, truth = carried
    made, solve, failed = begun(AGAIN[0]), PoseGraph.solve, []

    def failing(self):
        if made._keys.sessions.any() and not failed:
            failed.append(made._sessions)
            raise NumericalError("no convergence")
        solve(self)

    monkeypatch.setattr(PoseGraph, "solve", failing)
    known = mapped(made, frames)
    assert made._sessions is not failed[0]
    first = int(np.argmax(known.keyframes.sessions == 1))
    np.testing.assert_array_equal(known.keyframes.placed, np.arange(len(frames)) < first)
    off = np.hypot(*(known.keyframes.poses - truth)[:first, :2].T)
    assert (off > 0.1).sum() <= made.spacing / STEP


def test_no_sweep_is_interpolated_across_a_break(carried):
    frames, _ = carried
    known = mapped(begun(AGAIN[0]), frames)
    first = int(np.argmax(known.keyframes.sessions == 1))
    anchors, T = np.array([first - 1]), 0.5 * known.keyframes.motions[[first]]
    halfway = blended(replace(known, anchors=anchors, tracked=T, T_anchor_base=T)).T_anchor_base
    np.testing.assert_array_equal(halfway, T)


def test_sessions_that_begin_are_numbered_once():
    sessions = np.array([0, 0, 0, 1, 1])
    assert with_begins(sessions, ()).tolist() == [0, 0, 0, 1, 1]
    assert with_begins(sessions, (0, 1, 3)).tolist() == [0, 1, 1, 2, 2]
    assert with_begins(with_begins(sessions, (1,)), (1,)).tolist() == [0, 1, 1, 2, 2]


def test_a_second_lap_contradicts_nothing(lap):
    made = begun(AGAIN[0])
    driven(made, lap)
    assert made.counts().get("sessions", 1) == 1
    assert made._closer.contradicted == []


def test_what_the_map_does_not_show_contradicts_nothing(lap):
    """The robot leaves the ring by a door that is new, into a hall of its own."""
    cut = len(way(*LAP))
    outside = way((3.0, 1.25), (6.0, 1.25), (6.0, -20.0))
    hall = np.concatenate((RING[1:], room(-5.0, 20.0, -25.0, -0.2), walls([0.0, 0.0, 5.0, 0.0])))
    new = keyframes(hall, outside)
    frames = [replace(new[k], id=cut + k, stamp=float(cut + k)) for k in range(len(new))]
    made = begun(AGAIN[0])
    revisions = driven(made, [*lap[:cut], *frames])
    assert np.all(revisions[-1].placed)
    assert made.counts().get("sessions", 1) == 1


def broken(frame, off=(0.0, 0.0, 0.0)):
    """Return a keyframe whose scan does not fit; odometry's motion to it is wrong by `off` (3,)."""
    motion = replace(frame.motion, d_pose=frame.motion.d_pose + np.array(off))
    return replace(frame, motion=motion, lost=True, reason=ELSEWHERE)


def test_the_place_by_odometry_takes_two_closures(lap):
    cut = len(way(*LAP))
    made = begun(AGAIN[0])
    revisions = driven(made, [*lap[:cut], broken(lap[cut]), *lap[cut + 1 :]])
    found = next(k for k in range(cut, len(lap)) if np.all(revisions[k].placed))
    assert (
        AGAIN[found, 0] - AGAIN[cut, 0] < 3.5 * made.spacing
    )  # m; its third node follows the second
    assert not revisions[-1].assumed
    off = np.hypot(*(made.refine().poses - AGAIN)[:, :2].T)
    assert off[cut:].max() < 0.1


def test_odometry_without_any_error_does_not_keep_a_session_apart(lap):
    """The robot stood at a node when its scans stopped fitting: that motion has no covariance."""
    made = begun(AGAIN[0])
    driven(made, lap)
    nodes = made._keys.nodes
    cut = int(nodes[nodes > len(way(*LAP))][0]) + 1
    stood = broken(lap[cut])
    stood = replace(stood, motion=replace(stood.motion, covariance=np.zeros((3, 3))))
    revisions = driven(begun(AGAIN[0]), [*lap[:cut], stood, *lap[cut + 1 :]])
    assert not np.all(revisions[cut].placed)
    assert np.all(revisions[-1].placed)


def test_a_wrong_place_by_odometry_is_not_recognised(lap):
    """Wheels spun for 3 m: the robot is found in the known area, where it is."""
    cut = len(way(*LAP))
    made = begun(AGAIN[0])
    slipped = broken(lap[cut], (3.0, 0.0, 0.0))
    revisions = driven(made, [*lap[:cut], slipped, *lap[cut + 1 :]])
    assert np.all(revisions[-1].placed)
    off = np.hypot(*(made.refine().poses - AGAIN)[:, :2].T)
    assert off[cut:].max() < 0.1


def test_a_closure_agrees_with_odometry_within_its_errors_across_a_break(rng):
    """In 99 % of the cases if odometry is as good as it says; after a turn and 6 m; not a metre off."""
    motion, P = np.array([0.5, 0.1, 0.8]), np.diag([4e-4, 1e-4, 9e-4])
    since = np.array([5.0, 3.0, -1.9])
    at = np.array([[2.0, 1.0, 2.5], [2.5, 1.0, 2.8], np.zeros(3), np.zeros(3)])
    at[2] = compose(at[1], motion)
    at[3] = compose(at[2], since)
    placer, graph = SessionPlacer(None), SimpleNamespace(poses=at)
    placer.begin(2, (motion, P))

    along = np.diag([1e3, 1e4, 1e5])  # less along a corridor

    def agrees(error_of_motion, error_of_closure=(0.0, 0.0, 0.0)):
        true = compose(compose(at[1], motion + error_of_motion), since)
        pose = between(at[0], true) + np.array(error_of_closure)
        closure = Closure(pose, along, SUPPORT, ClosureStrength.STRONG, 0.9, -np.inf)
        return placer._agrees_with_odometry(PendingClosure(0, 3, closure, 0.0, 1.0), graph)

    noise = rng.multivariate_normal(np.zeros(3), P, 2000)
    of_closure = rng.multivariate_normal(np.zeros(3), np.linalg.inv(along), 2000)
    share = np.mean([agrees(*errors) for errors in zip(noise, of_closure, strict=True)])
    assert 0.98 < share < 0.997
    assert not agrees(np.array([1.0, 0.0, 0.0]))
    assert not agrees(np.array([0.0, 0.0, 0.2]))  # 1.2 m to the side


def test_along_a_bare_corridor_no_place_is_recognised():
    """It looks the same at any place, so that of odometry is assumed after a long search."""
    truth = way((0.0, 0.0), (40.0, 0.0))
    frames = keyframes(room(-2.0, 62.0, -1.2, 1.2), truth)
    cut = 30
    made = begun(truth[0])
    revisions = driven(made, [*frames[:cut], broken(frames[cut]), *frames[cut + 1 :]])
    driven_m = truth[:, 0] - truth[cut, 0]
    placed = [bool(np.all(r.placed)) for r in revisions]
    assert not any(
        p for p, d in zip(placed, driven_m, strict=True) if 0.0 <= d < MIN_SEARCH_DISTANCE
    )
    assert placed[-1]
    assert revisions[-1].assumed


def compared(offset, found, information=FIRM):
    """Return a comparison of a node with the map at its place by odometry."""
    closure = Closure(np.zeros(3), information, SUPPORT, ClosureStrength.STRONG, 0.9, -np.inf)
    return Comparison(offset, PendingClosure(0, 9, closure, 0.0, 1.0) if found else None)


@pytest.mark.parametrize("least", [-1e-12, 0.0, 1e-12, 50.0])
def test_a_closure_along_a_bare_corridor_does_not_tell_the_place(least, rng):
    """Without noise, rounding decides the sign of the least information there."""
    for angle in (0.0, 0.5 * np.pi, *rng.uniform(-np.pi, np.pi, 5)):
        turn = np.eye(3)
        turn[:2, :2] = rotation(angle)
        corridor = compared(1.0, True, turn @ np.diag([least, 1e6, 1e7]) @ turn.T)
        assert _distinct_closure(corridor) is None
        assert np.isfinite(_relation(corridor.closure).covariance).all()
    assert _distinct_closure(compared(1.0, True)) is not None


def test_the_last_node_before_a_break_is_searched_for_loops(lap, monkeypatch):
    searched, search = [], LoopCloser.search
    monkeypatch.setattr(
        LoopCloser,
        "search",
        lambda self, node, *rest: searched.append(node) or search(self, node, *rest),
    )
    made = begun(AGAIN[0])
    driven(made, [*lap[:CUT], broken(lap[CUT]), *lap[CUT + 1 : 2 * CUT]])
    assert searched == list(range(1, len(made._graph) - 1))


@pytest.mark.parametrize(
    ("comparisons", "required"),
    [
        ([(1.0, False)], MIN_CLOSURES),
        ([(1.0, True), (2.0, True), (1.0, False)], np.inf),
        ([(np.inf, False)], MIN_SURPRISING_CLOSURES),
    ],
    ids=["contradicted", "agreeing", "unknown"],
)
def test_a_place_elsewhere_takes_more_while_odometry_may_be_right(comparisons, required):
    placer = SessionPlacer(LoopCloser(LoopSearch()))
    assert placer._required() == MIN_CLOSURES  # odometry does not tell a place
    placer.begin(9, (np.zeros(3), 0.01 * np.eye(3)))
    placer._compared = [compared(*row) for row in comparisons]
    assert placer._required() == required


@pytest.mark.parametrize(
    ("comparisons", "assumed"),
    [
        ([(np.inf, False)] * 9, True),
        ([(1.0, False)] * 2 + [(np.inf, False)] * 7, True),
        ([(1.0, False)] * 3 + [(np.inf, False)] * 12, False),
        ([(1.0, False)] * 3 + [(1.0, True)] * 3 + [(np.inf, False)] * 3, True),
    ],
    ids=["unknown", "a crowd", "carried", "agreeing"],
)
def test_odometry_that_the_map_contradicts_does_not_join_a_session(comparisons, assumed):
    """A robot that was carried soon leaves the map by odometry: unknown areas do not speak for it."""
    placer = SessionPlacer(LoopCloser(LoopSearch()))
    placer.begin(1, (np.zeros(3), np.eye(3)))
    placer._compared = [compared(*row) for row in comparisons]
    nodes = np.arange(2 + len(comparisons))
    keys = SimpleNamespace(nodes=nodes, distance=2.5 * nodes)
    assert placer._may_assume_odometry(int(nodes[-1]), keys) == assumed


@pytest.mark.parametrize(
    ("guess", "place"), [(10.3, 10.3), (4.0, 7.4), (7.6, 7.4)], ids=["nearer", "farther", "same"]
)
def test_of_two_places_that_look_the_same_the_one_near_odometry_is_expected(guess, place):
    """Odometry has the node at 10 m; the window around it also contains the next room, at 7.4 m."""
    graph, at = begun()._graph, np.array([7.4, 0.0, 0.0])
    for x in (0.0, 10.0):
        graph.add_root(np.array([x, 0.0, 0.0]), np.eye(3))

    def closure(pose):
        found = compared(0.0, True).closure
        return found._replace(closure=found.closure._replace(pose=pose))

    closer = LoopCloser(LoopSearch())
    closer.compare = lambda _node, pose, *_: Comparison(0.0, closure(pose))
    placer, pose = SessionPlacer(closer), np.array([guess, 0.0, 0.0])
    nearer = placer._nearer(1, pose, closure(at), None, graph)
    assert nearer.closure.pose[0] == place


def test_a_session_elsewhere_is_not_located(lap):
    """What is seen in another building is nowhere in the map."""
    other = room(0.0, 9.0, 0.0, 7.0)
    other = np.concatenate([other, box(2.0, 5.0, 1.5, 0.7), box(6.0, 1.0, 0.4, 2.2)])
    truth = way((1.0, 1.0), (5.0, 1.0), (5.0, 4.0), (1.0, 4.0), (1.0, 1.0))
    there = [replace(f, id=f.id + len(lap), lost=f.id == 0) for f in keyframes(other, truth)]
    made = begun(AGAIN[0])
    revisions = driven(made, [*lap, *there])
    assert not any(np.any(r.placed) for r in revisions[len(lap) :])
    assert made.counts()["sessions not found"] == 1
    assert np.all(made.refine().placed == (np.arange(len(revisions)) < len(lap)))


OTHER_FLOOR = np.concatenate([
    RING, *SHELVES,
    box(0.4, 10.0, 0.8, 2.0), box(2.1, 7.0, 0.8, 1.5), box(0.4, 4.5, 0.8, 1.2),
])  # fmt: skip
"""With other things along the corridors in the north and in the west."""


@pytest.mark.parametrize(("floor", "joined"), [(RING, True), (OTHER_FLOOR, False)])
def test_a_session_is_not_joined_where_its_earlier_drive_contradicts_the_map(lap, floor, joined):
    """The drive ends in corridors that are equal on both floors."""
    made = begun(AGAIN[0])
    there = keyframes(floor, way(*LAP[2:], *LAP[1:3]))
    there = [replace(f, id=f.id + len(lap), lost=f.id == 0) for f in there]
    revisions = driven(made, [*lap, *there])
    assert np.all(revisions[-1].placed) == joined
    assert made.counts()["sessions not found"] == (0 if joined else 1)


def test_a_frozen_map_stays_and_the_drive_through_it_does_not_drift(lap):
    known = replace(mapped(begun(AGAIN[0]), lap), landmark_covariance=np.eye(2))
    drift = keyframes(RING, TRUTH, drift=(0.0, 0.0, 0.004), rng=np.random.default_rng(5))
    made, builder, n = Graph(), MapBuilder(known, frozen=True), len(known.keyframes)
    made.start(np.zeros(3), models=MODELS)
    made.resume(known, frozen=True)
    for k, given in enumerate(drift, n):
        frame = replace(given, id=k, lost=k == n)
        builder.revise(frame, made.add(frame))
    there = builder.map().revised(made.refine())
    assert made.landmark_covariance() is known.landmark_covariance
    np.testing.assert_array_equal(there.keyframes.poses[:n], known.keyframes.poses)
    np.testing.assert_array_equal(there.grid().logodds, known.grid().logodds)
    assert there.keyframes.placed.all()
    at = [int(np.argmin(np.hypot(*(AGAIN[:, :2] - pose[:2]).T))) for pose in TRUTH]
    off = np.hypot(*(there.keyframes.poses[n:] - known.keyframes.poses[at])[:, :2].T)
    assert off.max() < 0.1
    assert made.landmarks() is known.landmarks


def test_a_map_is_searched_less_often_for_a_session_that_is_not_found_until_a_place_is_likely():
    searched = []

    def find(node, _keys, _graph):
        searched.append(node)
        return Guess(np.zeros(3), likely=node == 60, hinted=False)

    placer = SessionPlacer(SimpleNamespace())
    placer._finder = SimpleNamespace(find=find)
    for node in range(1, 71):
        placer._search(node, None, None)
    assert searched == [*range(1, 21), *range(24, 60, 4), *range(60, 71)]
