"""An emulator of the autopilot's firmware, as docs/autopilot-protocol.md specifies it."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable

import numpy as np

from impslam.errors import MessageError
from impslam.platform.devices.autopilot_messages import (
    COMMANDS,
    Ack,
    DriveCommand,
    Flag,
    FrameType,
    Hello,
    Reset,
    Result,
    Sensors,
    SetTime,
    parse_empty,
)
from impslam.platform.devices.framing import Decoder, Encoder, Frame
from impslam.platform.virtual.base import Vehicle
from impslam.platform.virtual.wheel_encoders import AbsoluteEncoder, Accumulator
from impslam.platform.virtual.wheel_speed import SpeedController
from impslam.types import Array

PERIOD = 0.01  # s between SENSORS
HELLO_INTERVAL = 1.0  # s
DEAD_MAN = 0.5  # s without a drive after which the motors are off
BOOT_TIME = 0.05  # s from reset to the first HELLO
FIRMWARE = (1, 0)

GYRO = math.radians(500.0) / 32768.0  # rad/s a step: +-500 deg/s
ACCELEROMETER = 4.0 * 9.80665 / 32768.0  # m/s^2 a step: +-4 g
ACCELEROMETER_2 = 8.0 * 9.80665 / 32768.0  # m/s^2 a step: +-8 g
MAGNETOMETER = 0.15e-6  # T a step

_FIELD = (20e-6, 45e-6)  # T, to magnetic north (x of map) and down: middle latitudes
_FIELD_NOISE = 0.3e-6  # T, two steps
_FORCE_NOISE = 0.04  # m/s^2, of the second, coarser accelerometer


class AutopilotEmulator:
    """The micro-controller without hardware: bytes in, bytes out, at given times.

    Parameters
    ----------
    vehicle : the hardware; an optional attribute `stalled` (two bools, left first) sets the flags of
        motor stalls
    drift : 1, device seconds per true second, minus 1: e.g. 30e-6
    seed : of all noise
    control : speed control of the wheels; None: commands go to the motor drivers directly

    Attributes
    ----------
    commanded : surface speeds (m/s) that the host commands, left first
    """

    def __init__(
        self,
        vehicle: Vehicle,
        *,
        drift: float = 30e-6,
        seed: int = 0,
        control: SpeedController | None = None,
    ) -> None:
        self.vehicle, self.drift, self._control = vehicle, drift, control
        self.low_supply = False
        self.counts: Counter[str] = Counter()  # errors in the bytes of the host
        self._boots = 0
        self._rng, left, right = np.random.default_rng(seed).spawn(3)
        self._encoders = AbsoluteEncoder(left), AbsoluteEncoder(right)
        self.reboot(0.0, Reset.POWER)

    # ------------------------------------------------------------------ bytes and time

    def reboot(self, time: float, reason: Reset = Reset.BROWN_OUT) -> None:
        """Reset everything except the number of boots; motors off."""
        self._command_speeds(0.0, 0.0)
        self._boots += 1
        self._reason = reason
        self._encoder = Encoder(self._boots)
        self._decoder = Decoder(COMMANDS, lambda what, n: self.counts.update({what: n}))
        self._accumulators = Accumulator(), Accumulator()
        self._ready_at = time + BOOT_TIME
        self._sensors_at = self._hello_at = self._control_at = self._ready_at
        self._out = bytearray()
        self._state = Flag.DEAD_MAN  # one of STOPPED, DEAD_MAN, and none: driving
        self._drive_until = -math.inf
        self._applied = self._applied_clock = self._host_offset = 0

    def receive(self, data: bytes, time: float) -> None:
        """Process bytes from the host; they are ignored during the boot."""
        if time < self._ready_at:
            return
        for frame in self._decoder.feed(data):
            self._execute(frame, time)

    def due(self, time: float) -> bytes:
        """Return the bytes sent until `time`; must be called every ms, like its timer interrupt."""
        if time < self._ready_at:
            return b""
        self._sample_encoders(time)
        self._check_drive_timeout(time)
        self._control_wheels(time)
        if time >= self._hello_at:
            self._hello_at = max(self._hello_at + HELLO_INTERVAL, time)
            self._send_hello(time)
        if time >= self._sensors_at:
            self._send_sensors(time)
            # Missed readings are not sent late: they would only repeat the present one.
            missed = math.floor((time - self._sensors_at) / PERIOD)
            self._sensors_at += PERIOD * (missed + 1)
        out = bytes(self._out)
        self._out.clear()
        return out

    # ------------------------------------------------------------------ sensors

    def _clock(self, time: float) -> int:
        """Return its clock, us since the reset."""
        return int((time - self._ready_at + BOOT_TIME) * (1.0 + self.drift) * 1e6)

    def _sample_encoders(self, time: float) -> None:
        for angle, encoder, accumulator in zip(
            self.vehicle.wheel_angles(), self._encoders, self._accumulators, strict=True
        ):
            accumulator.add(encoder.read(angle, time), time)

    def _send_hello(self, time: float) -> None:
        hello = Hello(
            self._boots,
            *FIRMWARE,
            self._reason,
            GYRO,
            ACCELEROMETER,
            ACCELEROMETER_2,
            MAGNETOMETER,
            self._clock(time),
            self._host_offset,
        )
        self._send_frame(FrameType.HELLO, hello.pack())

    def _send_sensors(self, time: float) -> None:
        rates, forces = self.vehicle.inertial()
        left, right = self._accumulators
        temperature, humidity = _climate(time)
        sensors = Sensors(
            clock=self._clock(time),
            counts=(_signed(left.count), _signed(right.count)),
            voltages=(left.reading or 0, right.reading or 0),
            gyro=_steps(rates, GYRO),
            accelerometer=_steps(forces, ACCELEROMETER),
            accelerometer_2=_steps(
                forces + _FORCE_NOISE * self._rng.standard_normal(3), ACCELEROMETER_2
            ),
            magnetometer=_steps(self._field(), MAGNETOMETER),
            temperature=temperature,
            humidity=humidity,
            flags=self._flags(),
            applied=self._applied,
            applied_clock=self._applied_clock,
        )
        self._send_frame(FrameType.SENSORS, sensors.pack())

    def _field(self) -> Array:
        """Return the Earth's magnetic field in the body's frame, T."""
        heading = self.vehicle.heading()
        north, down = _FIELD
        field = np.array([north * math.cos(heading), -north * math.sin(heading), -down])
        return field + _FIELD_NOISE * self._rng.standard_normal(3)

    def _flags(self) -> Flag:
        left, right = getattr(self.vehicle, "stalled", (False, False))
        flags = self._state
        flags |= Flag.STALL_LEFT * bool(left) | Flag.STALL_RIGHT * bool(right)
        return flags | Flag.LOW_SUPPLY * self.low_supply

    # ------------------------------------------------------------------ commands

    def _execute(self, frame: Frame, time: float) -> None:
        actions: dict[int, Callable[[bytes, float], Result]] = {
            FrameType.DRIVE: self._on_drive,
            FrameType.STOP: self._on_stop,
            FrameType.RELEASE: self._on_release,
            FrameType.SET_TIME: self._on_set_time,
        }
        try:
            result = actions[frame.type](frame.payload, time)
        except MessageError:
            result = Result.MALFORMED
        clock = self._clock(time)
        if result is Result.DONE:
            self._applied, self._applied_clock = frame.sequence, clock
        self._send_frame(FrameType.ACK, Ack(frame.type, result, frame.sequence, clock).pack())
        if frame.type == FrameType.SET_TIME:
            self._send_hello(time)

    def _on_drive(self, payload: bytes, time: float) -> Result:
        command = DriveCommand.parse(payload)
        if self._state & Flag.STOPPED:
            return Result.STOPPED
        self._state, self._drive_until = Flag(0), time + DEAD_MAN
        self._command_speeds(1e-3 * command.left, 1e-3 * command.right)
        return Result.DONE

    def _on_stop(self, payload: bytes, time: float) -> Result:
        # A stop with a payload is malformed, but stopping is always safe.
        self._state = Flag.STOPPED
        self._command_speeds(0.0, 0.0)
        parse_empty("STOP", payload)
        return Result.DONE

    def _on_release(self, payload: bytes, time: float) -> Result:
        parse_empty("RELEASE", payload)
        if self._state & Flag.STOPPED:
            self._state = Flag.DEAD_MAN
        return Result.DONE

    def _on_set_time(self, payload: bytes, time: float) -> Result:
        self._host_offset = SetTime.parse(payload).host - self._clock(time)
        return Result.DONE

    def _check_drive_timeout(self, time: float) -> None:
        if not self._state and time >= self._drive_until:
            self._state = Flag.DEAD_MAN
            self._command_speeds(0.0, 0.0)

    def _command_speeds(self, left: float, right: float) -> None:
        """Command speeds of the driven wheels; zero stops at once and resets the controller."""
        self.commanded = left, right
        if self._control is None or left == right == 0.0:
            self.vehicle.drive(left, right)
        if self._control is not None:
            if left == right == 0.0:
                self._control.reset()
            self._control.commanded = np.array(self.commanded)

    def _control_wheels(self, time: float) -> None:
        """Run the speed controller once a period."""
        if self._control is None or time < self._control_at:
            return
        self._control_at = max(self._control_at + self._control.settings.period, time)
        left, right = self._accumulators
        speeds = self._control.step((left.count, right.count))
        if any(self.commanded):
            self.vehicle.drive(*speeds.tolist())

    def _send_frame(self, kind: FrameType, payload: bytes) -> None:
        self._out += self._encoder.encode(kind, payload)[1]


def _steps(values: Array, scale: float) -> tuple[int, int, int]:
    """Return values in steps of a converter, clipped to 16 bits."""
    x, y, z = np.clip(np.rint(values / scale), -32768, 32767).astype(int).tolist()
    return x, y, z


def _signed(count: int) -> int:
    """Return the lower 32 bits, signed."""
    return (count + (1 << 31)) % (1 << 32) - (1 << 31)


def _climate(time: float) -> tuple[int, int]:
    """Return temperature (0.01 degC) and humidity (0.01 %) of a room, with a period of an hour."""
    wave = math.sin(2.0 * math.pi * time / 3600.0)
    return round(2300 + 150 * wave), round(4500 - 400 * wave)
