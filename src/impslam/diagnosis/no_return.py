"""Find ranges that mean no return: an exact value, or noise about range_max.

Simulated lidars may add noise to range_max where nothing is in range. Half of these ranges are valid: they
look like a round wall that moves with the robot. Surfaces near a range_max that the lidar exceeds, as cheap
ones do, may be as frequent; their ranges change gradually from beam to beam, while noise is independent.
"""

from __future__ import annotations

import math

import numpy as np

from impslam.diagnosis.beam_samples import BeamSamples
from impslam.diagnosis.evidence import Evidence
from impslam.diagnosis.finding import Finding
from impslam.types import Array, Mask

KIND = "value for no return"
MIN_BEAM_SHARE, MIN_SCAN_SHARE = 0.005, 0.2
"""Shares of valid beams, and of scans, with the value: if rarer, it does no harm."""
MIN_PEAK_RATIO = 5.0
"""Ratio of its frequency to the largest one beside it: on surfaces, frequencies change gradually."""
MIN_EXCESS = 2.0
"""Ratio of noise below range_max to as wide a part farther below: surfaces are as frequent in both. Those
that too long ranges place beyond range_max end there like noise."""
PEAK_NEIGHBOURS = 20
"""Values on either side with which it is compared."""
WIDTHS = np.geomspace(0.001, 0.1, 24)
"""Widths of noise about range_max, as shares of it."""
MARGIN = 4.0
"""Widths below range_max that are given up: 5.6 standard deviations, because the smallest width with
`MIN_PEAK_RATIO` is 1.4 of them."""
MAX_IMBALANCE = 0.15
"""Deviation from one half of the share of noise at or beyond range_max: few lidars see a surface there."""
MAX_CORRELATION = 0.45
"""Correlation of neighbouring beams: 0 for noise alone, up to 0.3 if a fifth of the ranges are surfaces,
and 0.6 for surfaces that a noisy lidar sees."""


def check_noise(e: Evidence) -> list[Finding]:
    """Find noise about range_max."""
    sample = e.samples
    if sample is None or not math.isfinite(sample.limit):
        return []
    below = np.where(sample.valid, sample.limit - sample.ranges, np.nan)
    beyond = np.where(e.lidar.in_field(sample.angles), sample.ranges - sample.limit, np.nan)
    width = _width(beyond, sample.limit) or _width(below, sample.limit)
    with np.errstate(invalid="ignore"):
        near, past = (below > 0.0) & (below <= width), (beyond >= 0.0) & (beyond <= width)
        next_to_it = (below > width) & (below <= 2.0 * width)
    is_peak = near.sum() > MIN_EXCESS * next_to_it.sum()
    is_noise = is_peak and _is_balanced(int(near.sum()), int(past.sum()))
    is_noise = is_noise and _is_independent(sample.ranges, near | past)
    if not is_noise or not _is_frequent(near, sample):
        return []
    share = 100.0 * near.sum() / sample.valid.sum()
    what = (
        f"{share:.1f} % of the valid ranges are less than {width:.2g} m below range_max, "
        f"{sample.limit:.4g} m, and as many beyond: this is its noise, and means no return"
    )
    limit = math.floor((sample.limit - MARGIN * width) * 1000.0) / 1000.0
    return [Finding(KIND, what, (f"{e.lidar_key}.range_max={limit:.3f}",), lidar=e.name)]


def _width(distances: Array, limit: float) -> float:
    """Return the width of a peak at 0 of distances from range_max on one side; 0 if there is none."""
    widths = limit * WIDTHS
    with np.errstate(invalid="ignore"):
        near = distances[(distances > 0.0) & (distances <= 2.0 * widths[-1])]
    inside, within = (np.searchsorted(np.sort(near), w, "right") for w in (widths, 2.0 * widths))
    is_peak = inside > MIN_PEAK_RATIO * (within - inside)
    return float(widths[np.argmax(is_peak)]) if is_peak.any() else 0.0


def _is_balanced(below: int, beyond: int) -> bool:
    return abs(beyond / (below + beyond) - 0.5) <= MAX_IMBALANCE


def _is_independent(ranges: Array, these: Mask) -> bool:
    """Return whether some ranges (m, n) of neighbouring beams are independent, as noise is."""
    deviations = ranges - ranges[these].mean()
    pairs = these[:, 1:] & these[:, :-1]
    covariances = deviations[:, 1:][pairs] * deviations[:, :-1][pairs]
    return bool(covariances.sum() <= MAX_CORRELATION * ranges[these].var() * pairs.sum())


def check_value(e: Evidence) -> list[Finding]:
    """Find an exact value."""
    sample = e.samples
    if sample is None:
        return []
    values, counts = np.unique(sample.ranges[sample.valid], return_counts=True)
    if len(values) < 2:
        return []
    k = int(np.argmax(counts))
    beside = np.delete(
        counts[max(k - PEAK_NEIGHBOURS, 0) : k + PEAK_NEIGHBOURS + 1], min(k, PEAK_NEIGHBOURS)
    )
    value = float(values[k])
    is_peak = counts[k] > MIN_PEAK_RATIO * beside.max()
    if not is_peak or not _is_frequent(sample.valid & (sample.ranges == value), sample):
        return []
    share = 100.0 * counts[k] / counts.sum()
    what = f"{share:.1f} % of the valid ranges are exactly {value:.6g} m: it means no return"
    return [Finding(KIND, what, (_limit(e, values, value),), lidar=e.name)]


def _is_frequent(these: Mask, sample: BeamSamples) -> bool:
    """Return whether some ranges (m, n) are so many of the valid ones that they do harm."""
    share = these.sum() / max(sample.valid.sum(), 1)
    return bool(share >= MIN_BEAM_SHARE and these.any(axis=1).mean() >= MIN_SCAN_SHARE)


def _limit(e: Evidence, values: Array, value: float) -> str:
    """Return the limit that excludes a value, and as few others as possible."""
    if np.mean(values < value) >= 0.5:
        return f"{e.lidar_key}.range_max={math.floor(value * 1000.0 - 1.0) / 1000.0:.3f}"
    return f"{e.lidar_key}.range_min={math.ceil(value * 1000.0 + 1.0) / 1000.0:.3f}"
