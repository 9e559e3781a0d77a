"""The wheels follow the commanded speed under load, and zero stops them."""

import numpy as np
import pytest

from impslam.platform.devices.autopilot_messages import DriveCommand, FrameType
from impslam.platform.devices.framing import Encoder
from impslam.platform.virtual.autopilot import AutopilotEmulator
from impslam.platform.virtual.wheel_speed import SpeedControl, SpeedController
from impslam.simulation.body import Body
from impslam.simulation.robot import SimulatedRobot
from impslam.simulation.world import load_world

pytest.importorskip("cobs")
BEGIN = 200  # ms, when the command comes


def driven(speeds, happens=lambda body, time: None, seconds=2.0, control=None, stop=None):
    """Return the speeds (n, 2) of the driven wheels every ms, of an autopilot with a controller."""
    body = Body(load_world("room"), SimulatedRobot.perfect(), seed=1)
    autopilot = AutopilotEmulator(body, control=control or SpeedController())
    host, found = Encoder(1), []
    for k in range(round(1000 * seconds)):
        body.advance(k * 1e-3)
        happens(body, k * 1e-3)
        if stop is not None and k == stop:
            autopilot.receive(host.encode(FrameType.STOP, b"")[1], k * 1e-3)
        elif k >= BEGIN and k % 50 == 0:
            command = DriveCommand(*(round(1000 * speed) for speed in speeds))
            autopilot.receive(host.encode(FrameType.DRIVE, command.pack())[1], k * 1e-3)
        autopilot.due(k * 1e-3)
        found.append(body.motors)
    return np.array(found)


def test_gains_follow_from_the_motor():
    known = SpeedControl(time_constant=0.3, feedback=0.05, period=0.01)
    assert known.gain == pytest.approx(0.3 / 0.06)
    assert known.integral_time == pytest.approx(0.24)
    assert SpeedControl(time_constant=0.1).integral_time == pytest.approx(0.1)


@pytest.mark.parametrize("speeds", [(0.3, 0.3), (-0.2, 0.3), (0.2, -0.2), (-0.3, -0.3)])
def test_a_step_is_tracked_along_the_reference(speeds):
    found = driven(speeds, seconds=1.2)
    wanted = np.array(speeds)
    np.testing.assert_allclose(found[-300:].mean(axis=0), wanted, atol=0.002)
    assert np.abs(found - wanted)[BEGIN + 300 :].max() < 0.015  # some counts of 0.1 mm in 10 ms
    # Twice as fast as the motor alone, which is at 1 - exp(-1.5) of it after 150 ms.
    assert (np.abs(found[BEGIN + 150]) > 0.9 * np.abs(wanted)).all()
    assert (np.abs(found) < 1.05 * np.abs(wanted)).all()


def test_a_load_is_compensated():
    def loaded(body, time):
        body.load = 0.25 * (time >= 1.0)

    found = driven((0.3, 0.3), loaded, seconds=3.0)
    assert found[1000:1400].min() == pytest.approx(0.26, abs=0.02)  # of 0.225 without control
    np.testing.assert_allclose(found[-500:].mean(axis=0), 0.3, atol=0.003)


def test_blocked_wheels_do_not_wind_up_the_integral():
    def blocked(body, time):
        for side in ("left", "right"):
            body.stall(side, 0.6 <= time < 1.6)

    kept = driven((0.3, 0.3), blocked, seconds=2.6).max()
    stored = driven(
        (0.3, 0.3), blocked, seconds=2.6, control=SpeedController(anti_windup=False)
    ).max()
    assert kept < 0.5
    assert stored > 0.7


def test_the_maximum_voltage_is_not_exceeded():
    control = SpeedController()
    control.commanded = np.array([5.0, -5.0])
    given = np.array([control.step((0, 0)) for _ in range(300)])
    assert np.abs(given).max() <= control.settings.top_speed


def test_a_stop_is_immediate_and_resets_the_controller():
    commands = []

    def note(body, time):
        commands.append(body.commanded)

    driven((0.3, 0.3), note, seconds=1.0, stop=700)
    told = np.array(commands)
    assert told[699].min() > 0.2
    assert not told[701:].any()


def test_without_counts_between_two_steps_nothing_moves():
    control = SpeedController()
    assert not control.step((100, 200)).any()
    assert not control.step((100, 200)).any()
