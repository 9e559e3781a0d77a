"""An emulator of the Hokuyo URG-04LX: the same bytes at the same times.

Assumptions where the protocol is not specific: refusals in time adjust mode and of a second scan
command have status 0B; the verification of an error takes a second; a reboot half a second; a scan is
sent 2 ms after its last step, plus an exponential delay of 0.3 ms in the mean.
"""

from __future__ import annotations

import math

import numpy as np

from impslam.platform.devices import scip, scip_status
from impslam.platform.devices.scip_encoding import encode, with_checksum
from impslam.platform.virtual import urg_answers
from impslam.platform.virtual.base import Surroundings
from impslam.platform.virtual.urg_memory import (
    COMMANDS,
    Memory,
    Order,
    OutputLine,
    parameter_error,
)
from impslam.platform.virtual.urg_sensor import UrgSensor, clustered

BOOT_TIME = 0.5  # s
PROCESSING, JITTER = 2e-3, 0.3e-3  # s from the last step to the first byte: minimum, mean excess
VERIFY_TIME = 1.0  # s that statuses 21 to 49 last
MAX_INPUT = 512  # bytes of buffered requests
SIMULATED_STATUS = 50  # status of the malfunction simulated by DB


class UrgEmulator:
    """A URG-04LX as seen from its port.

    Parameters
    ----------
    surroundings : ranges of the beams from step 44 to 725
    drift : 1, relative excess rate of its clock (and motor) over the virtual robot's time
    seed : of the jitter
    clock_start_ms : initial value of its clock; near 2**24 it wraps soon
    scip1 : whether it starts in SCIP 1.1, as some are delivered, and must be switched
    turn : time of a turn by its clock, s; real ones need 98 to 100 ms
    serial : initial bit rate of an RS-232 line; 0: USB, without delay
    """

    def __init__(
        self,
        surroundings: Surroundings,
        *,
        drift: float = 0.0,
        seed: int = 0,
        clock_start_ms: int = 0,
        scip1: bool = False,
        turn: float = 0.1,
        serial: int = 0,
    ) -> None:
        self._sensor = UrgSensor(surroundings, drift, clock_start_ms, turn)
        self._rng = np.random.default_rng(seed)
        self._scip1, self._serial = scip1, serial
        self._memory, self._line = Memory(not scip1, serial or scip.BIT_RATES[0]), OutputLine()
        self._input = b""
        self._lasting = False
        self._time = 0.0
        self._sweep = 0  # the next to end

    @property
    def laser(self) -> bool:
        """Whether the laser is on."""
        return self._sensor.laser_on < math.inf

    @property
    def bit_rate(self) -> int:
        """Its bit rate."""
        return self._memory.bit_rate

    def receive(self, data: bytes, time: float) -> None:
        """Process bytes from the host, in pieces of any size."""
        self._run(time)
        if time < self._memory.ready:
            return
        *lines, rest = (self._input + data).replace(b"\r", b"\n").split(b"\n")
        self._input = rest[-MAX_INPUT:]
        for line in filter(None, lines):
            self._handle_line(line)

    def due(self, time: float) -> bytes:
        """Return the bytes sent between the last call and `time`."""
        self._run(time)
        return self._line.due(time)

    def reboot(self, time: float) -> None:
        """Reset everything, with the clock, as after a short power failure."""
        self._run(time)
        self._reset()
        self._memory.scip2, self._memory.ready = not self._scip1, time + BOOT_TIME
        self._line, self._input = OutputLine(), b""

    def fail(self, status: int, *, lasting: bool = False) -> None:
        """Simulate a malfunction: 50 to 97 are cleared by RS unless `lasting`, 21 to 49 by themselves."""
        memory = self._memory
        memory.failure, self._lasting = f"{status:02d}", lasting
        verifying = scip_status.is_verifying(memory.failure)
        memory.verified = self._time + VERIFY_TIME if verifying else math.inf
        if memory.order is not None:
            self._answer(memory.order.echo(), memory.failure)
            if not verifying:
                self._laser_off()

    def repair(self) -> None:
        """End a malfunction."""
        self._memory.failure, self._lasting = "", False

    # ----------------------------------------------------------------- time

    def _run(self, time: float) -> None:
        """Advance to `time`: finish the sweeps that have ended, and send requested ones."""
        self._time = max(self._time, time)
        if self._memory.order is None:  # no sweep is requested
            self._sweep = self._sensor.next_to_end(self._time)
        while self._sensor.end(self._sweep) <= self._time:
            self._verify(self._sensor.end(self._sweep))
            self._finish(self._sweep)
            self._sweep += 1
        self._verify(self._time)

    def _verify(self, time: float) -> None:
        """Resume after the verification of an error."""
        memory = self._memory
        if time >= memory.verified:
            memory.failure, memory.verified = "", math.inf
            if memory.order is not None:
                self._answer(memory.order.echo(), scip_status.RESUMED)

    def _finish(self, sweep: int) -> None:
        """Send a sweep that has ended, if it was requested."""
        order = self._memory.order
        if order is None or self._memory.failure or not self._sensor.measured(sweep):
            return
        if order.wait > 0:
            order.wait -= 1
            return
        ready = self._sensor.end(sweep) + PROCESSING + float(self._rng.exponential(JITTER))
        if self._line.free > ready:
            return  # the line is still busy with an earlier one
        if order.streams:
            order.wait, order.remaining = int(order.parameters[10]), max(0, order.remaining - 1)
        self._send_sweep(order, sweep, ready)
        if not order.streams:
            self._memory.order = None
        elif not order.endless and order.remaining == 0:
            self._laser_off()

    def _send_sweep(self, order: Order, sweep: int, ready: float) -> None:
        fields = order.parameters
        first, last, cluster = int(fields[0:4]), int(fields[4:8]), int(fields[8:10])
        width = scip.WIDTH[order.command]
        values = clustered(self._sensor.values(sweep)[first : last + 1], cluster)
        data = encode(np.minimum(values, (1 << 6 * width) - 1), width)
        body = self._stamp(self._sensor.begin(sweep)) + scip.in_lines(data)
        status = scip_status.DATA if order.streams else scip_status.OK
        self._answer(order.echo(), status, body, ready)

    def _stamp(self, time: float) -> bytes:
        return with_checksum(encode(np.array([self._sensor.clock(time)]), 4))

    def _laser_off(self) -> None:
        self._sensor.laser_on, self._memory.order = math.inf, None

    def _reset(self) -> None:
        failure = self._memory.failure if self._lasting else ""
        self._memory = Memory(True, self._serial or scip.BIT_RATES[0], failure=failure)
        self._sensor.reset(self._time)
        self._sweep = 0

    # ----------------------------------------------------------------- requests

    def _answer(
        self, echo: str, status: str, body: bytes = b"", ready: float | None = None
    ) -> None:
        data = b"%b\n%b%b\n" % (echo.encode("latin-1"), with_checksum(status.encode("ascii")), body)
        self._send(data, ready)

    def _send(self, data: bytes, ready: float | None = None) -> None:
        rate = self._memory.bit_rate if self._serial else 0
        self._line.send(data, self._time if ready is None else ready, rate)

    def _handle_line(self, line: bytes) -> None:
        memory = self._memory
        if not memory.scip2:
            memory.scip2 = line == b"SCIP2.0"
            self._send(line + (b"\n0\n\n" if memory.scip2 else b"\nE\n\n"))
            return
        echo = line.decode("latin-1")
        fields, _, text = echo.partition(";")
        command, parameters = fields[:2], fields[2:]
        if status := self._general_error(command, parameters, text):
            self._answer(echo, status)
        elif command in scip.WIDTH:
            self._measure(echo, command, parameters, f";{text}" if text else "")
        else:
            status, body = getattr(self, f"_do_{command.lower()}")(parameters)
            self._answer(echo, status, body)

    def _general_error(self, command: str, parameters: str, text: str) -> str:
        """Return the general error of a request; "" if it has none."""
        wanted = COMMANDS.get(command)
        if wanted is None or len(parameters) > wanted or not parameters.isascii():
            return "0E"
        if len(parameters) < wanted:
            return "0C"
        if len(text) > scip.TEXT_LIMIT:
            return "0G"
        if not all(" " <= letter <= "~" for letter in text):
            return "0H"
        return "0B" if self._memory.adjusting and command not in ("TM", "RS") else ""

    def _measure(self, echo: str, command: str, parameters: str, text: str) -> None:
        """Begin a scan command, or refuse it."""
        streams = command in scip.STREAMS
        status = parameter_error(parameters) or self._memory.failure
        if not status and not (streams or self.laser):
            status = "10"
        if not status and self._memory.order is not None:
            status = "0B"
        if status:
            self._answer(echo, status)
            return
        order = Order(command, parameters, text)
        if streams:
            order.remaining = int(parameters[11:])
            order.endless = order.remaining == 0
            self._sensor.laser_on = min(self._sensor.laser_on, self._time)
            self._answer(echo, scip_status.OK)
        elif self._sensor.measured(self._sweep - 1):
            self._send_sweep(order, self._sweep - 1, self._time)
            return
        self._memory.order = order

    def _do_bm(self, _: str) -> tuple[str, bytes]:
        if self._memory.failure:
            return "01", b""
        status = "02" if self.laser else scip_status.OK
        self._sensor.laser_on = min(self._sensor.laser_on, self._time)
        return status, b""

    def _do_qt(self, _: str) -> tuple[str, bytes]:
        self._laser_off()
        return scip_status.OK, b""

    def _do_rs(self, _: str) -> tuple[str, bytes]:
        self._reset()
        return scip_status.OK, b""

    def _do_tm(self, code: str) -> tuple[str, bytes]:
        memory = self._memory
        if code == "1":
            return (scip_status.OK, self._stamp(self._time)) if memory.adjusting else ("04", b"")
        if code not in ("0", "2"):
            return "01", b""
        if memory.adjusting == (code == "0"):
            return ("02" if memory.adjusting else "03"), b""
        memory.adjusting = code == "0"
        self._laser_off()
        return scip_status.OK, b""

    def _do_ss(self, rate: str) -> tuple[str, bytes]:
        if not rate.isdigit():
            return "01", b""
        if int(rate) not in scip.BIT_RATES:
            return "02", b""
        if int(rate) == self._memory.bit_rate:
            return "03", b""
        self._memory.bit_rate = int(rate)
        return scip_status.OK, b""

    def _do_cr(self, speed: str) -> tuple[str, bytes]:
        if not speed.isdigit():
            return "01", b""
        slowed = 0 if speed == "99" else int(speed)
        if slowed > 10:
            return "02", b""
        if slowed == self._sensor.slowed:
            return "03", b""
        self._sensor.slowed = slowed
        self._sweep = self._sensor.next_to_end(self._time)
        return scip_status.OK, b""

    def _do_hs(self, code: str) -> tuple[str, bytes]:
        if code not in ("0", "1"):
            return "01", b""
        if self._memory.sensitive == (code == "1"):
            return "02", b""
        self._memory.sensitive = code == "1"
        return scip_status.OK, b""

    def _do_db(self, code: str) -> tuple[str, bytes]:
        failing = bool(self._memory.failure)
        if code == "02":  # only the simulation of an immediate malfunction is supported
            if not failing:
                self.fail(SIMULATED_STATUS)
            return ("02" if failing else scip_status.OK), b""
        if code == "10":
            self.repair()
            return (scip_status.OK if failing else "03"), b""
        return "01", b""

    def _do_vv(self, _: str) -> tuple[str, bytes]:
        return scip_status.OK, urg_answers.version()

    def _do_pp(self, _: str) -> tuple[str, bytes]:
        return scip_status.OK, urg_answers.parameters(self._sensor.parameters)

    def _do_ii(self, _: str) -> tuple[str, bytes]:
        memory = self._memory
        fields = urg_answers.state(self._sensor, self._time, memory.bit_rate, memory.failure)
        return scip_status.OK, fields
