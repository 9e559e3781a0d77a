"""The autopilot: encoders, inertial unit and motors on a micro-controller (thesis 3.3, 3.4).

docs/autopilot-protocol.md specifies the protocol byte by byte.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

from pydantic import PrivateAttr

from impslam.component import parameter, register
from impslam.errors import MessageError
from impslam.platform.devices.autopilot_link import CommandLink
from impslam.platform.devices.autopilot_messages import (
    FROM_AUTOPILOT,
    Ack,
    Flag,
    FrameType,
    Hello,
    Sensors,
)
from impslam.platform.devices.autopilot_readings import Readings
from impslam.platform.devices.base import DeviceError, DriveDevice, now
from impslam.platform.devices.clock import DeviceClock
from impslam.platform.devices.framing import Decoder, Frame
from impslam.platform.devices.motion_watch import MotionWatch
from impslam.platform.devices.port import opened, read_some
from impslam.types import DeviceTime, WheelAngles

REOPEN_TIMEOUT = 2.0  # s without a frame until the port is reopened, as after a hang of the adapter
MAX_ABSENCE = 300.0  # s for which losses are counted; the sequence wraps after 655 s

Level: TypeAlias = Literal["info", "warning"]

_FLAGS: dict[Flag, tuple[Level, str, str]] = {
    Flag.STOPPED: ("warning", "emergency stop is active", "emergency stop released"),
    Flag.DEAD_MAN: ("info", "no command for 0.5 s, motors off", ""),
    Flag.STALL_LEFT: ("warning", "left motor stalls", "left motor turns again"),
    Flag.STALL_RIGHT: ("warning", "right motor stalls", "right motor turns again"),
    Flag.LOW_SUPPLY: ("warning", "supply is low; charge the battery", "supply is normal again"),
}
_STANDS = (
    "the motors are driven, but the wheels stand: the robot is blocked, or its motors have no power"
)


@dataclass(slots=True)
class _State:
    """The state of the micro-controller; it outlives a connection."""

    readings: Readings
    watch: MotionWatch = field(default_factory=MotionWatch)
    clock: DeviceClock = field(default_factory=DeviceClock)
    decoder: Decoder | None = None
    boot: int | None = None
    boots: int | None = None
    hello: Hello | None = None
    last_clock: int = 0
    flags: int = Flag.DEAD_MAN  # the initial state needs no event
    opened_at: float = 0.0
    received_at: float = -math.inf
    silent: bool = False


@register("autopilot")
class Autopilot(DriveDevice):
    """Wheel encoders, inertial unit, climate and motors, on a micro-controller over UART."""

    port: str = parameter(
        "/dev/imp-autopilot", "1", "serial port, or socket://HOST:PORT for a line over TCP"
    )
    baud: int = parameter(
        460800, "bit/s", "speed of the line; 16 % of it is used, see the protocol", gt=0
    )
    track: float = parameter(0.40, "m", "distance between the left and right driven wheels", gt=0)
    skid: float = parameter(
        1.5625,
        "1",
        "ratio of the speed difference of both sides to that of rolling wheels in a turn, as the driven "
        "wheels skid: 1 + (wheelbase / track)^2 by Coulomb friction, for 0.30 m and 0.40 m",
        ge=1,
    )
    top_speed: float = parameter(
        1.0,
        "m/s",
        "limit of a wheel command: 150 rpm of a 5 inch wheel; the curvature is kept",
        gt=0,
        le=10,
    )
    counts_per_turn: int = parameter(4096, "1", "accumulator counts per wheel turn", gt=0)
    min_delay: float = parameter(
        0.0015, "s", "minimum delay from sampling to arrival: 69 bytes at 460800 baud", ge=0
    )

    _link: CommandLink = PrivateAttr()
    _state: _State = PrivateAttr()

    def model_post_init(self, context: object, /) -> None:
        """Create the command link and the initial state."""
        self._link = CommandLink(self._count)
        self._state = _State(Readings(self.counts_per_turn))

    # ------------------------------------------------------------------ commands

    def drive(self, speed: float, turn_rate: float) -> None:
        """Command a forward speed (m/s) and a turn rate (rad/s); see `DriveDevice.drive`."""
        left, right = self.wheel_speeds(speed, turn_rate)
        self._state.watch.command(left, right)
        self._link.drive(left, right)

    def emergency_stop(self) -> None:
        """Stop and stay stopped; see `DriveDevice.emergency_stop`."""
        self._link.stop(True)

    def release(self) -> None:
        """End an emergency stop; the robot does not move until the next drive command."""
        self._link.stop(False)

    @property
    def stopped(self) -> bool:
        """Whether an emergency stop is active and no release has been sent."""
        return bool(self._state.flags & Flag.STOPPED) and not self._link.releasing

    @property
    def blockage(self) -> str:
        """Which motors stall, or that the wheels stand; see `DriveDevice.blockage`."""
        flags = self._state.flags
        stalls = [_FLAGS[f][1] for f in (Flag.STALL_LEFT, Flag.STALL_RIGHT) if flags & f]
        return ", ".join(stalls) or (_STANDS if self._state.watch.stands else "")

    def latency(self) -> tuple[float, float]:
        """Return median and 99th percentile of the time from command to answer, s; NaN before one."""
        return self._link.latency()

    def wheel_speeds(self, speed: float, turn_rate: float) -> tuple[float, float]:
        """Return the surface speeds of the driven wheels, left and right, m/s.

        If one exceeds the top speed, both are scaled down, so that the robot keeps to the curve.
        """
        if not (math.isfinite(speed) and math.isfinite(turn_rate)):
            raise ValueError(f"a command of {speed} m/s and {turn_rate} rad/s is not finite")
        half = 0.5 * self.skid * self.track * turn_rate
        left, right = speed - half, speed + half
        slower = max(1.0, max(abs(left), abs(right)) / self.top_speed)
        return left / slower, right / slower

    # ------------------------------------------------------------------ connection

    def _serve(self) -> None:
        with opened(self.port, self.baud) as port:
            try:
                decoder = self._prepare()
                self._link.attach(port)
                while not self._stopping.is_set():
                    data = read_some(port)
                    moment = now()
                    for frame in decoder.feed(data):
                        self._process_frame(frame, moment)
                    self._check_silence(moment)
                    self._link.update(moment)
            finally:
                self._link.detach()

    def _prepare(self) -> Decoder:
        state, moment = self._state, now()
        if state.decoder is None:
            state.decoder = Decoder(FROM_AUTOPILOT, self._count)
        state.decoder.restart(keep_sequence=moment - state.received_at < MAX_ABSENCE)
        state.hello, state.opened_at, state.silent = None, moment, False
        return state.decoder

    def _check_silence(self, moment: float) -> None:
        state = self._state
        silence = moment - max(state.received_at, state.opened_at)
        timeout = max(REOPEN_TIMEOUT, self.timeout)
        if silence > self.timeout and not state.silent:
            state.silent = True
            self._count("silences", 1)
        if silence > timeout:  # with the same text each time, so that it is notified once
            raise DeviceError(
                f"{self.port}: no valid message for {timeout:.1f} s; check the autopilot's supply, "
                "its wiring and the baud rate"
            )
        if state.hello is None and moment - state.opened_at > REOPEN_TIMEOUT:
            raise DeviceError(f"{self.port}: frames, but no HELLO; check the autopilot's firmware")

    # ------------------------------------------------------------------ frames

    def _process_frame(self, frame: Frame, arrived: float) -> None:
        state = self._state
        state.received_at, state.silent = arrived, False
        if frame.boot != state.boot:
            self._restart(state.boot is not None)
            state.boot = frame.boot
        try:
            if frame.type == FrameType.SENSORS:
                self._on_sensors(Sensors.parse(frame.payload), arrived)
            elif frame.type == FrameType.ACK:
                self._link.on_ack(Ack.parse(frame.payload), arrived)
            else:
                self._on_hello(Hello.parse(frame.payload))
        except MessageError as error:
            self._count("refused", 1)
            if self._vitals.counts["refused"] == 1:
                self._notify("warning", str(error))

    def _restart(self, rebooted: bool) -> None:
        """Continue across a reboot: clock and accumulators begin at 0, and its time must be set."""
        if rebooted:
            self._count("reboots", 1)
        self._state.clock.restart()
        self._state.last_clock = 0
        self._state.readings.restart()
        self._link.request_hello()

    def _on_hello(self, hello: Hello) -> None:
        state = self._state
        who = (
            f"firmware {hello.major}.{hello.minor}, boot {hello.boots} "
            f"({hello.reset.name.lower().replace('_', '-')})"
        )
        if state.boots not in {None, hello.boots}:
            self._notify("warning", f"rebooted: {who}")
        if state.hello is None:
            self._ready(f"{who} at {self.port}")
        state.boots, state.hello = hello.boots, hello

    def _on_sensors(self, sensors: Sensors, arrived: float) -> None:
        state = self._state
        if sensors.clock < state.last_clock:  # a reboot, even under the same boot number
            self._restart(True)
        state.last_clock = sensors.clock
        self._notify_flags(sensors.flags)
        device = 1e-6 * sensors.clock
        stamp = self._stamp(device, arrived)
        if state.hello is None:
            self._count("before HELLO", 1)
            state.readings.follow(sensors)
            return
        for message in state.readings.messages(sensors, state.hello, stamp):
            self._deliver(message, arrived, device)
            if isinstance(message, WheelAngles):
                self._watch_motion(message)
        self._deliver(DeviceTime(stamp, self.title, device), arrived, device)

    def _watch_motion(self, wheels: WheelAngles) -> None:
        """Notify once that the robot stands although it is driven."""
        state = self._state
        driven = not state.flags & (Flag.STOPPED | Flag.DEAD_MAN)
        if state.watch.update((wheels.left, wheels.right), wheels.stamp, driven=driven):
            self._notify("warning", _STANDS)

    def _stamp(self, device: float, arrived: float) -> float:
        """Return the host time of a reading, and count jumps and stalls of the clocks."""
        clock = self._state.clock
        restarts, stalls = clock.restarts, clock.stalls
        clock.observe(device, arrived - self.min_delay)
        if clock.restarts > restarts:
            self._count("clock jumps", 1)
            self._notify("warning", "a clock jumped, the micro-controller's or this computer's")
        if clock.stalls > stalls:
            self._count("stalls", 1)
        return clock.to_host(device)

    def _notify_flags(self, flags: Flag) -> None:
        state = self._state
        for flag, (level, set_, cleared) in _FLAGS.items():
            if flags & flag and not state.flags & flag:
                self._notify(level, set_)
            elif cleared and state.flags & flag and not flags & flag:
                self._notify("info", cleared)
        state.flags = flags
        self._link.check_stopped(bool(flags & Flag.STOPPED))
