"""Absolute encoders are counted through noise, the drop at a turn's end, and late calls."""

import math

import numpy as np
import pytest

from impslam.platform.virtual.wheel_encoders import AbsoluteEncoder, Accumulator

STEP = 2 * math.pi / 4096


@pytest.mark.parametrize("speed", [15.0, -15.0, 0.5, -0.5, 0.0])
@pytest.mark.parametrize("step", [1e-3, 5e-3])
def test_turns_are_counted_exactly_despite_noise_and_the_drop(speed, step):
    """0.95 m/s of a 5 in wheel, and slower; also in the slices of a late computer."""
    encoder, accumulator = AbsoluteEncoder(np.random.default_rng(1)), Accumulator()
    worst = 0.0
    times = np.arange(0.0, 40.0, step)
    angles = 1e-4 + speed * times  # from the drop's edge
    for angle, time in zip(angles.tolist(), times.tolist(), strict=True):
        accumulator.add(encoder.read(angle, time), time)
        worst = max(worst, abs(accumulator.count - (angle - angles[0]) / STEP))
    assert accumulator.count == pytest.approx((angles[-1] - angles[0]) / STEP, abs=25)
    # The residual of the filter: 2 mm of travel, for a moment.
    assert worst < 20 * step / 1e-3 + 5


def test_a_wheel_at_rest_on_the_drop_is_not_counted():
    encoder, accumulator = AbsoluteEncoder(np.random.default_rng(2), noise=3.0), Accumulator()
    for k in range(20_000):
        accumulator.add(encoder.read(0.0, 1e-3 * k), 1e-3 * k)
    assert abs(accumulator.count) < 30


def test_a_real_jump_is_accepted_after_a_few_readings():
    accumulator = Accumulator()
    for k, reading in enumerate([10, 10, 1000, 1000, 1000, 1000, 1005]):
        accumulator.add(reading, 1e-3 * k)
    assert (accumulator.count, accumulator.reading) == (995, 1005)
