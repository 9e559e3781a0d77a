"""The corridor: what counts as a wall, a person, a false landmark; and that one seed goes through."""

import json
import math

import numpy as np
import pytest

from impslam.geometry.se2 import inverse, transform
from impslam.simulation.robot import Lidar
from impslam.simulation.simulate import simulate
from impslam.simulation.world import parse_world
from impslam.studies import corridor
from impslam.studies.base import Job
from impslam.studies.corridor_plot import corridor_png
from impslam.studies.corridor_runs import (
    DEFAULT,
    EXTRACTORS,
    HOUGH,
    LIKELY,
    RANSAC,
    READINGS,
    ROBOT,
    WAYS,
    Birth,
    CorridorRun,
    Drive,
    Tally,
    corridor_world,
    count,
    drive_corridor,
    judge_extractors,
    map_corridor,
)
from impslam.studies.corridor_tables import (
    WITHIN,
    collect,
    extractor_tallies,
    figures,
    map_table,
    path_table,
    total,
)
from impslam.studies.corridor_truth import Truth, Verdict, false_landmarks, judge
from impslam.types import Landmark, Observation

ROOM = """
[robot]
start = [0.0, 0.0, 0.0]
waypoints = [[1.0, 0.0]]

[[walls]]
name = "north"
start = [4.0, 1.5]
end = [-4.0, 1.5]

[[walls]]
name = "south"
start = [-4.0, -1.5]
end = [4.0, -1.5]

[[doors]]
wall = "south"
at = 5.0
recess = 0.08

[[cylinders]]
centre = [2.0, 1.0]
radius = 0.12

[[people]]
waypoints = [[2.5, -0.5], [2.5, 0.5]]
start = 100.0
"""

RANSAC_ALONE = "RANSAC"


@pytest.fixture(scope="module")
def truth():
    return Truth(parse_world(ROOM, "room"), Lidar())


@pytest.fixture(scope="module")
def moment(truth):
    return truth.moment(0.0)


def beams_on(moment, *kinds):
    known = [i >= 0 and moment.kinds[i] in kinds for i in moment.hits.tolist()]
    return np.flatnonzero(known)


def wall(moment, start, end, beams):
    """Return the wall from start to end (map) as an observation on some beams."""
    ends = transform(inverse(moment.pose), np.array([start, end]))
    along = (ends[1] - ends[0]) / np.hypot(*(ends[1] - ends[0]))
    normal = np.array([along[1], -along[0]])
    z = np.array([normal @ ends[0], math.atan2(normal[1], normal[0])])
    return Observation("wall", z, np.eye(2), beams, ends)


def point(moment, kind, place, beams):
    z = transform(inverse(moment.pose), np.array([place]))[0]
    return Observation(kind, z, np.eye(2), beams)


def south(moment):
    beams = beams_on(moment, "wall", "door", "doorway")
    return beams[beams < len(moment.hits) // 2]  # counter-clockwise from behind on the right


# ------------------------------------------------------------------------------- observations


def test_beams_meet_what_is_there(moment):
    assert {moment.kinds[i] for i in moment.hits if i >= 0} == {
        *("wall", "door", "doorway", "cylinder", "person")
    }
    np.testing.assert_allclose(moment.people, [[2.5, -0.5]])


def test_a_wall_with_its_shut_door_is_one(moment):
    seen = wall(moment, (-1.0, -1.5), (3.5, -1.5), south(moment))
    assert judge(moment, seen) == Verdict(person=False, touched=False, false=False)


@pytest.mark.parametrize("turn", [-9.0, 9.0])
def test_a_wall_off_by_less_than_a_bin_is_the_wall(moment, turn):
    rise = 0.5 * math.tan(math.radians(turn))
    assert not judge(moment, wall(moment, (0, -1.5 - rise), (1, -1.5 + rise), south(moment))).false


@pytest.mark.parametrize("turn", [-11.0, 11.0, 90.0])
def test_a_wall_off_by_more_is_none(moment, turn):
    way = 0.5 * np.array([math.cos(math.radians(turn)), math.sin(math.radians(turn))])
    middle = np.array([0.5, -1.5])
    assert judge(moment, wall(moment, middle - way, middle + way, south(moment))).false


def test_a_wall_beside_the_wall_is_none(moment):
    assert not judge(moment, wall(moment, (0, -1.69), (1, -1.69), south(moment))).false
    assert judge(moment, wall(moment, (0, -1.71), (1, -1.71), south(moment))).false


def test_a_line_across_the_passage_is_none(moment):
    """As RANSAC draws it: half of its readings on one wall, half on the other."""
    beams = np.concatenate((south(moment)[:20], beams_on(moment, "wall")[-21:]))
    assert judge(moment, wall(moment, (0.0, -1.5), (0.5, 1.5), beams)).false


def test_whoever_is_taken_for_something_is_a_person(moment):
    legs = beams_on(moment, "person")
    for kind in ("cylinder", "corner"):
        seen = judge(moment, point(moment, kind, (2.5, -0.5), legs))
        assert seen == Verdict(person=True, touched=True, false=True)
    assert judge(moment, wall(moment, (2.44, -0.7), (2.44, -0.3), legs)).person


def test_what_lies_where_someone_is_is_the_person_though_beams_say_else(moment):
    beams = beams_on(moment, "wall")
    assert judge(moment, point(moment, "corner", (2.5, -0.2), beams)).person
    assert not judge(moment, point(moment, "corner", (2.5, 0.0), beams)).person


def test_a_wall_behind_someone_is_no_person(moment):
    beams = np.concatenate((south(moment), beams_on(moment, "person")))
    seen = judge(moment, wall(moment, (-1.0, -1.5), (3.5, -1.5), beams))
    assert seen == Verdict(person=False, touched=True, false=False)


def test_points(moment):
    beams = beams_on(moment, "cylinder")
    assert not judge(moment, point(moment, "cylinder", (2.05, 1.05), beams)).false
    assert judge(moment, point(moment, "cylinder", (2.15, 1.0), beams)).false
    assert judge(moment, point(moment, "corner", (2.0, 1.0), beams)).false
    assert not judge(moment, point(moment, "corner", (1.0, -1.45), beams)).false


# ------------------------------------------------------------------------------- maps


def mark(number, kind, ends=None, position=(0.0, 0.0)):
    ends = None if ends is None else np.array(ends, float)
    return Landmark(number, kind, np.array(position, float), {}, np.eye(2), ends, 9, 0.0, 1.0)


def test_false_landmarks_of_a_map(truth):
    landmarks = (
        mark(0, "wall", [[-3, -1.5], [3, -1.5]]),
        mark(1, "wall", [[-3, -1.1], [3, -1.1]]),  # the door's leaf is 0.48 m behind
        mark(2, "wall", [[4.5, 1.5], [6, 1.5]]),  # in line with a wall, beyond its end
        mark(3, "wall", [[-3, -1.75], [3, -1.2]]),  # 5.2 degrees
        mark(4, "cylinder", position=(2.2, 1.0)),
        mark(5, "cylinder", position=(2.3, 1.0)),
        mark(6, "corner", position=(4.0, 1.3)),
        mark(7, "corner", position=(0.0, 0.0)),
        mark(8, "wall", [[3, 1.6], [-3, 1.6]]),
    )
    assert false_landmarks(truth, landmarks) == (1, 2, 3, 5, 7)


def test_tallies():
    good, bad = Verdict(False, False, False), Verdict(False, False, True)
    leg = Verdict(True, True, True)
    assert count([]) == Tally(1, 0, 0, 0, 0)
    assert count([good, bad, leg]) == Tally(1, 3, 2, 1, 1)
    assert total([count([good]), count([bad])]) == Tally(2, 2, 1, 0, 1)


def run_that_ends(off, births=()):
    truth = np.column_stack((np.linspace(0, 100, 11), np.zeros(11), np.zeros(11)))
    path = truth + np.array([0.0, off, 0.0])
    return CorridorRun(path, truth + 5.0, truth, (), tuple(births), (), ())


def test_a_path_holds_until_it_is_off_for_the_first_time():
    run = run_that_ends(0.5)
    assert run.holds(0.6) == pytest.approx(100.0)
    assert run.holds(0.4) == 0.0
    run.path[:4, 1] = 0.0
    assert run.holds(0.4) == pytest.approx(40.0)


def test_what_the_tables_say():
    leg = Birth(1, "cylinder", 0.0, Verdict(True, True, True))
    drives = [
        Drive(
            seed, {DEFAULT: run_that_ends(off, births)}, {"split and merge": Tally(2, 4, 1, 0, 1)}
        )
        for seed, (off, births) in enumerate([(0.1, ()), (0.5, (leg,)), (0.51, ())])
    ]
    made = collect(drives)
    path, mapped = path_table(made), map_table(made, extractor_tallies(drives))
    first, wheels = path.rows
    assert list(first) == [
        *(DEFAULT, "0.500 [0.100, 0.510]", "2 of 3", "0.500 [0.100, 0.510]", "100"),
    ]
    assert list(wheels) == ["wheels alone", "7.071 [7.071, 7.071]", "0 of 3", wheels[3], ""]
    assert wheels[3] == "7.071 [7.071, 7.071]"
    assert [list(row) for row in mapped.rows] == [
        [DEFAULT, "0.5000", "0.33", "0.33", "0.33", "0.00", "0.00"]
    ]
    assert all(len(row) == len(table.header) for table in (path, mapped) for row in table.rows)
    assert figures(drives)[DEFAULT]["people_ever"] == [0, 1, 0]
    json.dumps(figures(drives), allow_nan=False)


# ------------------------------------------------------------------------------- runs


@pytest.fixture(scope="module")
def messages():
    """The first 17 s of the corridor: someone comes towards the robot, someone overtakes it."""
    world = corridor_world()
    short = world.model_copy(update={"robot": world.robot.model_copy(update={"limit": 17.0})})
    return list(simulate(short, ROBOT, 3))


def test_the_default_maps_the_beginning(messages):
    run = map_corridor(messages, WAYS[DEFAULT], 3)
    assert 5.0 < run.way < 10.0
    assert run.end < 0.05
    assert (run.people, run.false_births, run.false) == (0, 0, ())
    kinds = {birth.kind for birth in run.births}
    assert kinds >= {"wall", "corner"}
    assert len(run.births) >= len(run.landmarks) > 5


def test_births_are_those_of_the_map(messages):
    run = map_corridor(messages, WAYS[HOUGH], 3)
    assert {birth.kind for birth in run.births} == {"wall"}
    assert {mark.id for mark in run.landmarks} <= {birth.id for birth in run.births}
    stamps = [birth.stamp for birth in run.births]
    assert stamps == sorted(stamps)


def test_ransac_sees_more_that_is_not_there_than_the_others(messages):
    tallies = judge_extractors(messages, 3, every=2)
    assert len({tally.scans for tally in tallies.values()}) == 1
    rates = {name: tally.spurious / tally.scans for name, tally in tallies.items()}
    worst = rates.pop(RANSAC_ALONE)
    assert worst > 0.05
    assert all(worst > 2.0 * rate for rate in rates.values())


def test_the_picture_is_the_same_bytes_each_time(messages):
    run = map_corridor(messages, WAYS[HOUGH], 3)
    png = corridor_png({"one": run}, dpi=30)
    assert png.startswith(b"\x89PNG")
    assert png == corridor_png({"one": run}, dpi=30)


def test_every_seed_is_driven_once_few_by_every_way_and_fewer_are_read_otherwise(monkeypatch):
    made = {name: run_that_ends(0.1) for name in WAYS}
    tallies = dict.fromkeys(EXTRACTORS, Tally(2, 4, 1, 0, 1))

    def drive(seed, ways=tuple(WAYS)):
        return Drive(seed, {name: made[name] for name in ways}, tallies)

    monkeypatch.setattr(corridor, "drive_corridor", drive)
    monkeypatch.setattr(
        corridor, "read_otherwise", lambda seed: dict.fromkeys(READINGS, made[HOUGH])
    )
    told = []
    seeds, every = corridor.EVERY_WAY + 4, corridor.EVERY_WAY
    part = corridor.corridor(Job(seeds, tick=lambda what, done, total: told.append((done, total))))
    steps = (every, 4, corridor.READ)
    assert told == [(i, total) for total in steps for i in range(total + 1)]
    assert part.figures["seeds"] == list(range(seeds))
    assert len(part.figures[DEFAULT]["end"]) == seeds
    assert len(part.figures[HOUGH]["end"]) == every
    assert [len(table.rows) for table in part.tables] == [5, 4, 4, len(READINGS)]
    assert {picture.name for picture in part.pictures} == {"corridor", "corridor-ransac"}
    json.dumps(part.figures, allow_nan=False)


@pytest.mark.slow
def test_the_default_comes_back_and_the_thesis_does_not():
    drive = drive_corridor(0)
    default, hough, likely, ransac = (drive.runs[way] for way in (DEFAULT, HOUGH, LIKELY, RANSAC))
    assert default.wheels > 3.0
    assert max(default.end, likely.end) < WITHIN * default.way
    assert (default.people, default.false_births, default.missing) == (0, 0, ())
    assert 20.0 < hough.holds(WITHIN * hough.way) < 60.0
    assert ransac.holds(WITHIN * ransac.way) < 20.0
    assert ransac.false_births > 10
