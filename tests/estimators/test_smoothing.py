"""Smoothing by iSAM2: its optimum is the batch one, its Jacobians are right, shared errors are shared."""

import sys
from dataclasses import replace

import numpy as np
import pytest
from tests.filters.worlds import MODELS, R_POINT, R_WALL, drive, observe, wall_seen
from tests.numeric import wrapped

from impslam.component import build
from impslam.errors import ConfigError
from impslam.estimators.smoother import Smoother, _m, _x
from impslam.estimators.smoothing import Smoothing
from impslam.landmarks.wall import Wall
from impslam.map import Keyframe
from impslam.studies.batch_optimum import LATERAL_SIGMA, optima
from impslam.studies.circle_simulation import HUANG, simulate
from impslam.types import Increment, Observation


def started(filter_="riekf", **parameters):
    kinds = {"filter": filter_, "association": "known", "lifecycle": "immediate"}
    made = Smoothing(**parameters)
    parts = {role: build(role, {"kind": kind}) for role, kind in kinds.items()}
    made.start(np.zeros(3), models=MODELS, **parts)
    return made


def keyframe(k, motion, seen=()):
    none = np.zeros((3, 3))
    return Keyframe(
        k, motion.stamp, motion, none[0], none[0], none, None, 0, observations=tuple(seen)
    )


@pytest.fixture
def gtsam():
    return pytest.importorskip("gtsam")


@pytest.mark.parametrize("relinearise", [0.001, 0.3])
def test_the_refined_map_is_the_batch_optimum(gtsam, relinearise):
    """By a solver that shares no code with it: the newest pose and its covariance."""
    setting = replace(HUANG, steps=60)
    trial = simulate(setting, np.random.default_rng(1))
    made = started(relinearise=relinearise)
    Q = np.diag(np.maximum(setting.motion_sigmas, LATERAL_SIGMA) ** 2)
    for k, d_pose in enumerate(trial.odometry):
        seen = [
            Observation("corner", z, setting.sigma**2 * np.eye(2), label=i)
            for i, z in enumerate(trial.measurements[k])
            if trial.in_range[k, i]
        ]
        made.add(keyframe(k, Increment(float(k), d_pose, Q, 1.0), seen))
    refined = made.refine()
    assert refined.refused == ""
    (best,) = optima(setting, trial, [setting.steps - 1])
    sigmas = np.sqrt(np.diag(best.covariance))
    assert (np.abs(wrapped(refined.poses[-1] - best.pose, 2)) < 0.01 * sigmas).all()
    apart = (refined.covariances[-1] - best.covariance) / np.outer(sigmas, sigmas)
    assert np.abs(apart).max() < 0.01


def test_refining_does_not_affect_what_follows(gtsam):
    made, twin = started(), started()
    rng, again = np.random.default_rng(2), np.random.default_rng(2)
    for k, (pose, motion) in enumerate(drive(12, rng)):
        one = made.add(keyframe(k, motion, observe(pose, rng)))
        made.refine()
        made.landmarks()
    for k, (pose, motion) in enumerate(drive(12, again)):
        two = twin.add(keyframe(k, motion, observe(pose, again)))
    np.testing.assert_array_equal(one.poses, two.poses)
    np.testing.assert_array_equal(one.covariances, two.covariances)


def test_refining_can_be_ended_and_repeated(gtsam):
    made, rng, calls = started(), np.random.default_rng(2), []
    for k, (pose, motion) in enumerate(drive(12, rng)):
        made.add(keyframe(k, motion, observe(pose, rng)))
    wanted = made.refine()
    made.check_with(lambda: calls.append(0))
    made.refine()
    for k in range(len(calls)):
        left = iter(range(k))
        made.check_with(lambda left=left: next(left))
        with pytest.raises(StopIteration):
            made.refine()
    made.check_with(lambda: None)
    np.testing.assert_array_equal(made.refine().poses, wanted.poses)
    assert len(calls) >= 3  # before each iteration, and there are at least two


@pytest.mark.parametrize("kind", ["cylinder", "wall"])
def test_jacobians_are_central_differences(gtsam, kind):
    """Of the beginning and of a later observation, in gtsam's own perturbations, at other values."""
    smoother = Smoother(np.array([1.0, -2.0, 2.9]), 1e-4, 0.1)
    pose, ends = np.array([1.0, -2.0, 2.9]), np.array([[-6.0, 5.0], [-6.0, -5.0]])
    z, in_base = wall_seen(pose, ends)
    shared = np.array([0.02, 0.01])
    wall = Observation(
        "wall", z, R_WALL + np.outer(shared, shared), np.arange(50), in_base, shared=shared
    )
    point = Observation(
        "cylinder", np.array([1.0, 2.0]), R_POINT + np.outer(shared, shared), shared=shared
    )
    seen = wall if kind == "wall" else point
    smoother.add_landmark(0, MODELS[kind], seen, pose)
    smoother.add_observation(0, seen)
    factors = [smoother._factors.at(i) for i in range(smoother._factors.size())]
    values = gtsam.Values()
    values.insert(_x(0), gtsam.Pose2(1.2, -2.1, -3.1))
    values.insert(_m(0), np.array([0.3, -0.2, 0.4][: MODELS[kind].dim]))
    values.insert(smoother._errors[""], np.array([0.5]))
    checked = 0
    for factor in factors:
        if len(factor.keys()) < 3:
            continue
        checked += 1
        A, _ = factor.linearize(values).jacobian()
        columns = []
        for key in list(factor.keys()):
            dim = 3 if key == _x(0) else len(values.atVector(key))
            for h in 1e-6 * np.eye(dim):
                ahead, back = (_whitened(gtsam, factor, values, key, s * h) for s in (1, -1))
                columns.append((ahead - back) / 2e-6)
        np.testing.assert_allclose(A, np.column_stack(columns), rtol=1e-5, atol=1e-5 * abs(A).max())
    assert checked == (2 if kind == "wall" else 1) + (kind != "wall")


def _whitened(gtsam, factor, values, key, step):
    moved = gtsam.Values(values)
    if key == _x(0):
        moved.update(key, values.atPose2(key).retract(step))
    else:
        moved.update(key, values.atVector(key) + step)
    return -factor.linearize(moved).jacobian()[1]


def test_a_common_error_does_not_average_out(gtsam):
    smoother, shared = Smoother(np.zeros(3), 1e-6, 0.01), np.array([0.03, 0.0])
    R = 1e-4 * np.eye(2)
    seen = Observation(
        "cylinder", np.array([2.0, 0.0]), R + np.outer(shared, shared), shared=shared
    )
    smoother.add_landmark(0, MODELS["cylinder"], seen, np.zeros(3))
    for _ in range(3):
        smoother.add_observation(0, seen)
    smoother.solve()
    _, P = smoother.optimum().landmarks[0]
    np.testing.assert_allclose(P, R / 4 + np.outer(shared, shared), atol=1e-8)


def test_a_wall_is_known_along_itself_as_it_was_first_seen(gtsam):
    smoother, pose = Smoother(np.array([0.5, 1.0, 1.0]), 1e-6, 0.01), np.array([0.5, 1.0, 1.0])
    z, in_base = wall_seen(pose, np.array([[6.0, -5.0], [6.0, 5.0]]))
    seen = Observation("wall", z, R_WALL, np.arange(50), in_base)
    smoother.add_landmark(0, Wall(), seen, pose)
    smoother.solve()
    m, P = smoother.optimum().landmarks[0]
    new = Wall().initialise(pose, seen)
    np.testing.assert_allclose(m, new.m, atol=1e-9)
    np.testing.assert_allclose(P, new.m_D_z @ R_WALL @ new.m_D_z.T + new.slack, atol=1e-9)


def test_its_counts_include_those_of_landmarks(gtsam):
    made = started()
    made._counts["landmarks fused"] += 2
    assert made.counts() == {"landmarks fused": 2, "poses in the graph": 0}


def test_without_the_library_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "gtsam", None)
    with pytest.raises(ConfigError, match="needs the library gtsam; install it with `pip install"):
        started()


def test_a_filter_that_cannot_follow_is_refused(gtsam):
    with pytest.raises(ConfigError, match=r"'ukf'.*filter\.kind=riekf"):
        started("ukf")
