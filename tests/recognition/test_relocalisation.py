"""A scan is found anywhere in a map, or it is told that it cannot be."""

import math

import numpy as np
import pytest
from tests.extractors.scans import room
from tests.recognition.halls import LASER, mapped, seen
from tests.recognition.plans import OFFICE, walls, way

from impslam.errors import ConfigError, ShapeError
from impslam.geometry.angles import wrap
from impslam.geometry.se2 import between, compose
from impslam.recognition.beams import Explanation
from impslam.recognition.drive import DriveRelocaliser
from impslam.recognition.relocalisation import Near, Relocaliser, Verdict, answer
from impslam.recognition.stored_views import stored_views
from impslam.recognition.submap import view

WAY = np.concatenate([
    way(-7.0, -0.3, 8.0, -0.2, 20), way(-2.5, 0.0, -2.5, 5.0, 6), way(3.6, 0.0, 3.6, 5.0, 6),
    way(-4.5, -1.0, -4.5, -4.0, 5), way(1.5, -1.0, 1.5, -4.0, 5),
])  # fmt: skip
TWINS = np.concatenate([  # two like rooms along a corridor that only differs far to the right
    room(0.0, 14.0, 0.0, 2.0)[[0, 2, 3]],
    walls([0, 2, 2, 2], [3, 2, 8, 2], [9, 2, 14, 2]),
    *(np.concatenate([room(x, x + 5.0, 2.0, 6.0)[:3], walls([x + 1, 5, x + 2, 5.5])]) for x in (0, 6)),
])  # fmt: skip
TWIN_WAY = np.concatenate([
    way(1.0, 1.0, 13.0, 1.0, 14), way(2.5, 1.0, 2.5, 5.0, 6), way(8.5, 1.0, 8.5, 5.0, 6)
])  # fmt: skip
NOTHING = np.zeros(3), np.zeros((3, 3))


@pytest.fixture(scope="module")
def office():
    return Relocaliser(mapped(OFFICE, WAY))


@pytest.fixture(scope="module")
def twins():
    return Relocaliser(mapped(TWINS, TWIN_WAY))


def assert_at(pose, truth, metres=0.05, radians=0.01):
    assert math.dist(pose[:2], truth[:2]) < metres
    assert abs(wrap(pose[2] - truth[2])) < radians


@pytest.mark.parametrize(
    "truth", [[-4.5, -2.0, 2.0], [5.0, 0.2, -1.2], [-2.7, 4.0, 0.4], [1.2, -3.2, 3.0]]
)
def test_a_scan_is_found_anywhere(office, truth):
    answer = office.find(view(seen(OFFICE, truth)))
    assert answer.verdict == Verdict.FOUND
    assert_at(answer.hypotheses[0].pose, truth)
    assert (
        0.98
        <= answer.hypotheses[0].probability
        <= sum(h.probability for h in answer.hypotheses)
        <= 1.0
    )


def test_a_scan_among_chairs_is_found(office):
    """Three in ten of its beams end on or beside their legs, which the map hardly shows."""
    truth = [-4.5, -2.0, 2.0]
    scan, rng = seen(OFFICE, truth), np.random.default_rng(1)
    on_leg = rng.random(len(scan.ranges)) < 0.3
    share = np.where(on_leg, rng.uniform(0.3, 0.9, len(scan.ranges)), 1.0)
    scan.ranges[:] *= share
    scan.points[:] = scan.origins + share[:, None] * (scan.points - scan.origins)
    answer = office.find(view(scan))
    assert answer.verdict == Verdict.FOUND
    assert_at(answer.hypotheses[0].pose, truth)


def test_a_scan_of_another_building_is_nowhere(office):
    other = np.concatenate([room(0.0, 9.0, 0.0, 5.5), walls([3, 0, 4, 3], [6, 5.5, 5, 4])])
    answer = office.find(view(seen(other, [2.0, 2.5, 0.3])))
    assert answer.verdict == Verdict.NOWHERE
    assert sum(h.probability for h in answer.hypotheses) < 0.02


def test_similar_rooms_are_ambiguous_until_the_drive_distinguishes_them(twins):
    drive = np.concatenate([way(8.5, 4.0, 8.5, 1.2, 6), way(8.8, 1.0, 11.0, 1.0, 5)])
    finder, before = DriveRelocaliser(twins), drive[0]
    answers = []
    for k, pose in enumerate(drive):
        motion, spread = between(before, pose), np.diag([1e-4, 1e-4, 1e-6])
        answers.append(finder.add(view(seen(TWINS, pose, 100 + k)), motion, spread))
        before = pose
    first, last = answers[0], answers[-1]
    assert first.verdict == Verdict.AMBIGUOUS
    probabilities = [h.probability for h in first.hypotheses[:2]]
    assert sum(probabilities) > 0.98
    assert min(probabilities) > 0.1
    assert last.verdict == Verdict.FOUND
    assert_at(last.hypotheses[0].pose, drive[-1])
    wrong = [a for a, pose in zip(answers, drive, strict=True) if _silently_wrong(a, pose)]
    assert wrong == []


def _silently_wrong(answer, truth):
    return answer.verdict == Verdict.FOUND and (
        math.dist(answer.hypotheses[0].pose[:2], truth[:2]) > 0.3
    )


def test_a_hint_distinguishes_similar_rooms(twins):
    truth = np.array([2.5, 4.0, -1.5])
    scan = view(seen(TWINS, truth))
    assert twins.find(scan).verdict == Verdict.AMBIGUOUS
    answer = twins.find(scan, Near(np.array([2.0, 3.5]), 2.0))
    assert answer.verdict == Verdict.FOUND
    assert_at(answer.hypotheses[0].pose, truth)


def test_too_few_points_fit_anywhere(office):
    scan = seen(OFFICE, [-6.2, -0.1, 2.0])
    scan.valid[20:] = False
    answer = office.find(view(scan))
    assert answer.verdict == Verdict.AMBIGUOUS
    assert answer.hypotheses == ()
    assert office.locate(np.empty((0, 2))).verdict == Verdict.AMBIGUOUS


def test_in_an_empty_map_a_scan_is_nowhere():
    lost = mapped(OFFICE, WAY[:2])
    lost.placed[:] = False
    answer = Relocaliser(lost).find(view(seen(OFFICE, WAY[0])))
    assert answer.verdict == Verdict.NOWHERE
    assert answer.hypotheses == ()


def test_keyframes_that_are_not_placed_are_no_part_of_the_map():
    keyframes = mapped(OFFICE, WAY[:20])
    keyframes.placed[10:] = False
    keyframes.poses[10:] = np.nan
    truth = np.array([-5.0, -0.2, 2.0])
    answer = Relocaliser(keyframes).find(view(seen(OFFICE, truth)))
    assert answer.verdict == Verdict.FOUND
    assert_at(answer.hypotheses[0].pose, truth)


def test_a_stored_scan_is_what_was_seen():
    poses = WAY[:3]
    kept = stored_views(mapped(OFFICE, poses))
    for k, pose in enumerate(poses):
        fresh = view(seen(OFFICE, pose, k))
        np.testing.assert_allclose(kept[k].features, fresh.features, atol=1e-4)
        same = np.isclose(kept[k].free, fresh.free, atol=1e-4)
        assert same.mean() > 0.85  # float32 moves a beam on the border of two bins to either
        np.testing.assert_allclose(kept[k].laser, LASER[:2])


def test_scans_with_uncertain_motions_are_not_joined(office):
    finder, blind = DriveRelocaliser(office), np.diag([1.0, 1.0, 0.1])
    for truth in ([-4.5, -2.0, 2.0], [5.0, 0.2, -1.2]):  # carried away: the motion is false
        answer = finder.add(view(seen(OFFICE, truth)), NOTHING[0], blind)
        assert answer.verdict == Verdict.FOUND
        assert_at(answer.hypotheses[0].pose, truth)


def test_poses_are_those_of_base_link(office):
    turned = compose(np.array([-6.2, -0.1, 0.0]), np.array([0.0, 0.0, math.pi / 2]))
    assert_at(office.find(view(seen(OFFICE, turned))).hypotheses[0].pose, turned)


@pytest.mark.parametrize(
    ("points", "laser", "why"),
    [
        (np.zeros((50, 3)), (0.0, 0.0), "points has shape"),
        (np.full((50, 2), np.inf), (0.0, 0.0), "leave out beams without a range"),
        (np.ones((50, 2)), (0.0, 0.0, 0.0), "laser has shape"),
        ("scan", (0.0, 0.0), "points: 'scan'"),
    ],
)
def test_unusable_scans_are_refused(office, points, laser, why):
    with pytest.raises(ShapeError, match=why):
        office.locate(points, laser)


@pytest.mark.parametrize(
    ("near", "error", "why"),
    [
        (Near([math.nan, 1.0], 2.0), ShapeError, r"near\.place\[0\] is nan"),
        (Near([1.0], 2.0), ShapeError, r"near\.place has shape \(1,\); expected \(2,\)"),
        (Near("here", 2.0), ShapeError, r"near\.place: 'here' is of type"),
        (Near([1.0, 1.0], -1.0), ConfigError, r"near\.radius = -1: give a positive"),
        (Near([1.0, 1.0], math.nan), ConfigError, r"near\.radius = nan"),
        (Near([1.0, 1.0], math.inf), ConfigError, r"near\.radius = inf"),
        (Near([1.0, 1.0], [1.0, 2.0]), ShapeError, r"near\.radius has shape"),
        (([1.0, 1.0], 2.0), ConfigError, r"near = \(\[1\.0, 1\.0\], 2\.0\): expected Near"),
    ],
)
def test_unusable_hints_are_refused(office, near, error, why):
    with pytest.raises(error, match=why) as caught:
        office.locate(np.zeros((0, 2)), near=near)
    assert "\n" not in str(caught.value)


def test_a_hint_may_be_a_list_and_a_pose(office):
    truth = [-4.5, -2.0, 2.0]
    scan = view(seen(OFFICE, truth))
    answers = [office.find(scan, Near(place, 1)) for place in (truth, truth[:2])]
    for found in answers:
        assert_at(found.hypotheses[0].pose, truth)


def test_what_is_no_keyframes_is_refused():
    with pytest.raises(ConfigError, match=r"'map\.imp': expected the keyframes of a Map"):
        Relocaliser("map.imp")


@pytest.mark.parametrize(("unknown", "verdict"), [(0.0, Verdict.FOUND), (0.08, Verdict.AMBIGUOUS)])
def test_a_twin_that_is_mapped_in_part_is_not_excluded(unknown, verdict):
    """Its score is lower only because the map does not show what some beams end on."""
    places = np.array([[8.2, 20.4, -1.7], [7.3, 12.1, 1.4]])
    whole = Explanation(0.92, 0.98, 0.02, 0.0, 0.0)
    part = Explanation(0.73, 0.84, 0.08 - unknown, 0.08, unknown)
    told = answer([(whole, places[0]), (part, places[1])], 200.0, complete=True, whole=True)
    assert told.verdict == verdict
    assert told.hypotheses[0].probability >= told.hypotheses[1].probability


SEEN = Explanation(
    0.6, 0.72, 0.03, 0.05, 0.0
)  # of a scan with 50 points: 0.82 is reached by chance
FAR = np.array([[1.0, 2.0, 0.5], [9.0, 4.0, -1.0]])


@pytest.mark.parametrize(
    ("second", "whole", "verdict"),
    [(0.15, True, Verdict.FOUND), (0.25, True, Verdict.NOWHERE), (0.15, False, Verdict.NOWHERE)],
)
def test_a_clear_lead_in_the_whole_map_is_no_chance(second, whole, verdict):
    places = [(SEEN, FAR[0]), (SEEN._replace(score=second), FAR[1])]
    assert answer(places, 50.0, complete=True, whole=whole).verdict == verdict


def test_a_place_that_many_beams_contradict_may_be_chance_in_spite_of_its_lead():
    """In an office that is not in the map, the best of several that look alike led by 0.8."""
    best = Explanation(0.58, 0.82, 0.09, 0.08, 0.01)
    places = [(best, FAR[0]), (best._replace(score=-0.25), FAR[1])]
    assert answer(places, 75.0, complete=True, whole=True).verdict == Verdict.AMBIGUOUS


@pytest.mark.parametrize(("points", "verdict"), [(150.0, Verdict.FOUND), (60.0, Verdict.NOWHERE)])
def test_beams_that_end_in_unknown_space_neither_count_nor_support(points, verdict):
    part = Explanation(0.45, 0.5, 0.0, 0.0, 0.5)
    assert answer([(part, FAR[0])], points, complete=True, whole=True).verdict == verdict
