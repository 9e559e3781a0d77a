"""`imp reproduce consistency`: its tables show the numbers, and the arena's metrics are right."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from impslam.config import load
from impslam.evaluation.json_values import json_values
from impslam.evaluation.landmarks import landmark_errors, true_wall
from impslam.simulation.noise import build
from impslam.simulation.robot import SimulatedRobot
from impslam.simulation.world import load_world
from impslam.studies import consistency as experiment
from impslam.studies.circle_simulation import HUANG, LONG_LOOP
from impslam.studies.consistency import FILTERS, consistency
from impslam.studies.consistency_arena import (
    CASES,
    KINDS,
    ConsistencyCase,
    arena_consistency,
    consistency_metrics,
    drawn_from,
    landmark_nees,
    nis_by_kind,
)
from impslam.studies.filter_consistency import BATCH, consistency_study
from impslam.studies.sweep import sweep
from impslam.sweeps.job import Job
from impslam.types import Landmark, Match, Observation


@pytest.fixture(scope="module")
def small():
    """The whole experiment with short settings and one case of the arena."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(experiment, "HUANG", replace(HUANG, steps=60))
        patch.setattr(experiment, "LONG_LOOP", replace(LONG_LOOP, steps=60))
        patch.setattr(
            experiment,
            "arena_consistency",
            lambda job, runs: arena_consistency(job, runs, CASES[:1]),
        )
        steps = []
        job = Job(seeds=2, progress=lambda *step: steps.append(step))
        return consistency(job), steps


def test_tables_are_rectangular_and_name_every_filter(small):
    part, _ = small
    for table in part.tables:
        assert {len(row) for row in table.rows} == {len(table.header)}
    for table in part.tables[:2]:
        assert [row[0] for row in table.rows][: 2 + len(FILTERS)] == ["ideal", *FILTERS, BATCH]
    assert [row[0] for row in part.tables[0].rows][2 + len(FILTERS) :] == [
        "EKF, published",
        "invariant EKF, published",
    ]


def test_cells_are_the_figures(small):
    part, _ = small
    figures = json_values(part.numbers)["circle"]["rows"][0]
    cells = part.tables[0].rows[1]
    shown = dict(zip(part.tables[0].header, cells, strict=True))
    assert float(shown["pose NEES"]) == pytest.approx(figures["nees"], abs=0.005)
    assert float(shown["in band [%]"]) == pytest.approx(100 * figures["in_band"], abs=0.5)
    assert float(shown["heading [deg]"]) == pytest.approx(
        math.degrees(figures["heading"]), abs=0.005
    )
    assert float(shown["position / optimum"]) == pytest.approx(
        figures["position_ratio"], abs=0.0005
    )


def test_figures_are_json_and_pictures_png(small):
    part, _ = small
    text = json.dumps(json_values(part.numbers), allow_nan=False)
    assert json.loads(text)["arena"][0]["runs"] == 2
    assert [picture.name for picture in part.pictures] == [
        "consistency-circle",
        "consistency-loop",
        "consistency-arena",
    ]
    assert all(picture.content.startswith(b"\x89PNG") for picture in part.pictures)


def test_progress_is_reported_for_each_study(small):
    _, steps = small
    last = {stage: (done, total) for stage, done, total in steps}
    assert last == {"circle": (2, 2), "long loop": (2, 2), "arena, as it is": (2, 2)}


def test_the_whole_system_is_not_too_sure_of_the_pose(small):
    """Two seeds of the arena: modest in pose and innovations, nothing unseen."""
    part, _ = small
    for outcome in part.numbers["arena"]:
        assert outcome["nees"] < 4.0
        assert all(0.05 < outcome["nis"][kind] < 1.0 for kind in KINDS)
        assert all(outcome["landmark_nees"][kind] > 0.0 for kind in KINDS)


def test_processes_do_not_change_the_result():
    setting = replace(HUANG, steps=45)
    alone, shared = (
        consistency_study(["riekf"], 2, setting=setting, job=Job(processes=n)) for n in (1, 2)
    )
    assert repr(alone.rows) == repr(shared.rows)


def test_a_robot_without_faults_is_mapped_to_the_millimetre():
    """So that what the cases show is due to their faults."""
    perfect = SimulatedRobot.perfect().model_copy(update={"imu": None})
    variants = ConsistencyCase("perfect", perfect, (), ("riekf",)).variants()
    (row,) = sweep(variants, [0], measure=consistency_metrics)
    assert row["nees"] < 0.1
    assert max(row[f"nees {kind}"] for kind in KINDS) < 0.5


def landmark(kind, position, parameters, covariance, ends=None):
    return Landmark(7, kind, np.array(position), parameters, covariance, ends, 9, 0.0, 1.0)


def test_landmark_nees_by_hand():
    world = load_world("arena").landmarks()
    wall = next(true for true in world if true.name == "wall 2")
    seen = {"r": wall.parameters["r"] + 0.02, "alpha": wall.parameters["alpha"] - 0.01}
    P = np.diag([0.01, 0.01]) ** 2
    mark = landmark("wall", wall.position + np.array([0.02, 0.0]), seen, P, wall.end_points)
    np.testing.assert_allclose(landmark_errors(mark, wall), [0.02, -0.01])
    cylinder = next(true for true in world if true.kind == "cylinder")
    point = landmark("cylinder", cylinder.position + np.array([0.03, 0.0]), {}, P)
    point = replace(point, id=8)
    assert landmark_nees([mark, point], world) == pytest.approx({"wall": 5.0, "cylinder": 9.0})


def test_wall_directions_are_compared_the_short_way():
    wall = next(true for true in load_world("arena").landmarks() if true.name == "wall 4")
    assert abs(wall.parameters["alpha"]) == pytest.approx(np.pi)
    seen = {"r": wall.parameters["r"], "alpha": -np.sign(wall.parameters["alpha"]) * (np.pi - 0.01)}
    mark = landmark("wall", wall.position, seen, np.eye(2), wall.end_points)
    assert abs(landmark_errors(mark, wall)[1]) == pytest.approx(0.01)


def test_a_wall_through_the_origin_may_be_reported_from_its_other_side():
    wall = true_wall("south", np.array([[0.0, 0.0], [14.0, 0.0]]))
    for side in (1.0, -1.0):
        seen = {"r": 0.01, "alpha": side * 0.5 * np.pi}
        ends = wall.end_points + np.array([0.0, side * 0.01])
        mark = landmark("wall", ends[0], seen, 1e-4 * np.eye(2), ends)
        assert landmark_nees([mark], [wall]) == pytest.approx({"wall": 1.0})


def test_nis_is_over_its_dimension_and_by_kind():
    seen = (Observation("wall", np.zeros(2), np.eye(2)), Observation("x", np.zeros(1), np.eye(1)))
    matches = (
        Match(0, 1, np.zeros(2), np.eye(2), 3.0),
        Match(0, 2, np.zeros(2), np.eye(2), 1.0),
        Match(1, 3, np.zeros(1), np.eye(1), 0.5),
    )
    pairs = [(seen[match.observation], match) for match in matches]
    assert nis_by_kind(pairs) == {"wall": 1.0, "x": 0.5}


def test_constants_drawn_from_a_config_scatter_as_it_assumes():
    config = load("imp", ["odometry.slip.systematic=0.5", "sensors.lidar.bias=0.02"])
    robot, constant = drawn_from(config), config.make_robot().odometry.slip.split()[1]
    assert robot.lidar.bias_sigma == 0.02
    assert robot.imu.gyro_bias_sigma == config.make_robot().odometry.gyro.bias
    rng, wheels = np.random.default_rng(0), robot.encoders
    built = [build(wheels, rng)[:2] for _ in range(2000)]
    bends = [(right - left) / wheels.wheel_radius / wheels.track for (left, right), _ in built]
    tracks = [track / wheels.track - 1.0 for _, track in built]
    assert np.std(bends) == pytest.approx(constant.turn_per_distance, rel=0.05)  # rad/m
    assert np.std(tracks) == pytest.approx(constant.turn, rel=0.05)
