"""How a SCIP sensor is brought from any state to where it can measure, and what it is asked."""

from __future__ import annotations

import contextlib
import threading
from typing import Final

from impslam.platform.devices import scip, scip_status
from impslam.platform.devices.base import DeviceError
from impslam.platform.devices.scip_encoding import DamagedError
from impslam.platform.devices.scip_info import Parameters, Version, fields
from impslam.platform.devices.scip_link import Heard, ScipLink, UnansweredError
from impslam.platform.devices.urg_clock import SweepTimes

BIT_RATES: Final = (19200, 38400, 57600, 115200, 250000, 500000, 750000)  # of RS-232
ROUNDS = 10  # of TM1
TRIES = 3  # to get what the sensor says of itself undamaged

QT, RS, BM = scip.request("QT"), scip.request("RS"), scip.request("BM")


class InterruptedScanError(DeviceError):
    """Measuring has ended by itself; it may be begun again over the same port."""


class MalfunctionError(InterruptedScanError):
    """The sensor's hardware says that it fails; RS may mend it."""


def obey(link: ScipLink, heard: Heard, *fine: str) -> None:
    """Raise if an answer refuses what was asked; statuses in `fine` do not.

    Raises
    ------
    MalfunctionError
        If the hardware fails.
    InterruptedScanError
        If there is any other reason.
    """
    command, status = heard.response.echo[:2], heard.response.status
    reason = f"{link.where}: {command}: {scip_status.words(command, status)}"
    if scip_status.is_malfunction(command, status):
        raise MalfunctionError(reason)
    if status not in (scip_status.OK, scip_status.DATA, *fine):
        raise InterruptedScanError(reason)


def wake(link: ScipLink, rs232: bool) -> None:
    """Bring a sensor to where it speaks SCIP 2.0 and is silent, from any state and bit rate.

    Raises
    ------
    UnansweredError
        If nothing answers.
    InterruptedScanError
        If it waits for new firmware.
    """
    rates = [link.bit_rate]
    if rs232:
        rates += [rate for rate in BIT_RATES if rate != rates[0]]
    for rate in rates:
        link.bit_rate = rate
        if _is_quiet(link):
            return
    raise UnansweredError(
        f"{link.where}: nothing there speaks SCIP; check that it is a Hokuyo with SCIP 2.0, that it "
        "has power, and the port"
    )


def _is_quiet(link: ScipLink) -> bool:
    """Stop what runs, and end SCIP 1.1 and the adjust mode, whichever it may be in."""
    for request in ("QT", "SCIP2.0", "TM2", "QT"):
        link.forget()
        try:
            status = link.ask(scip.request(request), tries=1).response.status
        except UnansweredError:
            continue
        if status == scip_status.UPDATE_MODE:
            link.send(RS)
            raise InterruptedScanError(f"{link.where}: {scip_status.words(request, status)}")
        if request == "QT" and status == scip_status.OK:
            return True
    return False


def set_bit_rate(link: ScipLink, rate: int) -> str:
    """Set an RS-232 line's bit rate, which RS and a loss of power undo; return why not, or ""."""
    if link.bit_rate == rate:
        return ""
    status = link.ask(scip.request("SS", f"{rate:06d}"), tries=1).response.status
    if status not in (scip_status.OK, "03"):
        return f"stays at {link.bit_rate} bit/s: {scip_status.words('SS', status)}"
    link.bit_rate = rate
    link.ask(QT)
    return ""


def read_version(link: ScipLink) -> Version:
    """Return what the sensor is; empty if it cannot be read, for it measures without a name."""
    for _ in range(TRIES):
        with contextlib.suppress(DamagedError):
            return Version.of(link.ask(scip.request("VV")).response.body)
    return Version("", "", "")


def read_state(link: ScipLink) -> str:
    """Return how the sensor says that it is doing; empty if it cannot be read, or if well."""
    with contextlib.suppress(DamagedError, UnansweredError):
        state = fields(link.ask(scip.request("II")).response.body).get("STAT", "")
        if not any(word in state.lower() for word in ("well", "stable", "normal")):
            return state
    return ""


def read_parameters(link: ScipLink) -> Parameters:
    """Return the parameters that two answers agree on: six bits of checksum alone are too few.

    Raises
    ------
    InterruptedScanError
        If no two do.
    DeviceError
        If they cannot be.
    """
    before: Parameters | None = None
    for _ in range(2 * TRIES):
        try:
            said = Parameters.of(link.ask(scip.request("PP")).response.body)
        except DamagedError:
            link.count("damaged responses", 1)
            continue
        if said == before:
            return said
        before = said
    raise InterruptedScanError(
        f"{link.where}: no two answers to PP are the same; check the cable for noise"
    )


def synchronise(link: ScipLink, times: SweepTimes, stopping: threading.Event) -> str:
    """Ask for the sensor's clock (TM); return why it cannot be had, or ""."""
    status = link.ask(scip.request("TM", "0")).response.status
    if status not in (scip_status.OK, "02"):
        return f"its clock cannot be asked for: {scip_status.words('TM', status)}"
    for number in range(ROUNDS):
        stopping.wait(1.7e-3 * (number % 3))  # meets its ms at other phases
        with contextlib.suppress(DamagedError, UnansweredError):
            heard = link.ask(scip.request("TM", "1", f"{number}"), tries=1)
            if heard.response.status == scip_status.OK and heard.response.body:
                raw = scip.stamp_of(heard.response.body[0])
                times.synchronise(raw, heard.sent, heard.arrived)
    link.ask(scip.request("TM", "2"))
    return ""
