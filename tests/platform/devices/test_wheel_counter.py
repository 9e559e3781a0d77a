"""A wheel's angle is continuous across wraps of the accumulator and reboots."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from impslam.platform.devices.wheel_counter import WheelCounter, wrapped_difference

STEP = 2 * math.pi / 4096


def test_a_wheel_counter_continues_by_the_smaller_rotation():
    wheel = WheelCounter(4096, 4096)
    assert wheel(10, 4000) == 0.0
    wheel.restart()
    assert wheel(-3, 100) == pytest.approx(196 * STEP)
    assert wheel(2, 105) == pytest.approx(201 * STEP)
    wheel.restart()
    assert wheel(0, 4090) == pytest.approx((201 - 111) * STEP)


@given(st.lists(st.integers(-(2**30), 2**30), max_size=30))
def test_a_wheel_counter_tracks_any_rotation_across_wraps(steps):
    wheel, count = WheelCounter(4096, 4096), 2**31 - 5
    wheel(count, 0)
    for total in np.cumsum(steps, dtype=np.int64).tolist():
        raw = (2**31 - 5 + total + 2**31) % 2**32 - 2**31
        assert wheel(raw, 0) == pytest.approx(total * STEP, rel=1e-12)


@given(st.integers(-(2**40), 2**40), st.integers(1, 2**33))
def test_the_wrapped_difference_is_within_half_a_turn_and_consistent(difference, half):
    turned = wrapped_difference(difference, 2 * half)
    assert -half <= turned < half
    assert (turned - difference) % (2 * half) == 0


def test_an_encoder_of_other_counts_is_bridged_by_its_angle():
    wheel = WheelCounter(1000, 4096)
    wheel(0, 0)
    wheel.restart()
    assert wheel(7, 1024) == pytest.approx(math.pi / 2)
    assert wheel(507, 3072) == pytest.approx(math.pi / 2 + math.pi)
