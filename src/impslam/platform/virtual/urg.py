"""A Hokuyo URG-04LX without the sensor: the same bytes, at the same times.

What the protocol's text leaves open is decided here: a status of 0B for what it refuses in time
adjust mode and for a second scan command; a verification of an error takes a second; a reboot half
a second; a scan is sent 2 ms after its last step, exponentially later by 0.3 ms in the mean.
"""

from __future__ import annotations

import math

import numpy as np

from impslam.platform.devices import scip, scip_status
from impslam.platform.devices.scip_encoding import encode, sealed
from impslam.platform.virtual import urg_answers
from impslam.platform.virtual.base import Surroundings
from impslam.platform.virtual.urg_memory import BIT_RATES, COMMANDS, Line, Memory, Order, faulty
from impslam.platform.virtual.urg_sensor import UrgSensor, clustered

BOOT = 0.5  # s
PROCESSING, JITTER = 2e-3, 0.3e-3  # s from the last step to the first byte: least, and mean beyond
VERIFYING = 1.0  # s that statuses 21 to 49 last
QUEUE = 512  # bytes of requests that it holds
SIMULATED = 50  # status of the malfunction that DB asks for


class UrgEmulator:
    """A URG-04LX as its port sees it.

    Parameters
    ----------
    surroundings : what the beams from step 44 to 725 read
    drift : 1, how much faster its clock (and its motor) runs than the virtual robot's time
    seed : of the jitter
    clock_start_ms : where its clock starts; near 2**24 it wraps soon
    scip1 : it wakes in SCIP 1.1, as some are delivered, and must be switched
    turn : s by its own clock that a turn takes; real ones need 98 to 100 ms
    serial : the line is RS-232 with this bit rate to begin with; 0: USB, as fast as need be
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
        self._memory, self._line = Memory(not scip1, serial or BIT_RATES[0]), Line()
        self._heard = b""
        self._lasting = False
        self._time = 0.0
        self._sweep = 0  # the next to end

    @property
    def laser(self) -> bool:
        """Whether the laser is on."""
        return self._sensor.laser_on < math.inf

    @property
    def bit_rate(self) -> int:
        """Bit rate that it has been set to."""
        return self._memory.bit_rate

    def receive(self, data: bytes, time: float) -> None:
        """Take what the host sent; any bytes, cut anywhere."""
        self._run(time)
        if time < self._memory.ready:
            return
        *lines, rest = (self._heard + data).replace(b"\r", b"\n").split(b"\n")
        self._heard = rest[-QUEUE:]
        for line in filter(None, lines):
            self._obey(line)

    def due(self, time: float) -> bytes:
        """Return what it sends between the last call and `time`."""
        self._run(time)
        return self._line.due(time)

    def reboot(self, time: float) -> None:
        """Forget everything, as when the supply fails for a moment; its clock begins anew."""
        self._run(time)
        self._reset()
        self._memory.scip2, self._memory.ready = not self._scip1, time + BOOT
        self._line, self._heard = Line(), b""

    def fail(self, status: int, *, lasting: bool = False) -> None:
        """Have a malfunction: 50 to 97, mended by RS unless `lasting`; 21 to 49 mends itself."""
        memory = self._memory
        memory.failure, self._lasting = f"{status:02d}", lasting
        verifying = scip_status.is_verifying(memory.failure)
        memory.verified = self._time + VERIFYING if verifying else math.inf
        if memory.order is not None:
            self._answer(memory.order.echo(), memory.failure)
            if not verifying:
                self._laser_off()

    def mend(self) -> None:
        """End a malfunction."""
        self._memory.failure, self._lasting = "", False

    # ----------------------------------------------------------------- time passes

    def _run(self, time: float) -> None:
        """Live until `time`: end the sweeps that have ended, and send what was asked of them."""
        self._time = max(self._time, time)
        if self._memory.order is None:  # nobody waits for them
            self._sweep = self._sensor.next_to_end(self._time)
        while self._sensor.end(self._sweep) <= self._time:
            self._verify(self._sensor.end(self._sweep))
            self._finish(self._sweep)
            self._sweep += 1
        self._verify(self._time)

    def _verify(self, time: float) -> None:
        """Go on after an error has been looked at."""
        memory = self._memory
        if time >= memory.verified:
            memory.failure, memory.verified = "", math.inf
            if memory.order is not None:
                self._answer(memory.order.echo(), scip_status.RESUMED)

    def _finish(self, sweep: int) -> None:
        """Send a sweep that has ended, if it was asked for."""
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
        said = order.parameters
        first, last, cluster = int(said[0:4]), int(said[4:8]), int(said[8:10])
        width = scip.WIDTH[order.command]
        values = clustered(self._sensor.values(sweep)[first : last + 1], cluster)
        data = encode(np.minimum(values, (1 << 6 * width) - 1), width)
        body = self._stamp(self._sensor.begin(sweep)) + scip.in_lines(data)
        status = scip_status.DATA if order.streams else scip_status.OK
        self._answer(order.echo(), status, body, ready)

    def _stamp(self, time: float) -> bytes:
        return sealed(encode(np.array([self._sensor.clock(time)]), 4))

    def _laser_off(self) -> None:
        self._sensor.laser_on, self._memory.order = math.inf, None

    def _reset(self) -> None:
        failure = self._memory.failure if self._lasting else ""
        self._memory = Memory(True, self._serial or BIT_RATES[0], failure=failure)
        self._sensor.reset(self._time)
        self._sweep = 0

    # ----------------------------------------------------------------- requests

    def _answer(
        self, echo: str, status: str, body: bytes = b"", ready: float | None = None
    ) -> None:
        data = b"%b\n%b%b\n" % (echo.encode("latin-1"), sealed(status.encode("ascii")), body)
        self._send(data, ready)

    def _send(self, data: bytes, ready: float | None = None) -> None:
        rate = self._memory.bit_rate if self._serial else 0
        self._line.send(data, self._time if ready is None else ready, rate)

    def _obey(self, line: bytes) -> None:
        memory = self._memory
        if not memory.scip2:
            memory.scip2 = line == b"SCIP2.0"
            self._send(line + (b"\n0\n\n" if memory.scip2 else b"\nE\n\n"))
            return
        echo = line.decode("latin-1")
        said, _, text = echo.partition(";")
        command, parameters = said[:2], said[2:]
        if status := self._refused(command, parameters, text):
            self._answer(echo, status)
        elif command in scip.WIDTH:
            self._measure(echo, command, parameters, f";{text}" if text else "")
        else:
            status, body = getattr(self, f"_do_{command.lower()}")(parameters)
            self._answer(echo, status, body)

    def _refused(self, command: str, parameters: str, text: str) -> str:
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
        status = faulty(parameters) or self._memory.failure
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
        if int(rate) not in BIT_RATES:
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
        if code == "02":  # of the simulations, the malfunction at once is all there is here
            if not failing:
                self.fail(SIMULATED)
            return ("02" if failing else scip_status.OK), b""
        if code == "10":
            self.mend()
            return (scip_status.OK if failing else "03"), b""
        return "01", b""

    def _do_vv(self, _: str) -> tuple[str, bytes]:
        return scip_status.OK, urg_answers.version()

    def _do_pp(self, _: str) -> tuple[str, bytes]:
        return scip_status.OK, urg_answers.parameters(self._sensor.parameters)

    def _do_ii(self, _: str) -> tuple[str, bytes]:
        memory = self._memory
        said = urg_answers.state(self._sensor, self._time, memory.bit_rate, memory.failure)
        return scip_status.OK, said
