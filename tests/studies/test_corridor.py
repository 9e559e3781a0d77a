"""The corridor: classification of walls, people and false landmarks, and a run of one seed."""

import json
import math

import numpy as np
import pytest
from tests.studies.worlds import beginning

from impslam.evaluation.json_values import json_values
from impslam.geometry.se2 import inverse, transform
from impslam.map import PathRows
from impslam.simulation.robot import Lidar
from impslam.simulation.simulate import simulate
from impslam.simulation.world import parse_world
from impslam.studies import corridor
from impslam.studies.corridor import map_table, numbers, path_table
from impslam.studies.corridor_metrics import (
    DEFAULT,
    HOUGH,
    MAX_DRIFT,
    READINGS,
    VARIANTS,
    corridor_metrics,
    distance_held,
)
from impslam.studies.corridor_truth import (
    Classification,
    CorridorTruth,
    corridor_world,
    false_landmarks,
    judge,
)
from impslam.studies.corridor_walls import COUNTS, EXTRACTORS, count_walls, tally, total_counts
from impslam.studies.map_plot import CORRIDOR, draw_maps
from impslam.studies.sweep import StudyRun, map_run, path_metrics, sweep
from impslam.sweeps.cases import ROBOT
from impslam.sweeps.job import Job
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


@pytest.fixture(scope="module")
def truth():
    return CorridorTruth(parse_world(ROOM, "room"), Lidar())


@pytest.fixture(scope="module")
def sweep_(truth):
    return truth.sweep(0.0)


@pytest.fixture(scope="module")
def beams_on(truth, sweep_):
    """Return the beams that hit things of some kinds."""
    things = truth.scene.things

    def beams(*kinds):
        return np.flatnonzero([i >= 0 and things[i].kind in kinds for i in sweep_.hits.tolist()])

    return beams


@pytest.fixture(scope="module")
def south(sweep_, beams_on):
    """The beams on the south wall with its door."""
    beams = beams_on("wall", "door", "doorway")
    return beams[beams < len(sweep_.hits) // 2]  # counter-clockwise from behind on the right


def wall(sweep_, start, end, beams):
    """Return the wall from start to end (map) as an observation on some beams."""
    ends = transform(inverse(sweep_.pose), np.array([start, end]))
    along = (ends[1] - ends[0]) / np.hypot(*(ends[1] - ends[0]))
    normal = np.array([along[1], -along[0]])
    z = np.array([normal @ ends[0], math.atan2(normal[1], normal[0])])
    return Observation("wall", z, np.eye(2), beams, ends)


def point(sweep_, kind, place, beams):
    z = transform(inverse(sweep_.pose), np.array([place]))[0]
    return Observation(kind, z, np.eye(2), beams)


# ------------------------------------------------------------------------------- observations


def test_beams_hit_the_true_things(truth, sweep_):
    assert {truth.scene.things[i].kind for i in sweep_.hits if i >= 0} == {
        *("wall", "door", "doorway", "cylinder", "person")
    }
    legs = sweep_.hits >= len(sweep_.round) - len(sweep_.legs)
    assert {truth.scene.things[i].kind for i in sweep_.hits[legs]} == {"person"}
    np.testing.assert_allclose(sweep_.legs[:, :2].mean(axis=0), [2.5, -0.5])


def test_a_wall_with_its_shut_door_is_one(sweep_, south):
    seen = wall(sweep_, (-1.0, -1.5), (3.5, -1.5), south)
    assert judge(sweep_, seen) == Classification(person=False, touched=False, false=False)


@pytest.mark.parametrize("turn", [-9.0, 9.0])
def test_a_wall_off_by_less_than_a_bin_is_the_wall(sweep_, turn, south):
    rise = 0.5 * math.tan(math.radians(turn))
    assert not judge(sweep_, wall(sweep_, (0, -1.5 - rise), (1, -1.5 + rise), south)).false


@pytest.mark.parametrize("turn", [-11.0, 11.0, 90.0])
def test_a_wall_off_by_more_is_none(sweep_, turn, south):
    way = 0.5 * np.array([math.cos(math.radians(turn)), math.sin(math.radians(turn))])
    middle = np.array([0.5, -1.5])
    assert judge(sweep_, wall(sweep_, middle - way, middle + way, south)).false


def test_a_wall_beside_the_wall_is_none(sweep_, south):
    assert not judge(sweep_, wall(sweep_, (0, -1.69), (1, -1.69), south)).false
    assert judge(sweep_, wall(sweep_, (0, -1.71), (1, -1.71), south)).false


def test_a_line_across_the_passage_is_none(sweep_, beams_on, south):
    """As RANSAC draws it: half of its readings on one wall, half on the other."""
    beams = np.concatenate((south[:20], beams_on("wall")[-21:]))
    assert judge(sweep_, wall(sweep_, (0.0, -1.5), (0.5, 1.5), beams)).false


def test_observations_of_people_are_people(sweep_, beams_on):
    legs = beams_on("person")
    for kind in ("cylinder", "corner"):
        seen = judge(sweep_, point(sweep_, kind, (2.5, -0.5), legs))
        assert seen == Classification(person=True, touched=True, false=True)
    assert judge(sweep_, wall(sweep_, (2.44, -0.7), (2.44, -0.3), legs)).person


def test_observations_at_a_person_are_the_person_whatever_beams_hit(sweep_, beams_on):
    beams = beams_on("wall")
    assert judge(sweep_, point(sweep_, "corner", (2.5, -0.2), beams)).person
    assert not judge(sweep_, point(sweep_, "corner", (2.5, 0.0), beams)).person


def test_a_wall_behind_someone_is_no_person(sweep_, beams_on, south):
    beams = np.concatenate((south, beams_on("person")))
    seen = judge(sweep_, wall(sweep_, (-1.0, -1.5), (3.5, -1.5), beams))
    assert seen == Classification(person=False, touched=True, false=False)


def test_points(sweep_, beams_on):
    beams = beams_on("cylinder")
    assert not judge(sweep_, point(sweep_, "cylinder", (2.05, 1.05), beams)).false
    assert judge(sweep_, point(sweep_, "cylinder", (2.15, 1.0), beams)).false
    assert judge(sweep_, point(sweep_, "corner", (2.0, 1.0), beams)).false
    assert not judge(sweep_, point(sweep_, "corner", (1.0, -1.45), beams)).false


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


def test_walls_are_counted():
    good, bad = Classification(False, False, False), Classification(False, False, True)
    leg = Classification(True, True, True)
    assert tuple(tally([]).values()) == (1, 0, 0, 0, 0)
    assert tuple(tally([good, bad, leg]).values()) == (1, 3, 2, 1, 1)
    rows = [
        {f"{name}: {what}": 2 * k for name in EXTRACTORS for k, what in enumerate(COUNTS)},
        {"only": "a path"},
        {f"{name}: {what}": 1 for name in EXTRACTORS for what in COUNTS},
    ]
    assert tuple(total_counts(rows)["RANSAC"].values()) == (1, 3, 5, 7, 9)


def run_that_ends(off):
    """Return a straight run of 100 m whose path is off by so much all the way."""
    truth = np.column_stack((np.linspace(0, 100, 11), np.zeros(11), np.zeros(11)))
    path = truth + np.array((0.0, off, 0.0))
    rows = PathRows(np.zeros(11), path, np.tile(np.eye(3), (11, 1, 1)), truth + 5.0)
    return StudyRun(corridor_world(), VARIANTS[0], 0, [], truth, rows, [], (), [])


def test_a_path_holds_until_it_is_off_for_the_first_time():
    run = run_that_ends(0.5)
    assert distance_held(run, 0.6) == pytest.approx(100.0)
    assert distance_held(run, 0.4) == 0.0
    run.path[:4, 1] = 0.0
    del run.__dict__["errors"]
    assert distance_held(run, 0.4) == pytest.approx(40.0)


def row(seed, off, variant=DEFAULT, people=0):
    """Return the row of such a run, whose only landmark was a leg, or that had none."""
    run = run_that_ends(off)
    counts = dict(zip(COUNTS, (2, 4, 1, 0, 1), strict=True))
    return {
        "seed": seed,
        "variant": variant,
        "error": "",
        **path_metrics(run),
        "holds": distance_held(run, MAX_DRIFT * 100.0),
        **dict.fromkeys(("landmarks_ever", "people_ever", "touched_by_people"), people),
        "false_at_birth": people,
        "false_at_the_end": (),
        "missing": (),
        **{f"{name}: {what}": n for name in EXTRACTORS for what, n in counts.items()},
    }


def test_the_tables_show_the_rows():
    runs = {DEFAULT: [row(0, 0.1), row(1, 0.5, people=1), row(2, 0.51)]}
    path, mapped = path_table(runs), map_table(runs)
    first, wheels = path.rows
    assert list(first) == [
        *(DEFAULT, "0.500 [0.100, 0.510]", "2 of 3", "0.500 [0.100, 0.510]", "100"),
    ]
    assert list(wheels) == ["wheels alone", "7.071 [7.071, 7.071]", "0 of 3", wheels[3], ""]
    assert wheels[3] == "7.071 [7.071, 7.071]"
    assert [list(cells) for cells in mapped.rows] == [
        [DEFAULT, "0.5000", "0.33", "0.33", "0.33", "0.00", "0.00"]
    ]
    for table in (path, mapped):
        assert all(len(cells) == len(table.header) for cells in table.rows)
    found = numbers(runs, {})
    assert found[DEFAULT]["people_ever"] == [0, 1, 0]
    json.dumps(json_values(found), allow_nan=False)


# ------------------------------------------------------------------------------- runs


@pytest.fixture(scope="module")
def short():
    """The first 17 s of the corridor: someone comes towards the robot, someone overtakes it."""
    return beginning(corridor_world(), 17.0)


@pytest.fixture(scope="module")
def runs(short):
    """Two variants' runs of one seed."""
    messages = list(simulate(short, ROBOT, 3))
    chosen = [variant for variant in VARIANTS if variant.name in (DEFAULT, HOUGH)]
    return {variant.name: map_run(messages, short, variant, 3) for variant in chosen}


def test_the_default_maps_the_beginning(runs):
    run = runs[DEFAULT]
    metrics = corridor_metrics(run)
    assert 5.0 < run.travelled[-1] < 10.0
    assert run.errors[-1] < 0.05
    assert (metrics["people_ever"], metrics["false_at_birth"]) == (0, 0)
    assert metrics["false_at_the_end"] == ()
    assert {promotion.observation.kind for promotion in run.promotions} >= {"wall", "corner"}
    assert metrics["landmarks_ever"] >= len(run.landmarks) > 5


def test_promotions_are_those_of_the_map(runs):
    run = runs[HOUGH]
    assert {promotion.observation.kind for promotion in run.promotions} == {"wall"}
    assert {mark.id for mark in run.landmarks} <= {promotion.id for promotion in run.promotions}
    stamps = [promotion.stamp for promotion in run.promotions]
    assert stamps == sorted(stamps)


def test_ransac_finds_more_spurious_walls_than_the_others(runs):
    counts = count_walls(runs[DEFAULT].messages, 3, every=2)
    assert len({count["scans"] for count in counts.values()}) == 1
    rates = {name: count["spurious"] / count["scans"] for name, count in counts.items()}
    worst = rates.pop("RANSAC")
    assert worst > 0.05
    assert all(worst > 2.0 * rate for rate in rates.values())


def test_the_picture_is_the_same_bytes_each_time(runs):
    some = {"one": runs[HOUGH]}
    png = draw_maps(some, CORRIDOR, {"one": {0}})
    assert png.startswith(b"\x89PNG")
    assert png == draw_maps(some, CORRIDOR, {"one": {0}})
    assert png != draw_maps(some, CORRIDOR)


def test_seeds_are_limited_for_variants_and_interpretations(monkeypatch):
    asked = []

    def fake(variants, seeds, worlds, measure, job, stage):
        asked.append((len(variants), list(seeds)))
        return [row(seed, 0.1, variant.name) for seed in seeds for variant in variants]

    monkeypatch.setattr(corridor, "sweep", fake)
    monkeypatch.setattr(corridor, "_pictures", lambda seed: [])
    seeds, every = corridor.THESIS_SEEDS + 4, corridor.THESIS_SEEDS
    part = corridor.corridor(Job(seeds))
    assert asked == [
        (len(VARIANTS), list(range(every))),
        (1, list(range(every, seeds))),
        (len(READINGS), list(range(corridor.READING_SEEDS))),
    ]
    assert part.numbers["seeds"] == list(range(seeds))
    assert len(part.numbers[DEFAULT]["end"]) == seeds
    assert len(part.numbers[HOUGH]["end"]) == every
    assert [len(table.rows) for table in part.tables] == [6, 5, 4, len(READINGS)]
    json.dumps(json_values(part.numbers), allow_nan=False)


@pytest.mark.slow
def test_the_default_holds_to_the_end():
    default = [variant for variant in VARIANTS if variant.name == DEFAULT]
    (row,) = sweep(default, [0], [corridor_world()], corridor_metrics)
    assert row["odometry_end"] > 3.0
    assert row["end"] < MAX_DRIFT * row["travelled"]
    assert (row["people_ever"], row["false_at_birth"], row["missing"]) == (0, 0, ())


def test_the_thesis_succeeds_with_walls_matched_in_the_robot_frame():
    """On the first 90 s, in which the robot is lost if walls are matched in map."""
    world = beginning(corridor_world(), 90.0)
    rows = sweep([v for v in VARIANTS if v.name != DEFAULT], [0], [world], corridor_metrics)
    hough, from_robot, likelihood, ransac = rows
    assert hough["travelled"] > 35.0
    for row in (from_robot, likelihood):
        assert row["holds"] == row["travelled"]
        assert row["end"] < MAX_DRIFT * row["travelled"]
    assert 15.0 < hough["holds"] < 30.0
    assert ransac["holds"] < 15.0
    assert ransac["false_at_birth"] > 10
