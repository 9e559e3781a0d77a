"""Whether a robot stands although it is driven."""

import pytest

from impslam.platform.devices.motion_watch import MotionWatch

BEGIN = 1.7e9  # s, host time


def begins(speeds, command=(0.2, 0.2), seconds=4.0, driven=True, radius=0.0635):
    """Return the times at which a robot with wheels at these speeds (m/s) begins to stand."""
    watch, found = MotionWatch(), []
    watch.command(*command)
    for step in range(round(100 * seconds)):
        time = 0.01 * step
        angles = speeds[0] * time / radius, speeds[1] * time / radius
        if watch.update(angles, BEGIN + time, driven=driven):
            found.append(time)
    return found


@pytest.mark.parametrize("speed", [0.05, 0.2, 1.0])
def test_standing_wheels_are_noticed_once_after_a_second_and_a_decimetre(speed):
    assert begins((0.0, 0.0), (speed, -speed)) == [pytest.approx(max(1.0, 0.1 / speed), abs=0.011)]


def test_wheels_that_only_tremble_stand():
    watch = MotionWatch()
    watch.command(0.2, 0.2)
    assert [watch.update((0.006 * (k % 2), 0.0), 0.01 * k, driven=True) for k in range(200)].count(
        True
    )


def test_a_robot_that_moves_does_not_stand():
    assert not begins((0.2, 0.2))
    assert not begins((0.02, 0.02))  # a tenth of the command, uphill
    assert not begins((0.0, 0.3), (-0.1, 0.4))  # a curve about the left wheel


def test_a_robot_that_is_not_driven_may_stand():
    assert not begins((0.0, 0.0), (0.0, 0.0))
    assert not begins((0.0, 0.0), driven=False)
