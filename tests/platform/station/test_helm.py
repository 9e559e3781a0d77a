"""The helm: one driver, timeouts, and the emergency stop."""

import math
import threading
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from impslam.platform.devices.base import DriveDevice
from impslam.platform.station import helm as module
from impslam.platform.station.helm import COMMAND_TIMEOUT, PERIOD, Helm, HelmError


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
def helm(wheels):
    return Helm(wheels, (0.5, 1.0))


def test_a_command_reaches_the_wheels_at_once(helm, wheels, clock):
    helm.take("a", "Ann")
    helm.drive("a", 0.2, -0.3)
    assert wheels.commands[-1][1:] == (0.2, -0.3)
    assert helm.state().speed == 0.2


@pytest.mark.parametrize(
    ("age", "moves"), [(COMMAND_TIMEOUT - 1e-6, True), (COMMAND_TIMEOUT + 1e-6, False)]
)
def test_a_command_is_valid_for_the_timeout_and_no_longer(helm, wheels, clock, age, moves):
    helm.take("a", "Ann")
    helm.drive("a", 0.2, 0.1)
    clock[0] += age
    helm._send()
    assert wheels.commands[-1][1:] == ((0.2, 0.1) if moves else (0.0, 0.0))


@pytest.mark.parametrize("age", [COMMAND_TIMEOUT, 0.31, 1.0, 60.0])
def test_a_late_command_is_dropped(helm, wheels, clock, age):
    helm.take("a", "Ann")
    helm.drive("a", 0.2, 0.1, age)
    helm._send()
    assert not [command for command in wheels.commands if command[1:] != (0.0, 0.0)]


def test_a_command_times_out_after_it_was_given_not_received(helm, wheels, clock):
    helm.take("a", "Ann")
    helm.drive("a", 0.2, 0.1, 0.2)
    clock[0] += COMMAND_TIMEOUT - 0.2 - 1e-6
    helm._send()
    assert wheels.commands[-1][1:] == (0.2, 0.1)
    clock[0] += 2e-6
    helm._send()
    assert wheels.commands[-1][1:] == (0.0, 0.0)


def test_the_robot_stops_when_commands_stop(wheels):
    helm = Helm(wheels, (0.5, 1.0))
    helm.start()
    helm.take("a", "Ann")
    helm.drive("a", 0.2, 0.0)
    given_at = time.monotonic()
    time.sleep(COMMAND_TIMEOUT + 6 * PERIOD)
    helm.stop()
    last = max(t for t, speed, _ in wheels.commands if speed > 0.0)
    assert last - given_at < COMMAND_TIMEOUT + 0.05
    assert wheels.commands[-1][1:] == (0.0, 0.0)
    assert not [thread for thread in threading.enumerate() if thread.name == "helm"]


def test_only_one_drives_and_errors_name_the_driver(helm, clock):
    helm.take("a", "Ann")
    helm.take("a", "Ann")
    with pytest.raises(HelmError, match="Ann is driving"):
        helm.take("b", "Bob")
    with pytest.raises(HelmError, match="take control"):
        helm.drive("b", 0.1, 0.0)
    helm.leave("b")
    assert helm.state().name == "Ann"
    helm.leave("a")
    helm.take("b", "Bob")
    assert helm.state().driver == "b"


def test_leaving_the_helm_stops_the_robot(helm, wheels, clock):
    helm.take("a", "Ann")
    helm.drive("a", 0.2, 0.0)
    helm.leave("a")
    helm._send()
    assert wheels.commands[-1][1:] == (0.0, 0.0)


def test_anyone_can_trigger_the_emergency_stop(helm, wheels, clock):
    helm.take("a", "Ann")
    helm.drive("a", 0.2, 0.0)
    before = len(wheels.commands)
    helm.emergency_stop("Bob")
    assert wheels.stopped
    helm.drive("a", 0.2, 0.0)
    helm._send()
    assert len(wheels.commands) == before  # nothing is sent that could move it
    assert helm.state().stopped == "emergency stop by Bob"
    with pytest.raises(HelmError, match="take control"):
        helm.release("b")
    helm.release("a")
    assert not wheels.stopped
    helm._send()
    assert wheels.commands[-1][1:] == (0.0, 0.0)  # earlier commands are dropped


@given(speed=st.floats(), turn_rate=st.floats())
def test_commands_are_clipped_to_the_limits(speed, turn_rate):
    wheels = Wheels()
    helm = Helm(wheels, (0.5, 1.0))
    helm.take("a", "Ann")
    if math.isfinite(speed) and math.isfinite(turn_rate):
        helm.drive("a", speed, turn_rate)
    else:
        with pytest.raises(HelmError, match="not finite"):
            helm.drive("a", speed, turn_rate)
    assert all(abs(v) <= 0.5 and abs(w) <= 1.0 for _, v, w in wheels.commands)


def test_a_driver_takes_over_from_another_page_and_the_robot_stops(helm, wheels, clock):
    helm.take("a", "Ann")
    helm.drive("a", 0.2, 0.0)
    helm.take("b", "Ann")
    assert (helm.state().driver, helm.state().speed) == ("b", 0.0)
    with pytest.raises(HelmError):
        helm.drive("a", 0.2, 0.0)
    helm.leave("a")  # that page is closed
    helm.drive("b", 0.1, 0.0)
    assert helm.state().speed == 0.1


def test_a_robot_without_a_drive_device_refuses_drivers():
    helm = Helm(None, (0.5, 1.0))
    with pytest.raises(HelmError, match="has no drive"):
        helm.take("a", "Ann")
    helm.emergency_stop("Ann")


def test_events_of_the_helm_are_notified_once(wheels, clock):
    notices = []
    helm = Helm(wheels, (0.5, 1.0), lambda level, text: notices.append((level, text)))
    for _ in range(2):
        helm.take("a", "Ann")
        helm.emergency_stop("Bob")
    helm.release("a")
    helm.leave("a")
    assert notices == [
        ("info", "Ann takes control"),
        ("warning", "emergency stop by Bob"),
        ("info", "emergency stop released by Ann"),
        ("info", "Ann releases control"),
    ]


def test_every_motion_and_each_new_stop_is_recorded(wheels, clock):
    sent = []
    helm = Helm(wheels, (0.5, 1.0), on_command=lambda *command: sent.append(command))
    helm._send()
    helm.take("a", "Ann")
    helm.drive("a", 0.2, 0.1)
    helm._send()
    clock[0] += 1.0
    helm._send()
    helm._send()
    assert sent == [(0.2, 0.1), (0.2, 0.1), (0.0, 0.0)]


def test_an_earlier_stop_of_the_device_is_shown_and_can_be_released(helm, wheels):
    wheels.emergency_stop()  # by an earlier program
    assert helm.state().stopped == "emergency stop held by wheels"
    helm.take("a", "Ann")
    helm.release("a")
    assert not wheels.stopped
    assert helm.state().stopped == ""


def test_helm_and_device_agree_after_a_stop_and_a_release_at_the_same_time(helm, wheels):
    """The device gets them in the order of the helm."""
    helm.take("a", "Ann")
    entered, resume = threading.Event(), threading.Event()

    def slowly():
        entered.set()
        resume.wait(1.0)
        wheels.__dict__["latched"] = True

    wheels.__dict__["emergency_stop"] = slowly
    stopping = threading.Thread(target=helm.emergency_stop, args=("Bob",))
    stopping.start()
    assert entered.wait(5.0)
    releasing = threading.Thread(target=helm.release, args=("a",))
    releasing.start()
    releasing.join(0.1)
    resume.set()
    stopping.join(5.0)
    releasing.join(5.0)
    assert not wheels.stopped
    assert helm.state().stopped == ""


def test_an_error_while_sending_ends_neither_the_thread_nor_the_stop(wheels, caplog):
    helm = Helm(wheels, (0.5, 1.0))
    faults = []

    def faulty(speed, turn_rate):
        if not faults:
            faults.append(speed)
            raise ZeroDivisionError("oops")
        wheels.commands.append((time.monotonic(), speed, turn_rate))

    wheels.__dict__["drive"] = faulty
    helm.start()
    end = time.monotonic() + 5.0
    while not wheels.commands and time.monotonic() < end:
        time.sleep(0.01)
    helm.stop()
    assert wheels.commands
    assert "oops" in caplog.text
