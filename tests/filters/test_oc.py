"""The observability-constrained EKF: nothing is observed along a motion of everything."""

import numpy as np
from scipy.optimize import minimize
from tests.filters.worlds import CYLINDERS, MODELS, drive, observe, step

from impslam.filters.ekf import Ekf
from impslam.filters.fej import FirstEstimatesEkf
from impslam.filters.matched_scan import MatchedKind
from impslam.filters.oc import ObservabilityConstrainedEkf, unobserving
from impslam.filters.symmetry import pose_D_motion

START_SIGMA = 0.3


def test_the_projection_is_the_nearest_that_observes_nothing(rng):
    J, N = rng.normal(size=(1, 2, 5)), rng.normal(size=(1, 5, 3))
    projected = unobserving(J, N)[0]
    np.testing.assert_allclose(projected @ N[0], 0.0, atol=1e-12)
    basis = np.linalg.svd(N[0].T)[2][3:]  # rows span what is orthogonal to N
    nearest = minimize(lambda c: np.sum((c.reshape(2, 2) @ basis - J[0]) ** 2), np.zeros(4)).x
    np.testing.assert_allclose(projected, nearest.reshape(2, 2) @ basis, atol=1e-5)


def test_a_jacobian_that_observes_nothing_already_is_left_alone(rng):
    """Before anything is corrected, first and newest estimates are one."""
    for kind in ("cylinder", "wall"):
        model = MODELS[kind]
        pose, m = rng.normal(size=3), rng.normal(size=(4, model.dim))
        there = model.predict(pose, m)
        J = np.concatenate([there.z_D_pose, there.z_D_m], axis=2)
        pose_part = np.broadcast_to(pose_D_motion(pose), (4, 3, 3))
        N = np.concatenate([pose_part, model.m_D_motion(m)], axis=1)
        np.testing.assert_allclose(unobserving(J, N), J, atol=1e-12)


def test_the_projection_does_not_depend_on_the_map_frame(rng):
    """Moving the origin mixes the columns of N and leaves what they span."""
    pose, place, shift = rng.normal(size=3), rng.normal(size=2), np.array([40.0, -70.0])
    J = rng.normal(size=(1, 2, 5))

    def projected(origin):
        at = pose - np.append(origin, 0.0)
        m = MODELS["cylinder"].m_D_motion((place - origin)[None])[0]
        return unobserving(J, np.concatenate([pose_D_motion(at), m])[None])

    np.testing.assert_allclose(projected(np.zeros(2)), projected(shift), atol=1e-10)


def test_it_stays_nearer_to_the_newest_jacobians_than_first_estimates_do():
    """After a run, on the same belief: the constraint costs less than going back to the first."""
    rng = np.random.default_rng(12)
    belief = ObservabilityConstrainedEkf()
    belief.start(np.zeros(3), START_SIGMA**2 * np.eye(3), MODELS)
    for pose, increment in drive(60, rng):
        step(belief, increment, observe(pose, rng))
    belief.predict(increment)
    table, places = belief._atlas.table("cylinder"), np.arange(len(CYLINDERS))
    states = table.states(belief.belief.mean)
    kind = MatchedKind(table, places, belief.pose, states)

    def jacobian(cls):
        there = cls._expect(belief, kind, belief.pose, states)
        return np.concatenate([there.z_D_pose, there.z_D_m], axis=2)

    newest = jacobian(Ekf)
    constrained, first = (
        np.linalg.norm(jacobian(cls) - newest)
        for cls in (ObservabilityConstrainedEkf, FirstEstimatesEkf)
    )
    assert 0.0 < constrained < 0.5 * first
