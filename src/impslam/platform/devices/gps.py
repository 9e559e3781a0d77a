"""A GNSS receiver that speaks NMEA 0183 on a serial port (thesis 3.3.1, GPS)."""

from __future__ import annotations

import math

from impslam.component import parameter, register
from impslam.platform.devices.base import Device, DeviceError, now
from impslam.platform.devices.clock import DeviceClock
from impslam.platform.devices.nmea import Epoch, Epochs, Sentences
from impslam.platform.devices.port import extra, opened, read_some
from impslam.types import NO_FIX, SatelliteFix

SILENCE_TIMEOUT = 5.0  # s without a sentence; receivers send at least one a second


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
    timeout: float = parameter(
        3.0, "s", "a receiver without messages for this long is silent", gt=0
    )

    def _serve(self) -> None:
        library = extra("pynmeagps")
        with opened(self.port, self.baud) as port:
            sentences, epochs, clock = Sentences(library, self._count), Epochs(), DeviceClock()
            opened_at = last_sentence = now()
            fixed: bool | None = None
            ready = False
            while not self._stopping.is_set():
                data = read_some(port)
                arrived = now()  # of the first byte: bytes are read as they come
                for sentence, began in sentences.feed(data, arrived):
                    last_sentence = arrived
                    if not ready:
                        self._ready(f"NMEA receiver ({sentence.talker}) at {self.port}")
                        ready = True
                    for epoch in epochs.add(sentence, began):
                        fixed = self._notify_fix(fixed, epoch.status > NO_FIX)
                        self._deliver_epoch(epoch, clock)
                if now() - max(last_sentence, opened_at) > SILENCE_TIMEOUT:
                    raise DeviceError(
                        f"{self.port}: no GGA, RMC or GST sentence for {SILENCE_TIMEOUT:.0f} s; "
                        f"check the receiver's supply, its wiring and baud ({self.baud})"
                    )

    def _notify_fix(self, before: bool | None, fixed: bool) -> bool:
        """Notify when the fix is found or lost."""
        if fixed != before:
            if fixed:
                self._notify("info", "has a fix")
            elif before:
                self._notify("warning", "has lost its fix")
        return fixed

    def _deliver_epoch(self, epoch: Epoch, clock: DeviceClock) -> None:
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
