"""Driver of the Hokuyo URG-04LX and other SCIP 2.0 range finders, over USB, RS-232 or TCP."""

from __future__ import annotations

import contextlib
import math
from pathlib import Path

from pydantic import PrivateAttr

from impslam.component import parameter, register
from impslam.platform.devices import scip, scip_status
from impslam.platform.devices.base import Device, DeviceError, now
from impslam.platform.devices.clock import DeviceClock
from impslam.platform.devices.port import opened
from impslam.platform.devices.scip import Mode
from impslam.platform.devices.scip_encoding import DamagedError
from impslam.platform.devices.scip_info import MeasurementParameters
from impslam.platform.devices.scip_link import ReceivedResponse, ScipLink, UnansweredError
from impslam.platform.devices.urg_beams import UrgBeams
from impslam.platform.devices.urg_clock import SweepTimes
from impslam.platform.devices.urg_start import (
    BM,
    QT,
    RS,
    InterruptedScanError,
    MalfunctionError,
    check_status,
    read_parameters,
    read_state,
    read_version,
    set_bit_rate,
    synchronise,
    wake,
)
from impslam.types import DeviceTime

MAX_ATTEMPTS = 3  # to measure over an open port, before it is reopened
START_TIMEOUT = 2.0  # s from the request to the first scan: the laser and the motor settle
VERIFY_TIMEOUT = 5.0  # s for the sensor to verify an error; the protocol has no limit
PERIOD_GAIN = 0.05  # 1, of the low-pass filter of the measured period; averages some 20 turns
MAX_IMPLAUSIBLE = 3  # consecutive scans with implausible stamps: its clock has jumped


@register("urg")
class Urg(Device):
    """Hokuyo URG-04LX, or another 2D lidar that speaks SCIP 2.0."""

    port: str = parameter("/dev/ttyACM0", "", "serial port, or socket://HOST:PORT for TCP")
    baud: int = parameter(115200, "bit/s", "rate that an RS-232 line is set to; USB has none", gt=0)
    mode: Mode = parameter(
        "MD",
        "",
        "MD: continuous; MS: continuous, two characters per range, up to 4.094 m; GD, GS: on request",
    )
    first_step: int = parameter(-1, "1", "first step; -1: the first one of the sensor", ge=-1)
    last_step: int = parameter(-1, "1", "last step; -1: the last one of the sensor", ge=-1)
    cluster: int = parameter(1, "1", "neighbouring steps merged into one beam", ge=1, le=99)
    skip: int = parameter(0, "1", "scans left out between two", ge=0, le=9)

    _clock: DeviceClock = PrivateAttr(default_factory=DeviceClock)
    _times: SweepTimes = PrivateAttr()
    _beams: UrgBeams = PrivateAttr()
    _period: float = PrivateAttr(default=0.0)  # s from a scan to the next, nominal
    _measured_period: float = PrivateAttr(default=0.0)  # s, as measured
    _last: float = PrivateAttr(default=-math.inf)  # host time of the last scan's step 0
    _scans: int = PrivateAttr(default=0)
    _implausible: int = PrivateAttr(default=0)

    def _serve(self) -> None:
        try:
            with opened(self.port, self.baud) as port:
                self._run_link(ScipLink(port, self._stopping, self._count))
        except DeviceError:
            if not self._stopping.is_set():
                raise

    def _run_link(self, link: ScipLink) -> None:
        """Measure until stopped; restart if the sensor ends a measurement."""
        failed = 0
        try:
            while not self._stopping.is_set():
                scans = self._scans
                try:
                    self._measure(link)
                except InterruptedScanError as error:
                    failed = failed + 1 if self._scans == scans else 1
                    if failed >= MAX_ATTEMPTS:
                        raise
                    self._recover(link, error)
        finally:
            with contextlib.suppress(DeviceError):
                link.send_last(QT)  # spares the laser

    def _recover(self, link: ScipLink, error: InterruptedScanError) -> None:
        self._count("interruptions")
        self._notify("warning", f"{error}; measuring begins again")
        if isinstance(error, MalfunctionError):
            self._count("malfunctions")
            with contextlib.suppress(UnansweredError):
                link.query(RS, wait=1.0)

    def _measure(self, link: ScipLink) -> None:
        """Start the sensor, read its parameters, and deliver its scans."""
        rs232 = is_rs232(self.port)
        wake(link, rs232)
        if rs232:
            self._warn(set_bit_rate(link, self.baud))
        version, parameters = read_version(link), read_parameters(link)
        self._configure(parameters)
        if rs232:
            self._warn(self._too_slow(link.bit_rate))
        if state := read_state(link):
            self._warn(f"the sensor reports: {state}")
        # Initial delay in case TM is missing: a scan is not sent before its last step.
        self._times = SweepTimes(self._clock, self._period, parameters.last * parameters.step_time)
        self._warn(synchronise(link, self._times, self._stopping))
        self._implausible = 0
        title = (
            f"{version.product or parameters.model} {version.serial}, firmware {version.firmware}: "
            f"{len(self._beams.angles)} beams at {1.0 / self._period:.3g} Hz"
        )
        (self._stream if self.mode in scip.STREAMS else self._poll)(link, title)

    def _configure(self, parameters: MeasurementParameters) -> None:
        first = parameters.first if self.first_step < 0 else self.first_step
        last = parameters.last if self.last_step < 0 else self.last_step
        if not parameters.first <= first <= last <= parameters.last:
            raise DeviceError(
                f"{self.port}: steps {first} to {last} lie outside what this sensor measures; "
                f"choose first_step and last_step within {parameters.first} to {parameters.last}"
            )
        self._beams = UrgBeams.of(parameters, self.mode, (first, last), self.cluster, self.skip)
        period = parameters.turn * (1 + self.skip)
        if period != self._period:
            self._period = self._measured_period = period

    def _too_slow(self, bit_rate: int) -> str:
        """Return a warning if an RS-232 line is slower than the scans."""
        takes = 10.0 * self._beams.characters / bit_rate
        if takes < self._period:
            return ""
        return (
            f"a scan takes {1e3 * takes:.0f} ms at {bit_rate} bit/s, but they come every "
            f"{1e3 * self._period:.0f} ms: some will be lost; raise baud, skip or cluster, set mode "
            "to MS, or use USB"
        )

    def _stream(self, link: ScipLink, title: str) -> None:
        """Receive streamed scans until they end."""
        check_status(link, link.query(self._beams.request, wait=START_TIMEOUT, tries=1))
        self._ready(title)
        timeout = max(START_TIMEOUT, self._scan_timeout)
        while received := link.receive(timeout):
            timeout = self._scan_timeout
            if received.response.echo != self._beams.echo:
                self._count("stale responses")
            elif received.response.status == scip_status.DATA:
                self._process_scan(received)
            elif scip_status.is_verifying(received.response.status):
                timeout = VERIFY_TIMEOUT
                self._warn(scip_status.words(self.mode, received.response.status))
            elif received.response.status == scip_status.RESUMED:
                self._notify("info", scip_status.words(self.mode, received.response.status))
            else:
                check_status(link, received)
        if not self._stopping.is_set():
            raise InterruptedScanError(f"{self.port}: no scan for {timeout:.1f} s")

    def _poll(self, link: ScipLink, title: str) -> None:
        """Request scans one by one; a repeated one means that the next is not ready."""
        check_status(link, link.query(BM), "02")
        self._ready(title)
        stamp, last_new, pause = b"", now(), 0.0
        while not self._stopping.wait(pause):
            requested_at, pause = now(), 0.05 * self._period
            with contextlib.suppress(UnansweredError):
                received = link.query(self._beams.request, wait=0.3 + self._period, tries=1)
                check_status(link, received)
                if received.response.body[:1] != (stamp,):
                    stamp, last_new = b"".join(received.response.body[:1]), now()
                    self._process_scan(received)
                    pause = max(0.0, requested_at + self._period - last_new)
            if now() - last_new > self._scan_timeout:
                raise InterruptedScanError(
                    f"{self.port}: no new scan for {self._scan_timeout:.1f} s"
                )

    @property
    def _scan_timeout(self) -> float:
        """Time without a scan after which measuring has failed, s."""
        return max(self.timeout, 5.0 * self._period)

    def _process_scan(self, received: ReceivedResponse) -> None:
        """Deliver a scan, unless it is damaged or its stamp is implausible."""
        try:
            sweep = self._beams.read(received.response)
        except DamagedError:
            self._count("damaged scans")
            return
        if not self._times.is_plausible(sweep.stamp, received.arrived):
            self._count("implausible stamps")
            self._implausible += 1
            if self._implausible >= MAX_IMPLAUSIBLE:
                raise InterruptedScanError(f"{self.port}: the sensor's clock has jumped")
            return
        self._implausible = 0
        self._scans += 1
        device, host = self._times.place(sweep.stamp, received.arrived)
        self._count_missed(host)
        scan = self._beams.to_scan(sweep, host)
        self._deliver(scan, received.arrived, device + self._beams.delay)
        self._deliver(DeviceTime(host, self.title, device), received.arrived, device)

    def _count_missed(self, host: float) -> None:
        """Count the scans missed since the last one, on the host's time base.

        This includes the time in which the sensor is reset or unplugged.
        """
        since = host - self._last
        number = round(since / self._measured_period) if math.isfinite(since) else 1
        if number > 1:
            self._count("missed scans", number - 1)
        elif number == 1 and math.isfinite(since):
            # A motor with a nominal period of 100 ms may take 98, which adds up over a long gap.
            self._measured_period += PERIOD_GAIN * (since - self._measured_period)
        self._last = host

    def _warn(self, text: str) -> None:
        if text:
            self._notify("warning", text)


def is_rs232(url: str) -> bool:
    """Return whether the bit rate of a port matters: not TCP, a pseudo-terminal, or native USB."""
    name = url if "://" in url or url.startswith("COM") else str(Path(url).resolve())
    return name.startswith(("COM", "/dev/tty")) and not name.startswith("/dev/ttyACM")
