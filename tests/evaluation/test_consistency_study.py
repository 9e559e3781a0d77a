"""The Monte Carlo study: its setting, its yardstick, and what it says of the filters."""

import numpy as np
import pytest
from scipy.optimize import least_squares
from tests.numeric import wrapped

from impslam.errors import ConfigError
from impslam.evaluation.consistency_batch import LATERAL_SIGMA, optima
from impslam.evaluation.consistency_plot import draw_study
from impslam.evaluation.consistency_setting import START_SIGMA, Setting, simulate
from impslam.evaluation.consistency_study import BATCH, consistency_study, follow
from impslam.geometry.se2 import between, inverse, transform

SMALL = Setting(steps=12, landmarks=6)
NOISELESS = Setting(steps=90, wheel_sigma=1e-6, sigma=1e-6)


def test_the_path_closes_and_the_ring_surrounds_it():
    setting = Setting(turn_rate=2.0 * np.pi / 80.0, steps=81)
    path, ring = setting.path(), setting.ring()
    assert np.abs(wrapped(path[-1] - path[0], 2)).max() < 1e-9
    centre = path[:-1, :2].mean(axis=0)
    # A polygon of straight steps, its centre a little off that of the arc.
    np.testing.assert_allclose(
        np.hypot(*(ring - centre).T), 0.25 / setting.turn_rate + 2.5, atol=0.13
    )


def test_the_noise_is_as_said(rng):
    setting = Setting(steps=4000)
    drive, places = simulate(setting, rng), setting.ring()
    felt = drive.felt - [0.25, 0.0, 0.075]
    np.testing.assert_allclose(felt.std(axis=0), [0.02 / 2**0.5, 0.0, 0.04 * 2**0.5], rtol=0.05)
    exact = transform(inverse(drive.truth[7]), places)
    np.testing.assert_array_equal(drive.in_range[6], (np.linalg.norm(exact, axis=1) < 5.0))
    assert drive.first_turn(setting) == pytest.approx(felt[0, 2] / (0.04 * 2**0.5))
    errors = drive.seen[6] - exact
    assert 0.05 < errors.std() < 0.15


def residuals(setting, drive, step, known):
    """All residuals over their standard deviations, written down once more, plainly."""
    at, which = np.nonzero(drive.in_range[:step])

    def stacked(x):
        poses, places = x[: 3 * step + 3].reshape(-1, 3), np.full((setting.landmarks, 2), np.nan)
        places[known] = x[3 * step + 3 :].reshape(-1, 2)
        sigmas = np.maximum(setting.motion_sigmas, LATERAL_SIGMA)
        moved = [
            wrapped(between(poses[k], poses[k + 1]) - drive.felt[k], 2) / sigmas
            for k in range(step)
        ]
        seen = [
            (transform(inverse(poses[k + 1]), places[i]) - drive.seen[k, i]) / setting.sigma
            for k, i in zip(at, which, strict=True)
        ]
        return np.concatenate([(poses[0] - drive.truth[0]) / START_SIGMA, *moved, *seen])

    return stacked


def test_the_batch_optimum_is_what_dense_least_squares_finds(rng):
    drive, step = simulate(SMALL, rng), 11
    *_, best = optima(SMALL, drive, [5, step])
    known = np.flatnonzero(drive.in_range[:step].any(axis=0))
    start = np.concatenate([drive.truth[: step + 1].ravel(), SMALL.ring()[known].ravel()])
    dense = least_squares(residuals(SMALL, drive, step, known), start, xtol=1e-14, ftol=1e-14)
    last = slice(3 * step, 3 * step + 3)
    np.testing.assert_allclose(best.pose, dense.x[last], atol=1e-6)
    covariance = np.linalg.inv(dense.jac.T @ dense.jac)[last, last]
    np.testing.assert_allclose(best.covariance, covariance, rtol=1e-3, atol=1e-8)


def test_all_but_without_noise_optimum_and_filters_are_the_truth(rng):
    drive = simulate(NOISELESS, rng)
    for best in optima(NOISELESS, drive, [30, 89]):
        assert np.abs(wrapped(best.pose - drive.truth[best.step], 2)).max() < 5e-5
    for kind in ("ekf", "fej", "riekf"):
        *_, (belief, which, _) = follow(NOISELESS, {"kind": kind}, drive)
        assert np.abs(wrapped(belief.pose - drive.truth[-1], 2)).max() < 5e-5
        found = {m.id: m.position for m in belief.landmarks()}
        places = NOISELESS.ring()
        assert max(np.abs(p - places[which[i]]).max() for i, p in found.items()) < 5e-5


def test_processes_do_not_change_the_result():
    alone, shared = (
        consistency_study(["riekf"], runs=3, setting=Setting(steps=50), processes=n) for n in (1, 2)
    )
    assert repr(alone.rows) == repr(shared.rows)  # NaN is not equal to itself


def test_a_filter_that_does_not_exist_is_named_before_anything_runs():
    with pytest.raises(ConfigError, match="did you mean 'riekf'"):
        consistency_study(["riekff"], runs=10**6)


def test_parameters_of_a_filter_show_in_its_name():
    study = consistency_study(
        ["ekf", {"kind": "ekf", "iterations": 3}], runs=1, setting=Setting(steps=50)
    )
    assert [row.name for row in study.rows] == ["ekf", "ekf (iterations=3)", BATCH]


@pytest.mark.slow
def test_the_textbook_filter_is_too_sure_and_the_others_are_not():
    """30 runs of the full setting; the bounds leave room for what 30 runs scatter (2026-11)."""
    study = consistency_study(runs=30, seed=1)
    rows = {row.name: row for row in study.rows}
    assert study.first_turn == pytest.approx(1.0, abs=4.0 * (2.0 / 30.0) ** 0.5)
    assert 3.9 < rows["ekf"].nees < 6.5
    assert rows["ekf"].in_band < 0.6
    for name in ("fej", "riekf"):
        assert rows[name].nees - study.first_turn == pytest.approx(2.0, abs=0.5)
        assert rows[name].nees_landmarks == pytest.approx(2.0, abs=0.5)
        assert rows[name].nis == pytest.approx(1.0, abs=0.1)
        assert rows[name].position_ratio < 1.02
        assert rows[name].apart < 0.02
    assert rows["ekf"].apart > 5 * rows["riekf"].apart


def test_the_picture_shows_every_estimator(tmp_path):
    study = consistency_study(["ekf", "riekf"], runs=2, setting=Setting(steps=50))
    figure = draw_study(study)
    nees = figure.axes[0]
    assert {line.get_label() for line in nees.lines} == {"ekf", "riekf", BATCH}
    np.testing.assert_array_equal(nees.lines[1].get_ydata(), study.curves["riekf"].nees[1:])
    figure.savefig(tmp_path / "consistency.png")
    assert (tmp_path / "consistency.png").stat().st_size > 10_000
