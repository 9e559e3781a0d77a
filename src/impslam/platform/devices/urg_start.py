"""Start a SCIP sensor from any state, and read its version, state, parameters and clock."""

from __future__ import annotations

import contextlib
import threading

from impslam.platform.devices import scip, scip_status
from impslam.platform.devices.base import DeviceError
from impslam.platform.devices.scip import BIT_RATES
from impslam.platform.devices.scip_encoding import DamagedError
from impslam.platform.devices.scip_info import MeasurementParameters, Version, fields
from impslam.platform.devices.scip_link import ReceivedResponse, ScipLink, UnansweredError
from impslam.platform.devices.urg_clock import SweepTimes

SYNC_ROUNDS = 10  # of TM1
READ_TRIES = 3  # to read an undamaged answer

QT, RS, BM = scip.request("QT"), scip.request("RS"), scip.request("BM")


class InterruptedScanError(DeviceError):
    """Measuring has ended by itself, and can be restarted over the same port."""


class MalfunctionError(InterruptedScanError):
    """The sensor reports a hardware failure; RS may clear it."""


def check_status(link: ScipLink, received: ReceivedResponse, *fine: str) -> None:
    """Raise if an answer refuses its request; statuses in `fine` do not.

    Raises
    ------
    MalfunctionError
        If the hardware fails.
    InterruptedScanError
        For any other reason.
    """
    command, status = received.response.echo[:2], received.response.status
    reason = f"{link.where}: {command}: {scip_status.words(command, status)}"
    if scip_status.is_malfunction(command, status):
        raise MalfunctionError(reason)
    if status not in (scip_status.OK, scip_status.DATA, *fine):
        raise InterruptedScanError(reason)


def wake(link: ScipLink, rs232: bool) -> None:
    """Bring a sensor from any state and bit rate to SCIP 2.0, idle.

    Raises
    ------
    UnansweredError
        If nothing answers.
    InterruptedScanError
        If it is in firmware update mode.
    """
    rates = [link.bit_rate]
    if rs232:
        rates += [rate for rate in BIT_RATES if rate != rates[0]]
    for rate in rates:
        link.bit_rate = rate
        if _silence(link):
            return
    raise UnansweredError(
        f"{link.where}: no SCIP device answers; check that it is a Hokuyo with SCIP 2.0, that it "
        "has power, and the port"
    )


def _silence(link: ScipLink) -> bool:
    """Stop measuring, and leave SCIP 1.1 and the adjust mode; return whether the sensor is idle."""
    for request in ("QT", "SCIP2.0", "TM2", "QT"):
        link.discard()
        try:
            status = link.query(scip.request(request), tries=1).response.status
        except UnansweredError:
            continue
        if status == scip_status.UPDATE_MODE:
            link.send(RS)
            raise InterruptedScanError(f"{link.where}: {scip_status.words(request, status)}")
        if request == "QT" and status == scip_status.OK:
            return True
    return False


def set_bit_rate(link: ScipLink, rate: int) -> str:
    """Set the bit rate of an RS-232 line, until RS or power loss; return why it failed, or ""."""
    if link.bit_rate == rate:
        return ""
    status = link.query(scip.request("SS", f"{rate:06d}"), tries=1).response.status
    if status not in (scip_status.OK, "03"):
        return f"stays at {link.bit_rate} bit/s: {scip_status.words('SS', status)}"
    link.bit_rate = rate
    link.query(QT)
    return ""


def read_version(link: ScipLink) -> Version:
    """Return the version of the sensor, with empty fields if it cannot be read."""
    for _ in range(READ_TRIES):
        with contextlib.suppress(DamagedError):
            return Version.of(link.query(scip.request("VV")).response.body)
    return Version("", "", "")


def read_state(link: ScipLink) -> str:
    """Return the state that the sensor reports, empty if it is well or cannot be read."""
    with contextlib.suppress(DamagedError, UnansweredError):
        state = fields(link.query(scip.request("II")).response.body).get("STAT", "")
        if not any(word in state.lower() for word in ("well", "stable", "normal")):
            return state
    return ""


def read_parameters(link: ScipLink) -> MeasurementParameters:
    """Return the parameters on which two consecutive answers agree, as six bits of checksum are few.

    Raises
    ------
    InterruptedScanError
        If no two answers agree.
    DeviceError
        If a parameter is impossible.
    """
    before: MeasurementParameters | None = None
    for _ in range(2 * READ_TRIES):
        try:
            parameters = MeasurementParameters.of(link.query(scip.request("PP")).response.body)
        except DamagedError:
            link.count("damaged responses", 1)
            continue
        if parameters == before:
            return parameters
        before = parameters
    raise InterruptedScanError(
        f"{link.where}: no two answers to PP are the same; check the cable for noise"
    )


def synchronise(link: ScipLink, times: SweepTimes, stopping: threading.Event) -> str:
    """Query the sensor's clock (TM); return why it cannot be read, or ""."""
    status = link.query(scip.request("TM", "0")).response.status
    if status not in (scip_status.OK, "02"):
        return f"its clock cannot be read: {scip_status.words('TM', status)}"
    for number in range(SYNC_ROUNDS):
        stopping.wait(1.7e-3 * (number % 3))  # samples other phases of its ms
        with contextlib.suppress(DamagedError, UnansweredError):
            received = link.query(scip.request("TM", "1", f"{number}"), tries=1)
            if received.response.status == scip_status.OK and received.response.body:
                raw = scip.stamp_of(received.response.body[0])
                times.synchronise(raw, received.sent, received.arrived)
    link.query(scip.request("TM", "2"))
    return ""
