"""Filter consistency: normalised errors against chi-square bounds.

Bar-Shalom, Li & Kirubarajan 2001, 5.4: the normalised estimation error squared (NEES) of a consistent
filter has a chi-square distribution; its mean is the number of degrees of freedom. So has the normalised
innovation squared (NIS), which needs no truth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from impslam.geometry.angles import wrap
from impslam.types import Array


def pose_errors(estimate: Array, truth: Array) -> Array:
    """Return estimate minus truth (n, 3), with wrapped headings: the error described by the covariance."""
    error = estimate - truth
    error[:, 2] = wrap(error[:, 2])
    return error


def nees(errors: Array, covariances: Array) -> Array:
    """Return (n,) e^T P^-1 e of errors (n, k) and covariances (n, k, k).

    Raises
    ------
    numpy.linalg.LinAlgError
        If a covariance is singular, such as that of a pose that defines the origin.
    """
    solved = np.linalg.solve(covariances, errors[..., None])[..., 0]
    return np.asarray(np.sum(errors * solved, axis=-1))


@dataclass(frozen=True, slots=True)
class Innovations:
    """Normalised innovations squared of a run.

    `mean` is per degree of freedom, ideally 1; for a consistent filter it is between `low` and `high` in
    95 % of runs. `within` is the share of the `count` keyframes with matches that are inside their own 95 %
    interval.
    """

    count: int
    matches: int
    mean: float
    low: float
    high: float
    within: float


def score_innovations(innovations: Array) -> Innovations | None:
    """Return the consistency of `Keyframes.innovations` (k, 3); None if there are none.

    Innovations of a consistent filter are white, so their sum over keyframes is chi-square, too.
    """
    from scipy.special import chdtri  # noqa: PLC0415  0.1 s, only needed with matches

    matches, nis, dof = innovations[innovations[:, 2] > 0.0].T
    if not len(dof):
        return None
    lows, highs = (chdtri(dof, above) for above in (0.975, 0.025))
    total = float(dof.sum())
    low, high = (float(chdtri(total, above)) / total for above in (0.975, 0.025))
    within = float(np.mean((nis >= lows) & (nis <= highs)))
    return Innovations(len(dof), int(matches.sum()), float(nis.sum()) / total, low, high, within)


def effective_count(values: Array) -> float:
    """Return the effective sample size of correlated values (n,).

    n over the sum of their correlations at all lags, which are summed in pairs while these are positive
    (Geyer 1992, 3.3).
    """
    n, deviations = len(values), values - values.mean()
    if not deviations.any():
        return 1.0
    spectrum = np.abs(np.fft.rfft(deviations, 2 * n)) ** 2
    correlation = np.fft.irfft(spectrum)[:n]
    correlation /= correlation[0]
    pairs = correlation[: n - n % 2].reshape(-1, 2).sum(axis=1)
    end = int(np.argmax(pairs <= 0.0)) if (pairs <= 0.0).any() else len(pairs)
    return float(np.clip(n / max(2.0 * pairs[:end].sum() - 1.0, 1.0), 1.0, n))


def chi2_bounds(dof: int, runs: float = 1, confidence: float = 0.95) -> tuple[float, float]:
    """Return the confidence interval of the mean of `runs` independent normalised errors."""
    from scipy.special import chdtri  # noqa: PLC0415  0.1 s, only needed with a truth

    tail = 0.5 * (1.0 - confidence)
    low, high = (float(chdtri(dof * runs, above)) / runs for above in (1.0 - tail, tail))
    return low, high


def share_within(values: Array, runs: int, dof: int) -> float:
    """Return the share of means over `runs` (n,) within their 95 % bounds; ideally 0.95."""
    low, high = chi2_bounds(dof, runs)
    return float(np.mean((values >= low) & (values <= high)))


def resampled_means(values: Array, rng: np.random.Generator, times: int = 500) -> Array:
    """Return bootstrap means (times, n) over runs, resampled with replacement from values (runs, n).

    They scatter about the mean as it does about the truth (Efron 1979).
    """
    runs = len(values)
    counts = rng.multinomial(runs, np.full(runs, 1.0 / runs), size=times)
    return np.asarray(counts @ values / runs)
