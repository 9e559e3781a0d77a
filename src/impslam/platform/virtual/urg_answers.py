"""Answers of a URG-04LX: version (VV), parameters (PP) and state (II)."""

from __future__ import annotations

import math

from impslam.platform.devices.scip_info import MeasurementParameters, to_line
from impslam.platform.virtual.urg_sensor import UrgSensor


def version() -> bytes:
    """Return the answer to VV."""
    return _to_lines(
        VEND="Hokuyo Automatic Co.,Ltd.",
        PROD="SOKUIKI Sensor URG-04LX",
        FIRM="3.3.00,06/Mar./2008",
        PROT="SCIP 2.0",
        SERI="H0000000",
    )


def parameters(p: MeasurementParameters) -> bytes:
    """Return the answer to PP."""
    return _to_lines(
        MODL=p.model,
        DMIN=str(p.shortest),
        DMAX=str(p.longest),
        ARES=str(p.steps),
        AMIN=str(p.first),
        AMAX=str(p.last),
        AFRT=str(p.front),
        SCAN=str(p.speed),
    )


def state(sensor: UrgSensor, time: float, bit_rate: int, failure: str) -> bytes:
    """Return the answer to II."""
    laser = sensor.laser_on < math.inf
    return _to_lines(
        MODL=sensor.parameters.model,
        LASR="ON" if laser else "OFF",
        SCSP=f"Initial({sensor.parameters.speed}[rpm])<-Default setting by user",
        MESM="Measuring" if laser else "IDLE",
        SBPS=f"{bit_rate}[bps]<-Default setting by user",
        TIME=f"{sensor.clock(time):06X}",
        STAT=f"Malfunction {failure}" if failure else "Sensor works well.",
    )


def _to_lines(**fields: str) -> bytes:
    return b"".join(to_line(key, value) for key, value in fields.items())
