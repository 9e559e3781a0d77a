"""Hokuyo URG-04LX and other range finders that speak SCIP 2.0, over USB, RS-232 or TCP."""

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
from impslam.platform.devices.scip_info import Parameters
from impslam.platform.devices.scip_link import Heard, ScipLink, UnansweredError
from impslam.platform.devices.urg_beams import Beams
from impslam.platform.devices.urg_clock import SweepTimes
from impslam.platform.devices.urg_start import (
    BM,
    QT,
    RS,
    InterruptedScanError,
    MalfunctionError,
    obey,
    read_parameters,
    read_state,
    read_version,
    set_bit_rate,
    synchronise,
    wake,
)
from impslam.types import DeviceTime

ATTEMPTS = 3  # to measure over an open port, before it is closed and opened anew
STARTING = 2.0  # s from the request to the first scan: the laser and the motor settle
VERIFYING = 5.0  # s that the sensor gets to verify an error; the protocol names no limit
PACE = 0.05  # 1: share of a deviation that the period takes over; averages some 20 turns
IMPLAUSIBLE = 3  # scans in a row whose stamps do not fit: its clock has jumped


@register("urg")
class Urg(Device):
    """Hokuyo URG-04LX, or another 2D lidar that speaks SCIP 2.0."""

    port: str = parameter(
        "/dev/ttyACM0", "", "where it is: a serial port, or socket://HOST:PORT for TCP"
    )
    baud: int = parameter(115200, "bit/s", "rate that an RS-232 line is set to; USB has none", gt=0)
    mode: Mode = parameter(
        "MD", "", "MD: all scans are sent; MS: in two characters, to 4.094 m; GD, GS: asked for"
    )
    first_step: int = parameter(-1, "1", "first step; -1: the first that measures", ge=-1)
    last_step: int = parameter(-1, "1", "last step; -1: the last that measures", ge=-1)
    cluster: int = parameter(1, "1", "neighbouring steps merged into one beam", ge=1, le=99)
    skip: int = parameter(0, "1", "scans left out between two", ge=0, le=9)

    _clock: DeviceClock = PrivateAttr(default_factory=DeviceClock)
    _times: SweepTimes = PrivateAttr()
    _beams: Beams = PrivateAttr()
    _period: float = PrivateAttr(default=0.0)  # s from a scan to the next, as the sensor says
    _pace: float = PrivateAttr(default=0.0)  # s, as measured
    _last: float = PrivateAttr(default=-math.inf)  # host time of the last scan's step 0
    _scans: int = PrivateAttr(default=0)
    _misfits: int = PrivateAttr(default=0)

    def _serve(self) -> None:
        try:
            with opened(self.port, self.baud) as port:
                self._converse(ScipLink(port, self._stopping, self._count))
        except DeviceError:
            if not self._stopping.is_set():
                raise

    def _converse(self, link: ScipLink) -> None:
        """Measure until told to stop; begin again where the sensor gives up."""
        failed = 0
        try:
            while not self._stopping.is_set():
                scans = self._scans
                try:
                    self._measure(link)
                except InterruptedScanError as error:
                    failed = failed + 1 if self._scans == scans else 1
                    if failed >= ATTEMPTS:
                        raise
                    self._recover(link, error)
        finally:
            with contextlib.suppress(DeviceError):
                link.hush(QT)  # the laser need not wear when nobody listens

    def _recover(self, link: ScipLink, error: InterruptedScanError) -> None:
        self._count("interruptions")
        self._tell("warning", f"{error}; measuring begins again")
        if isinstance(error, MalfunctionError):
            self._count("malfunctions")
            with contextlib.suppress(UnansweredError):
                link.ask(RS, wait=1.0)

    def _measure(self, link: ScipLink) -> None:
        """Find out what the sensor is and take its scans."""
        rs232 = is_rs232(self.port)
        wake(link, rs232)
        if rs232:
            self._warn(set_bit_rate(link, self.baud))
        version, known = read_version(link), read_parameters(link)
        self._lay_out(known)
        if rs232:
            self._warn(self._too_slow(link.bit_rate))
        if state := read_state(link):
            self._warn(f"the sensor says of itself: {state}")
        # Where TM is missing: a scan cannot come before its last step has been measured.
        self._times = SweepTimes(self._clock, self._period, known.last * known.step_time)
        self._warn(synchronise(link, self._times, self._stopping))
        self._misfits = 0
        title = (
            f"{version.product or known.model} {version.serial}, firmware {version.firmware}: "
            f"{len(self._beams.angles)} beams at {1.0 / self._period:.3g} Hz"
        )
        (self._stream if self.mode in scip.STREAMS else self._poll)(link, title)

    def _lay_out(self, known: Parameters) -> None:
        first = known.first if self.first_step < 0 else self.first_step
        last = known.last if self.last_step < 0 else self.last_step
        if not known.first <= first <= last <= known.last:
            raise DeviceError(
                f"{self.port}: steps {first} to {last} lie outside what this sensor measures; "
                f"choose first_step and last_step within {known.first} to {known.last}"
            )
        self._beams = Beams.of(known, self.mode, (first, last), self.cluster, self.skip)
        period = known.turn * (1 + self.skip)
        if period != self._period:
            self._period = self._pace = period

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
        """Let scans be sent until something ends it."""
        obey(link, link.ask(self._beams.request, wait=STARTING, tries=1))
        self._ready(title)
        patience = max(STARTING, self._quiet)
        while heard := link.hear(patience):
            patience = self._quiet
            if heard.response.echo != self._beams.echo:
                self._count("stale responses")
            elif heard.response.status == scip_status.DATA:
                self._take(heard)
            elif scip_status.is_verifying(heard.response.status):
                patience = VERIFYING
                self._warn(scip_status.words(self.mode, heard.response.status))
            elif heard.response.status == scip_status.RESUMED:
                self._tell("info", scip_status.words(self.mode, heard.response.status))
            else:
                obey(link, heard)
        if not self._stopping.is_set():
            raise InterruptedScanError(f"{self.port}: no scan for {patience:.1f} s")

    def _poll(self, link: ScipLink, title: str) -> None:
        """Ask for one scan after the other: a repeated one means that the next is not ready."""
        obey(link, link.ask(BM), "02")
        self._ready(title)
        stamp, fresh, pause = b"", now(), 0.0
        while not self._stopping.wait(pause):
            asked, pause = now(), 0.05 * self._period
            with contextlib.suppress(UnansweredError):
                heard = link.ask(self._beams.request, wait=0.3 + self._period, tries=1)
                obey(link, heard)
                if heard.response.body[:1] != (stamp,):
                    stamp, fresh = b"".join(heard.response.body[:1]), now()
                    self._take(heard)
                    pause = max(0.0, asked + self._period - fresh)
            if now() - fresh > self._quiet:
                raise InterruptedScanError(f"{self.port}: no new scan for {self._quiet:.1f} s")

    @property
    def _quiet(self) -> float:
        """Time without a scan after which measuring has ended, in s."""
        return max(self.patience, 5.0 * self._period)

    def _take(self, heard: Heard) -> None:
        """Deliver a scan, if it is whole and its stamp can be."""
        try:
            sweep = self._beams.read(heard.response)
        except DamagedError:
            self._count("damaged scans")
            return
        if not self._times.is_plausible(sweep.stamp, heard.arrived):
            self._count("implausible stamps")
            self._misfits += 1
            if self._misfits >= IMPLAUSIBLE:
                raise InterruptedScanError(f"{self.port}: the sensor's clock has jumped")
            return
        self._misfits = 0
        self._scans += 1
        device, host = self._times.place(sweep.stamp, heard.arrived)
        self._note_missed(host)
        scan = self._beams.to_scan(sweep, host)
        self._deliver(scan, heard.arrived, device + self._beams.delay)
        self._deliver(DeviceTime(host, self.title, device), heard.arrived, device)

    def _note_missed(self, host: float) -> None:
        """Count what should have come since the last scan, on the host's time base.

        That goes on also while the sensor is reset or unplugged.
        """
        since = host - self._last
        number = round(since / self._pace) if math.isfinite(since) else 1
        if number > 1:
            self._count("missed scans", number - 1)
        elif number == 1 and math.isfinite(since):
            # Motors that should turn in 100 ms do it in 98, which adds up over a long gap.
            self._pace += PACE * (since - self._pace)
        self._last = host

    def _warn(self, text: str) -> None:
        if text:
            self._tell("warning", text)


def is_rs232(url: str) -> bool:
    """Tell whether a port is a line whose bit rate matters: no TCP, pseudo-terminal, or USB's own."""
    name = url if "://" in url or url.startswith("COM") else str(Path(url).resolve())
    return name.startswith(("COM", "/dev/tty")) and not name.startswith("/dev/ttyACM")
