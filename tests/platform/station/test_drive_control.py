"""Drive control: one driver, timeouts, and the emergency stop."""

import math
import threading
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from impslam.platform.devices.base import DriveDevice
from impslam.platform.station import drive_control as module
from impslam.platform.station.drive_control import (
    COMMAND_TIMEOUT,
    PERIOD,
    DriveControl,
    DriveControlError,
)


class Wheels(DriveDevice):
    """Records commands and their times."""

    name = "wheels"

    def model_post_init(self, context):
        self.__dict__["commands"] = []
        self.__dict__["latched"] = False

    @property
    def stopped(self):
        return self.__dict__["latched"]

    def _serve(self) -> None:
        self._stopping.wait()

    def drive(self, speed, turn_rate):
        self.commands.append((time.monotonic(), speed, turn_rate))

    def emergency_stop(self):
        self.__dict__["latched"] = True

    def release(self):
        self.__dict__["latched"] = False


@pytest.fixture
def wheels():
    return Wheels()


@pytest.fixture
def clock(monkeypatch):
    """A clock that is set manually."""
    moment = [1000.0]
    monkeypatch.setattr(module, "now", lambda: moment[0])
    return moment


@pytest.fixture
def drive_control(wheels):
    return DriveControl(wheels, (0.5, 1.0))


def test_a_command_reaches_the_wheels_at_once(drive_control, wheels, clock):
    drive_control.take("a", "Ann")
    drive_control.drive("a", 0.2, -0.3)
    assert wheels.commands[-1][1:] == (0.2, -0.3)
    assert drive_control.state().speed == 0.2


@pytest.mark.parametrize(
    ("age", "moves"), [(COMMAND_TIMEOUT - 1e-6, True), (COMMAND_TIMEOUT + 1e-6, False)]
)
def test_a_command_is_valid_for_the_timeout_and_no_longer(drive_control, wheels, clock, age, moves):
    drive_control.take("a", "Ann")
    drive_control.drive("a", 0.2, 0.1)
    clock[0] += age
    drive_control._send()
    assert wheels.commands[-1][1:] == ((0.2, 0.1) if moves else (0.0, 0.0))


@pytest.mark.parametrize("age", [COMMAND_TIMEOUT, 0.31, 1.0, 60.0])
def test_a_late_command_is_dropped(drive_control, wheels, clock, age):
    drive_control.take("a", "Ann")
    drive_control.drive("a", 0.2, 0.1, age)
    drive_control._send()
    assert not [command for command in wheels.commands if command[1:] != (0.0, 0.0)]


def test_a_command_times_out_after_it_was_given_not_received(drive_control, wheels, clock):
    drive_control.take("a", "Ann")
    drive_control.drive("a", 0.2, 0.1, 0.2)
    clock[0] += COMMAND_TIMEOUT - 0.2 - 1e-6
    drive_control._send()
    assert wheels.commands[-1][1:] == (0.2, 0.1)
    clock[0] += 2e-6
    drive_control._send()
    assert wheels.commands[-1][1:] == (0.0, 0.0)


def test_the_robot_stops_when_commands_stop(wheels):
    drive_control = DriveControl(wheels, (0.5, 1.0))
    drive_control.start()
    drive_control.take("a", "Ann")
    drive_control.drive("a", 0.2, 0.0)
    given_at = time.monotonic()
    time.sleep(COMMAND_TIMEOUT + 6 * PERIOD)
    drive_control.stop()
    last = max(t for t, speed, _ in wheels.commands if speed > 0.0)
    assert last - given_at < COMMAND_TIMEOUT + 0.05
    assert wheels.commands[-1][1:] == (0.0, 0.0)
    assert not [thread for thread in threading.enumerate() if thread.name == "drive_control"]


def test_only_one_drives_and_errors_name_the_driver(drive_control, clock):
    drive_control.take("a", "Ann")
    drive_control.take("a", "Ann")
    with pytest.raises(DriveControlError, match="Ann is driving"):
        drive_control.take("b", "Bob")
    with pytest.raises(DriveControlError, match="take control"):
        drive_control.drive("b", 0.1, 0.0)
    drive_control.leave("b")
    assert drive_control.state().name == "Ann"
    drive_control.leave("a")
    drive_control.take("b", "Bob")
    assert drive_control.state().driver == "b"


def test_leaving_stops_the_robot(drive_control, wheels, clock):
    drive_control.take("a", "Ann")
    drive_control.drive("a", 0.2, 0.0)
    drive_control.leave("a")
    drive_control._send()
    assert wheels.commands[-1][1:] == (0.0, 0.0)


def test_anyone_can_trigger_the_emergency_stop(drive_control, wheels, clock):
    drive_control.take("a", "Ann")
    drive_control.drive("a", 0.2, 0.0)
    before = len(wheels.commands)
    drive_control.emergency_stop("Bob")
    assert wheels.stopped
    drive_control.drive("a", 0.2, 0.0)
    drive_control._send()
    assert len(wheels.commands) == before  # nothing is sent that could move it
    assert drive_control.state().stopped == "emergency stop by Bob"
    with pytest.raises(DriveControlError, match="take control"):
        drive_control.release("b")
    drive_control.release("a")
    assert not wheels.stopped
    drive_control._send()
    assert wheels.commands[-1][1:] == (0.0, 0.0)  # earlier commands are dropped


@given(speed=st.floats(), turn_rate=st.floats())
def test_commands_are_clipped_to_the_limits(speed, turn_rate):
    wheels = Wheels()
    drive_control = DriveControl(wheels, (0.5, 1.0))
    drive_control.take("a", "Ann")
    if math.isfinite(speed) and math.isfinite(turn_rate):
        drive_control.drive("a", speed, turn_rate)
    else:
        with pytest.raises(DriveControlError, match="not finite"):
            drive_control.drive("a", speed, turn_rate)
    assert all(abs(v) <= 0.5 and abs(w) <= 1.0 for _, v, w in wheels.commands)


def test_a_driver_takes_over_from_another_page_and_the_robot_stops(drive_control, wheels, clock):
    drive_control.take("a", "Ann")
    drive_control.drive("a", 0.2, 0.0)
    drive_control.take("b", "Ann")
    assert (drive_control.state().driver, drive_control.state().speed) == ("b", 0.0)
    with pytest.raises(DriveControlError):
        drive_control.drive("a", 0.2, 0.0)
    drive_control.leave("a")  # that page is closed
    drive_control.drive("b", 0.1, 0.0)
    assert drive_control.state().speed == 0.1


def test_a_robot_without_a_drive_device_refuses_drivers():
    drive_control = DriveControl(None, (0.5, 1.0))
    with pytest.raises(DriveControlError, match="has no drive"):
        drive_control.take("a", "Ann")
    drive_control.emergency_stop("Ann")


def test_events_are_notified_once(wheels, clock):
    notices = []
    drive_control = DriveControl(
        wheels, (0.5, 1.0), lambda level, text: notices.append((level, text))
    )
    for _ in range(2):
        drive_control.take("a", "Ann")
        drive_control.emergency_stop("Bob")
    drive_control.release("a")
    drive_control.leave("a")
    assert notices == [
        ("info", "Ann takes control"),
        ("warning", "emergency stop by Bob"),
        ("info", "emergency stop released by Ann"),
        ("info", "Ann releases control"),
    ]


def test_every_motion_and_each_new_stop_is_recorded(wheels, clock):
    sent = []
    drive_control = DriveControl(
        wheels, (0.5, 1.0), on_command=lambda *command: sent.append(command)
    )
    drive_control._send()
    drive_control.take("a", "Ann")
    drive_control.drive("a", 0.2, 0.1)
    drive_control._send()
    clock[0] += 1.0
    drive_control._send()
    drive_control._send()
    assert sent == [(0.2, 0.1), (0.2, 0.1), (0.0, 0.0)]


def test_an_earlier_stop_of_the_device_is_shown_and_can_be_released(drive_control, wheels):
    wheels.emergency_stop()  # by an earlier program
    assert drive_control.state().stopped == "emergency stop held by wheels"
    drive_control.take("a", "Ann")
    drive_control.release("a")
    assert not wheels.stopped
    assert drive_control.state().stopped == ""


def test_state_and_device_agree_after_a_stop_and_a_release_at_the_same_time(drive_control, wheels):
    """The device gets them in the order of drive control."""
    drive_control.take("a", "Ann")
    entered, resume = threading.Event(), threading.Event()

    def slowly():
        entered.set()
        resume.wait(1.0)
        wheels.__dict__["latched"] = True

    wheels.__dict__["emergency_stop"] = slowly
    stopping = threading.Thread(target=drive_control.emergency_stop, args=("Bob",))
    stopping.start()
    assert entered.wait(5.0)
    releasing = threading.Thread(target=drive_control.release, args=("a",))
    releasing.start()
    releasing.join(0.1)
    resume.set()
    stopping.join(5.0)
    releasing.join(5.0)
    assert not wheels.stopped
    assert drive_control.state().stopped == ""


def test_an_error_while_sending_ends_neither_the_thread_nor_the_stop(wheels, caplog):
    drive_control = DriveControl(wheels, (0.5, 1.0))
    faults = []

    def faulty(speed, turn_rate):
        if not faults:
            faults.append(speed)
            raise ZeroDivisionError("oops")
        wheels.commands.append((time.monotonic(), speed, turn_rate))

    wheels.__dict__["drive"] = faulty
    drive_control.start()
    end = time.monotonic() + 5.0
    while not wheels.commands and time.monotonic() < end:
        time.sleep(0.01)
    drive_control.stop()
    assert wheels.commands
    assert "oops" in caplog.text
