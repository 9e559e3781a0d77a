"""What all observations of a sensor are off by is considered, and never learned (Schmidt 1966)."""

from dataclasses import replace

import numpy as np
import pytest
from tests.filters.worlds import CYLINDERS, MODELS, drive, observe, step

from impslam.association.known import Known
from impslam.component import components
from impslam.filters.ekf import Ekf
from impslam.types import Increment, Observation

FAMILY = sorted(name for name, cls in components("filter").items() if cls.considers_shared_errors)
BIAS = 0.06  # m: three times the noise of a cylinder


def biased(pose, rng, b, told=True, bias=BIAS):
    """Return cylinders and walls as ranges show them that are all too long by b times the bias."""
    seen = []
    for o in observe(pose, rng):
        way = o.z / np.linalg.norm(o.z) if o.kind == "cylinder" else np.array([1.0, 0.0])
        s = bias * way
        off = replace(o, z=o.z + b * s).with_noise(o.R + np.outer(s, s))
        seen.append(replace(off, shared=s, sensor="lidar") if told else off)
    return tuple(seen)


def landmark_nees(kind, told=True, bias=BIAS, runs=25):
    """Return the mean NEES of a run's cylinders over runs, each with an error of its own."""
    values = []
    for seed in range(runs):
        rng, belief = np.random.default_rng(seed), components("filter")[kind]()
        b = rng.standard_normal()
        belief.start(np.zeros(3), 1e-8 * np.eye(3), MODELS)
        for pose, increment in drive(20, rng):
            step(belief, increment, biased(pose, rng, b, told, bias))
        found = [m for m in belief.landmarks() if m.kind == "cylinder"]
        for mark, true in zip(found, CYLINDERS, strict=True):
            error = mark.position - true
            values.append(error @ np.linalg.solve(mark.covariance, error))
    return float(np.mean(values))


@pytest.mark.parametrize("kind", ["ekf", "riekf"])
def test_covariances_cover_the_error_of_biased_ranges(kind):
    """As well as without a bias in the same runs; taken for new in each scan, it is too sure."""
    without = landmark_nees(kind, bias=0.0)
    assert landmark_nees(kind) == pytest.approx(without, rel=0.2)
    assert landmark_nees(kind, told=False) > 1.6 * without


@pytest.mark.parametrize("kind", FAMILY)
def test_a_shared_error_is_never_learned(kind):
    rng, belief = np.random.default_rng(1), components("filter")[kind]()
    belief.start(np.zeros(3), 1e-8 * np.eye(3), MODELS)
    for pose, increment in drive(30, rng):
        step(belief, increment, biased(pose, rng, 1.5))
    (at,) = belief.belief.errors.values()
    P = belief.belief.covariance
    assert P[at, at] == 1.0
    assert belief.belief.mean[at] == 0.0
    assert np.abs(P[at, :at]).max() > 0.0
    assert np.linalg.eigvalsh(P).min() > 0.0
    assert belief.state_size == len(P) - 1


def test_it_is_the_schmidt_filter(rng):
    """One landmark seen twice, against dense algebra over [pose, landmark, error]."""
    s, R = np.array([0.05, 0.02]), np.diag([1e-4, 2e-4])
    belief, z = Ekf(), np.array([2.0, 1.0])
    belief.start(np.zeros(3), np.diag([0.1, 0.1, 0.05]) ** 2, MODELS)
    seen = Observation("cylinder", z, R + np.outer(s, s), label=0, shared=s, sensor="lidar")
    belief.extend([seen], 0.0)
    (at,) = belief.belief.errors.values()
    P, landmark = belief.belief.covariance, [i for i in range(3, 6) if i != at]
    np.testing.assert_allclose(P[landmark, at], -s, atol=1e-12)
    there = MODELS["cylinder"].predict(np.zeros(3), belief.belief.mean[None, landmark])
    H = np.zeros((2, 6))
    H[:, :3], H[:, landmark], H[:, at] = there.z_D_pose[0], there.z_D_m[0], s
    S = H @ P @ H.T + R
    matches = belief.associate((seen,), Known()).matches
    np.testing.assert_allclose(matches[0].S, S, atol=1e-12)
    np.testing.assert_allclose(belief.joint((seen,), matches)[1], S, atol=1e-12)
    K = P @ H.T @ np.linalg.inv(S)
    K[at] = 0.0
    belief.correct((seen,), matches)
    A = np.eye(6) - K @ H
    np.testing.assert_allclose(belief.belief.covariance, A @ P @ A.T + K @ R @ K.T, atol=1e-12)


def test_each_sensor_has_an_error_of_its_own_which_landmarks_that_go_leave_in_place():
    rng, belief = np.random.default_rng(2), Ekf()
    belief.start(np.zeros(3), 1e-8 * np.eye(3), MODELS)
    for pose, increment in drive(10, rng):
        seen = biased(pose, rng, 1.0)
        seen = tuple(replace(o, sensor=f"lidar {o.kind}") for o in seen)
        step(belief, increment, seen)
    belief.remove([0, 3])
    first, second = belief.belief.errors.values()
    P = belief.belief.covariance
    assert P[first, first] == P[second, second] == 1.0
    assert P[first, second] == 0.0
    known = [table.columns.ravel() for table in belief._atlas.tables()]
    assert sorted([*range(3), first, second, *np.concatenate(known)]) == list(range(len(P)))
    step(belief, Increment(20.0, np.zeros(3), 1e-6 * np.eye(3), 1.0), seen)
