"""A GNSS receiver that speaks NMEA 0183 on a serial port (thesis 3.3.1, GPS)."""

from __future__ import annotations

import math

from impslam.component import parameter, register
from impslam.platform.devices.base import Device, DeviceError, now
from impslam.platform.devices.clock import DeviceClock
from impslam.platform.devices.nmea import Epoch, Epochs, Sentences
from impslam.platform.devices.port import extra, opened, read_some
from impslam.types import NO_FIX, SatelliteFix

SILENT = 5.0  # s without a sentence: receivers send one a second at least


@register("nmea")
class NmeaReceiver(Device):
    """GNSS receiver with NMEA 0183 on a serial port: GGA, RMC, GST."""

    port: str = parameter(
        "/dev/imp-gps", "1", "serial port, or socket://HOST:PORT for a line over TCP"
    )
    baud: int = parameter(
        9600, "bit/s", "speed of the line; NMEA 0183 says 4800, most send 9600", gt=0
    )
    latency: float = parameter(
        0.1, "s", "from the moment of a fix until its first sentence begins, at least", ge=0
    )
    patience: float = parameter(3.0, "s", "nothing heard for this long counts as silent", gt=0)

    def _serve(self) -> None:
        library = extra("pynmeagps")
        with opened(self.port, self.baud) as port:
            sentences, epochs, clock = Sentences(library, self._count), Epochs(), DeviceClock()
            opened_at = heard = now()
            fixed: bool | None = None
            ready = False
            while not self._stopping.is_set():
                data = read_some(port)
                arrived = now()  # of the first bytes: they are read as they come
                for sentence, began in sentences.feed(data, arrived):
                    heard = arrived
                    if not ready:
                        self._ready(f"NMEA receiver ({sentence.talker}) at {self.port}")
                        ready = True
                    for epoch in epochs.add(sentence, began):
                        fixed = self._tell_fix(fixed, epoch.status > NO_FIX)
                        self._pass_on(epoch, clock)
                if now() - max(heard, opened_at) > SILENT:
                    raise DeviceError(
                        f"{self.port}: no GGA, RMC or GST understood for {SILENT:.0f} s; check the "
                        f"receiver's supply, its wiring and baud ({self.baud})"
                    )

    def _tell_fix(self, before: bool | None, fixed: bool) -> bool:
        """Tell when the fix is found or lost."""
        if fixed != before:
            if fixed:
                self._tell("info", "has a fix")
            elif before:
                self._tell("warning", "has lost its fix")
        return fixed

    def _pass_on(self, epoch: Epoch, clock: DeviceClock) -> None:
        moment, stamp = epoch.seconds, epoch.arrived - self.latency
        if math.isfinite(moment):
            clock.observe(moment, stamp)
            stamp = clock.to_host(moment)
        self._deliver(
            SatelliteFix(
                stamp,
                epoch.latitude,
                epoch.longitude,
                epoch.altitude,
                epoch.covariance,
                epoch.status,
            ),
            epoch.arrived,
            moment if math.isfinite(moment) else None,
        )
