"""Each example is one file outside the package, used through a config that names it."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from tests.numeric import jacobian
from tests.registry import own_registry

from impslam.cli import main
from impslam.component import components, find
from impslam.config import load
from impslam.evaluation.trajectory import associate, position_errors
from impslam.evaluation.tum import read_tum
from impslam.landmarks.point import Cylinder
from impslam.maps.landmark_table import read_landmarks
from impslam.simulation.robot import Lidar, SimulatedRobot, WheelEncoders
from impslam.simulation.simulate import simulate
from impslam.simulation.world import load_world
from impslam.sources.recording import McapWriter
from impslam.types import Increment, LaserScan, Match, Observation, TruePose, WheelAngles

EXAMPLES = Path(__file__).parents[2] / "examples"
ROBOT = SimulatedRobot(imu=None)
CENTRES = {"near": (0.5, 0.9), "far": (1.9, -0.2)}


@pytest.fixture(autouse=True)
def _own_registry():
    with own_registry():
        yield


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    path = tmp_path_factory.mktemp("examples") / "room.mcap"
    with McapWriter(path) as writer:
        for message in simulate(load_world("room"), ROBOT):
            writer.write(message)
    return path


def imp(tmp_path, log, example, *lines):
    """Run a log with an example and further lines of config; return the run folder."""
    config = tmp_path / "mine.toml"
    plugin = (EXAMPLES / f"{example}.py").as_posix()
    config.write_text("\n".join([f'base = "imp"\nplugins = ["{plugin}"]', *lines]))
    out = tmp_path / "run"
    assert main(["run", str(log), "-c", str(config), "-o", str(out), "--quiet"]) == 0
    return out


def assert_cylinders(landmarks, tolerance):
    assert len(landmarks) == len(CENTRES)
    for centre in CENTRES.values():
        assert min(math.dist(mark.position, centre) for mark in landmarks) < tolerance


def test_every_example_is_short_and_tried_here():
    files = {path.stem: path.read_text().count("\n") for path in EXAMPLES.glob("*.py")}
    assert set(files) == {"poles", "pillar", "json_log", "huber"}
    assert max(files.values()) < 80


def test_an_extractor(tmp_path, log):
    out = imp(
        tmp_path,
        log,
        "poles",
        "[sensors.lidar.extractors]",
        'cylinders.kind = "poles"',
        "cylinders.radius = 0.125",  # between the two
    )
    cylinders = [m for m in read_landmarks(out / "landmarks.csv") if m.kind == "cylinder"]
    assert_cylinders(cylinders, 0.06)


def test_a_kind_of_landmark(tmp_path, log):
    out = imp(tmp_path, log, "pillar", 'sensors.lidar.extractors.cylinders.kind = "pillar"')
    pillars = [m for m in read_landmarks(out / "landmarks.csv") if m.kind == "pillar"]
    assert_cylinders(pillars, 0.03)
    radii = sorted(mark.parameters["radius"] for mark in pillars)
    np.testing.assert_allclose(radii, [0.1, 0.15], atol=0.01)


@pytest.mark.parametrize("theta", [0.3, 3.0, -math.pi])
def test_the_jacobians_of_the_landmark(theta):
    load(settings=[f'plugins=["{(EXAMPLES / "pillar.py").as_posix()}"]'])
    model = find("landmark", "pillar")()
    pose, seen = np.array([1.0, -2.0, theta]), np.array([2.0, 0.5, 0.2])
    first = model.initialise(pose, Observation("pillar", seen, np.eye(3)))
    predicted = model.predict(pose, first.m[None])
    np.testing.assert_allclose(predicted.z[0], seen, atol=1e-12)

    def begin(pose, z=seen):
        return model.initialise(pose, Observation("pillar", z, np.eye(3))).m

    for analytic, numeric in [
        (predicted.z_D_pose[0], jacobian(lambda p: model.predict(p, first.m[None]).z[0], pose)),
        (predicted.z_D_m[0], jacobian(lambda m: model.predict(pose, m[None]).z[0], first.m)),
        (first.m_D_pose, jacobian(begin, pose)),
        (first.m_D_z, jacobian(lambda z: begin(pose, z), seen)),
    ]:
        np.testing.assert_allclose(analytic, numeric, atol=1e-8)


def write_json(path):
    """Write what a perfect robot records in a room, in stops of a lidar that takes no time."""
    beams = {"beams": 181, "angle_min": -math.pi / 2, "angle_step": math.pi / 180}
    lidar = Lidar.perfect(beam_time=0.0, **beams)
    robot = SimulatedRobot(encoders=WheelEncoders.perfect(), lidar=lidar, imu=None)
    rows, truth, wheels = [], {}, {}
    for message in simulate(load_world("room"), robot):
        if isinstance(message, TruePose):
            truth[message.stamp] = message.pose
        elif isinstance(message, WheelAngles):
            wheels[message.stamp] = (message.left, message.right)
        elif isinstance(message, LaserScan):
            ranges = [r if r > 0.0 else None for r in message.ranges.tolist()]
            row = {"stamp": message.stamp, "wheels": wheels[message.stamp], "ranges": ranges}
            rows.append(json.dumps(row))
    rows += ['{"stamp": 1020.0}', '{"stamp": 1020.1, "wheels": [NaN, 1], "ranges": [1, 2]}', "what"]
    path.write_text("\n".join(rows) + "\n")
    return np.array([[stamp, *pose] for stamp, pose in truth.items()])


def test_a_format_of_logs(tmp_path):
    log = tmp_path / "log.txt"  # the format is told from the content
    truth = write_json(log)
    out = imp(tmp_path, log, "json_log")
    pairs = associate(read_tum(out / "trajectory.tum"), truth)
    assert len(pairs.stamps) > 80
    assert position_errors(pairs).max() < 0.01
    summary = (out / "summary.json").read_text()
    assert '"malformed row"' in summary
    assert '"count": 3' in summary


def test_the_log_is_of_no_known_format_without_the_example(tmp_path, capsys):
    log = tmp_path / "log.txt"
    write_json(log)
    assert main(["run", str(log)]) == 2
    assert "no known log format" in capsys.readouterr().err


def test_a_filter(tmp_path, log):
    out = imp(tmp_path, log, "huber", 'filter.kind = "huber"')
    cylinders = [m for m in read_landmarks(out / "landmarks.csv") if m.kind == "cylinder"]
    assert_cylinders(cylinders, 0.03)


def test_the_filter_withstands_a_wrong_match():
    """Five landmarks are where they were; the sixth match is 0.5 m off, five sigmas and more."""
    load(settings=[f'plugins=["{(EXAMPLES / "huber.py").as_posix()}"]'])
    places = np.array([[2, 1], [2, -1], [1, 2], [1, -2], [3, 0], [2, 2]], dtype=float)
    seen = tuple(Observation("cylinder", place, 1e-4 * np.eye(2)) for place in places)
    off = replace_z(seen, 5, places[5] + [0.5, 0.0])
    errors = {}
    for name in ("ekf", "huber"):
        belief = find("filter", name)()
        belief.start(np.zeros(3), 1e-12 * np.eye(3), {"cylinder": Cylinder()})
        ids = belief.extend(seen, 0.0)
        belief.predict(Increment(1.0, np.zeros(3), np.diag([0.02, 0.02, 0.02]) ** 2))
        scores = belief.hypothesise(off)[0]
        matches: list[Match] = [
            m for m in scores.matches(range(36)) if m.landmark == ids[m.observation]
        ]
        belief.correct(off, matches)
        errors[name] = np.hypot(*belief.pose[:2])
    assert errors["huber"] < 0.5 * errors["ekf"]
    assert errors["ekf"] > 0.01


def replace_z(observations, index, z):
    out = list(observations)
    out[index] = Observation("cylinder", z, out[index].R)
    return tuple(out)


def test_an_example_does_not_outlive_its_test():
    assert "huber" not in components("filter")
