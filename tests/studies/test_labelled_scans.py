"""Labels of beams: every beam ends on its thing, and only things that were hit are seen."""

import math

import numpy as np
import pytest

from impslam.geometry.angles import wrap
from impslam.simulation.drive import Trajectory
from impslam.simulation.robot import Lidar
from impslam.simulation.scene import Scene
from impslam.simulation.world import Box, Cylinder, Door, Drive, Wall, World, load_world
from impslam.studies.labelled_scans import (
    DRIVING,
    PEOPLE,
    STANDING,
    Condition,
    Seen,
    labelled_scans,
    take,
)
from impslam.studies.passers_by import SPEED, passing, walker

STILL = Condition("exact", Lidar.perfect(), driving=False, people=0)
MOVING = Condition("exact, driving", Lidar.perfect(), driving=True, people=2)
HALL = World(
    name="hall",
    robot=Drive(start=(0.0, 0.0, 0.0), waypoints=((1.0, 0.0), (1.5, 0.4)), speed=0.5),
    walls=(
        Wall(name="south", start=(-1.0, -1.0), end=(4.0, -1.0)),
        Wall(name="east", start=(4.0, -1.0), end=(4.0, 2.0)),
        Wall(name="north", start=(4.0, 2.0), end=(-1.0, 2.0)),
    ),
    cylinders=(Cylinder(name="post", centre=(2.5, 1.0), radius=0.15),),
    boxes=(Box(centre=(3.0, -0.8), size=(0.4, 0.3), angle=0.2),),
    doors=(
        Door(wall="north", at=1.0),
        Door(wall="south", at=1.2, open=((-9.0, math.inf),), room=(2.0, 2.0)),
    ),
)


def off(seen: Seen, places):
    """Return how far places (n, 2) are from a thing."""
    if seen.kind == "wall":
        return np.abs(places @ [math.cos(seen.z[1]), math.sin(seen.z[1])] - seen.z[0])
    return np.abs(np.hypot(*(places - seen.z).T) - seen.radius)


@pytest.mark.parametrize("condition", [STILL, MOVING], ids=lambda condition: condition.name)
def test_exact_scans_lie_on_what_they_hit(condition):
    kinds = set()
    for labelled in labelled_scans(HALL, condition, 3, 12):
        scan = labelled.scan
        u = np.column_stack((np.cos(labelled.directions), np.sin(labelled.directions)))
        places = labelled.origins + scan.ranges[:, None] * u
        labels = np.concatenate([seen.beams for seen in labelled.seen])
        assert sorted(labels) == np.flatnonzero(scan.valid).tolist()  # each beam once
        for seen in labelled.seen:
            kinds.add(seen.thing)
            moved = 0.1 if seen.thing == "person" else 1e-9  # people walk during the sweep
            assert off(seen, places[seen.beams]).max() < moved
    assert kinds >= {"wall", "cylinder", "box", "doorway", "door"}
    assert ("person" in kinds) == (condition.people > 0)


def test_the_scan_is_where_the_exact_rays_are():
    """De-skewing with the mean twist leaves less than a few millimetres, in turns."""
    for labelled in labelled_scans(load_world("arena"), MOVING, 0, 10):
        scan = labelled.scan
        np.testing.assert_allclose(scan.origins, labelled.origins, atol=2e-3)
        np.testing.assert_allclose(wrap(scan.directions - labelled.directions), 0.0, atol=3e-3)


def test_a_cylinder_is_hit_within_its_angle_and_nowhere_else():
    (labelled,) = labelled_scans(HALL, STILL, 0, 1)
    (post,) = [seen for seen in labelled.seen if seen.thing == "cylinder"]
    scan = labelled.scan
    sight = post.z - scan.laser[:2]
    away = wrap(scan.directions - math.atan2(sight[1], sight[0]))
    inside = np.flatnonzero(np.abs(away) < math.asin(0.15 / np.hypot(*sight)))
    np.testing.assert_array_equal(post.beams, inside)


@pytest.mark.parametrize(
    ("bearing", "first", "whole"),
    [
        (0.0, -2.0, True),
        (4.3, -2.0, False),
        (-4.3, -2.0, False),
        (8.0, -2.0, True),
        (8.0, -0.05, False),
    ],
)
def test_whole_cylinders_are_cut_by_nothing(bearing, first, whole):
    """2 m away and 4.3 degrees to each side; a thin post stands before it, or the scan ends."""
    turn = math.radians(bearing)
    thin = Cylinder(centre=(0.15 + math.cos(turn), math.sin(turn)), radius=0.02)
    world = World(robot=HALL.robot, cylinders=(Cylinder(centre=(2.15, 0.0), radius=0.15), thin))
    still = Trajectory(np.array([0.0, 9.0]), np.zeros((2, 3)), np.zeros((1, 2)))
    lidar = Lidar.perfect(angle_min=first)
    labelled = take(Scene(world), still, 0.0, lidar, np.random.default_rng(0))
    assert [seen.whole for seen in labelled.seen if seen.radius == 0.15] == [whole]


def test_truth_is_seen_from_the_robot():
    """Observed as z is: normal into the wall, centre in base_link; scaled by what beams read."""
    for labelled in labelled_scans(HALL, STILL, 1, 8):
        laser = labelled.scan.laser[:2]
        for seen in labelled.seen:
            if seen.kind == "wall":
                assert laser @ [math.cos(seen.z[1]), math.sin(seen.z[1])] <= seen.z[0] + 1e-12
                np.testing.assert_allclose(off(seen, seen.ends), 0.0, atol=1e-12)


def test_visible_is_a_landmark_of_which_enough_is_seen():
    def wall(thing, beams, span):
        ends = np.array([[1.0, 0.0], [1.0, span]])
        return Seen(thing, "wall", np.array([1.0, 0.0]), math.nan, ends, np.arange(beams))

    def round_(thing, beams):
        return Seen(thing, "cylinder", np.ones(2), 0.1, np.zeros((2, 2)), np.arange(beams))

    assert wall("wall", 10, 0.3).visible
    assert wall("room", 10, 0.3).visible
    assert not wall("wall", 9, 0.3).visible
    assert not wall("wall", 10, 0.29).visible
    assert not wall("door", 50, 2.0).visible
    assert round_("cylinder", 5).visible
    assert not round_("cylinder", 4).visible
    assert not round_("person", 40).visible


def test_conditions_share_their_places_and_a_seed_repeats_itself():
    world = load_world("room")
    one, again, crowd = (
        list(labelled_scans(world, condition, 5, 4)) for condition in (DRIVING, DRIVING, PEOPLE)
    )
    for first, second, crowded in zip(one, again, crowd, strict=True):
        np.testing.assert_array_equal(first.scan.ranges, second.scan.ranges)
        assert first.scan.stamp == crowded.scan.stamp
        walls = {tuple(seen.z) for seen in first.seen if seen.thing == "wall"}
        assert {tuple(seen.z) for seen in crowded.seen if seen.thing == "wall"} <= walls
    (other,) = labelled_scans(world, DRIVING, 6, 1)
    assert other.scan.stamp != one[0].scan.stamp


def test_people_stand_in_sight():
    rng = np.random.default_rng(0)
    scene = Scene(load_world("arena"))
    for time in (0.0, 0.3, 30.0):
        people = passing(scene, np.array([0.0, 1.0, 0.0]), time, 2, rng)
        crowd = Scene(scene.world.model_copy(update={"people": people}))
        for x, y, radius in crowd.legs(time):
            assert scene.clearance(np.array([x, y]), time) > radius
            assert math.dist((x, y), (0.0, 1.0)) > 0.4


def test_noise_and_the_common_error_match_the_settings():
    """Of beams that hit walls at less than 60 degrees, so that noise is what is left."""
    lidar = Lidar(divergence=0.0, dropout=0.0)
    condition = Condition("biased", lidar, driving=False, people=0)
    means, chi = [], []
    for labelled in labelled_scans(load_world("arena"), condition, 0, 60):
        (best,) = [max(labelled.seen, key=lambda seen: len(seen.beams))]
        beams = best.beams
        cosine = np.cos(labelled.directions[beams] - best.z[1])
        from_origin = best.z[0] - labelled.origins[beams] @ [
            math.cos(best.z[1]),
            math.sin(best.z[1]),
        ]
        error = labelled.scan.ranges[beams] - from_origin / cosine
        weights = labelled.sigmas[beams] ** -2.0
        means.append(np.sum(weights * error) / np.sum(weights))
        chi.append(np.mean(weights * (error - means[-1]) ** 2))
    assert np.mean(chi) == pytest.approx(1.0, abs=0.05)
    assert np.sqrt(np.mean(np.square(means))) == pytest.approx(lidar.bias_sigma, rel=0.35)
    assert labelled.bias == lidar.bias_sigma
    assert STANDING.lidar.bias_sigma == 0.0


def test_people_at_the_beginning_start_with_the_run():
    """Not a rounding error after it, which no world accepts."""
    for time in np.random.default_rng(0).uniform(0.01, 0.8, 500):
        person = walker(np.zeros(2), float(time), 0.3)
        assert person.start == 0.0
        assert np.hypot(*person.waypoints[0]) == pytest.approx(SPEED * time)
    assert walker(np.zeros(2), 3.0, 0.3).start == pytest.approx(3.0 - 1.0 / SPEED)
