"""The first-estimates Jacobian EKF: its unobservable directions stay in one place."""

import numpy as np
import pytest
from tests.filters.worlds import MODELS, drive, observe, step

from impslam.filters.ekf import Ekf
from impslam.filters.fej import FirstEstimatesEkf
from impslam.filters.oc import ObservabilityConstrainedEkf
from impslam.filters.symmetry import pose_D_motion
from impslam.types import Increment

START_SIGMA = 0.3


def first_D_motion(belief):
    """Return G (n, 3) at the first estimates."""
    first = belief._first
    G = np.empty((len(first), 3))
    G[:3] = pose_D_motion(first)
    for table in belief._atlas.tables():
        G[table.columns] = table.model.m_D_motion(table.states(first))
    return G


@pytest.mark.parametrize("kind", [FirstEstimatesEkf, ObservabilityConstrainedEkf])
def test_a_rigid_motion_of_everything_never_gains_information(kind, rng):
    belief, last = kind(), np.eye(3) / START_SIGMA**2
    belief.start(np.zeros(3), START_SIGMA**2 * np.eye(3), MODELS)
    for pose, increment in drive(80, rng):
        step(belief, increment, observe(pose, rng))
        G = first_D_motion(belief)
        now = G.T @ np.linalg.solve(belief.belief.covariance, G)
        assert np.linalg.eigvalsh(last - now).min() > -1e-6
        last = now
    assert np.linalg.eigvalsh(now).min() > 0.98 / START_SIGMA**2


def test_without_corrections_it_is_the_ekf(rng):
    """First and newest estimates are the same until something is corrected."""
    filters = Ekf(), FirstEstimatesEkf()
    for belief in filters:
        belief.start(np.array([1.0, 2.0, 3.0]), 1e-2 * np.eye(3), MODELS)
        noise = np.random.default_rng(9)
        steps = list(drive(5, noise))
        for _, increment in steps:
            belief.predict(increment)
        belief.extend(observe(steps[-1][0]), 5.0)
        belief.predict(Increment(6.0, np.array([0.2, 0.0, 0.1]), 1e-4 * np.eye(3), 1.0))
    np.testing.assert_allclose(filters[0].belief.covariance, filters[1].belief.covariance)
    np.testing.assert_array_equal(filters[0].pose, filters[1].pose)


def test_first_estimates_follow_their_landmarks_through_removals(rng):
    belief = FirstEstimatesEkf()
    belief.start(np.zeros(3), 1e-4 * np.eye(3), MODELS)
    for pose, increment in drive(3, rng):
        step(belief, increment, observe(pose, rng))
    table = belief._atlas.table("cylinder")
    before = dict(zip(table.ids.tolist(), table.states(belief._first).tolist(), strict=True))
    belief.remove([table.ids[1], table.ids[3]])
    assert len(belief._first) == belief.state_size
    after = dict(zip(table.ids.tolist(), table.states(belief._first).tolist(), strict=True))
    assert after == {i: before[i] for i in after}
    assert len(after) == len(before) - 2
