"""The systematic errors of turns, which wheels and gyro share."""

import numpy as np
import pytest

from impslam.noise import SystematicErrors
from impslam.odometry.turn_errors import TurnErrors

WHEELS = SystematicErrors(turn_per_distance=0.01, turn=0.03)


def shares(*of_gyro, bias=0.002):
    return np.column_stack([of_gyro, np.full(len(of_gyro), bias)])


@pytest.mark.parametrize("batches", [[[3], [6], [8]], [[3, 6, 8]], [[3, 6], [8]]])
def test_a_turn_that_the_gyro_did_not_measure_is_that_of_the_wheels(batches):
    errors = TurnErrors(WHEELS, 0.02)
    errors.add(np.arange(8), shares(0.9, 0.9, 0.9, 0.9, np.nan, 0.8, 0.8, 0.7))
    found = [one for orders in batches for one in errors.at(np.array(orders))]
    assert [one.gyro_share for one in found] == [0.9, 0.0, 0.7]
    assert {one.gyro_bias for one in found} == {0.002}


def test_without_readings_of_a_gyro_the_errors_are_those_of_the_wheels():
    errors = TurnErrors(WHEELS, 0.02)
    assert errors.at(np.array([0])) == [WHEELS]
    errors.add(np.arange(2), shares(np.nan, np.nan, bias=0.0))
    assert errors.at(np.array([2, 5])) == [WHEELS, WHEELS]
    assert list(errors.at(np.empty(0, np.int64))) == []
